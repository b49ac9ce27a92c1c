"""Parts of the search: which hands are clear of which, what stands, and the order of the search."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soma_bullet.assembly.hulls import Hull, box_hull
from soma_bullet.frames import inverse, translate
from soma_bullet.grasp.clearance import MARGIN, OPENING, SUPPORT_MARGIN
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.task.actions import insert
from soma_bullet.task.feed import Feed
from soma_bullet.task.lines import Spot
from soma_bullet.task.schedule import Schedule
from soma_bullet.task.search import changes
from soma_bullet.task.search.planning import Fetch
from soma_bullet.task.search.scheduler import Scheduler
from soma_bullet.task.search.search import Search
from soma_bullet.task.state import CellState
from soma_bullet.task.workcell import Workcell

CLOSER = 0.006  # [m] by which a neighbour may lie nearer than it seems
HOLDERS = 12  # hands that hold, one after another

# --- hands and what is in their way -------------------------------------------------------------------------


def holding_hand(workcell: Workcell, state: CellState) -> list[Hull]:
    """The boxes of the hand that holds, as wide as it is, for pieces at their nominal goals."""
    ((arm, piece),) = state.held.items()
    at_goal = workcell.goals[piece] @ inverse(workcell.settled[piece])
    T = at_goal @ workcell.robot.tcp(arm, state.qs[arm])
    places = [(box, T @ box.T) for box in workcell.hand(arm).boxes(float(state.openings[arm]))]
    return [box_hull(place[:3, 3], place[:3, :3].T, box.half) for box, place in places]


def ways_to_hold(search: Search) -> list[CellState]:
    """The first piece stands, and is held by one arm, by one grasp after another."""
    planning, piece, robot = search.planning, search.plan.steps[0].piece, search.workcell.robot
    graph, goal, found = planning.graph(piece), search.workcell.settled[piece], list[CellState]()
    allowed = planning.allowed(0)
    for g in allowed[:: max(1, len(allowed) // HOLDERS)]:
        for q in robot.inverse(0, goal @ graph.poses[g], robot.home[0])[:1]:
            state = planning.empty(1).with_arm(0, q, float(graph.widths[g]))
            found.append(state.gripping(0, piece))
    return found


def test_grasps_are_chosen_by_where_the_holding_hand_is(search: Search, workcell: Workcell) -> None:
    """Those, and only those, whose hand keeps clear of it and of what stands, along the way in and back."""
    planning, piece = search.planning, search.plan.steps[1].piece
    allowed, graph, goal = planning.allowed(1), planning.graph(piece), workcell.goals[piece]
    way = insert.insertion(planning, 1).sweep()[-1]
    sweeps = graph.sweep(goal, allowed, way_out=0.0, sweep=way), graph.sweep(goal, allowed)
    counts = {True: 0, False: 0}
    for state in ways_to_hold(search):
        placed = [part.moved(workcell.goals[n]) for n in state.placed for part in workcell.body(n).parts]
        gaps = np.min([sweep.separation(holding_hand(workcell, state)) for sweep in sweeps], axis=0)
        clear = (gaps > MARGIN) & (sweeps[0].separation(placed) > 0.0)
        before = sum(planning.lines.refusals.counts.values())
        np.testing.assert_array_equal(search.placer.chosen(1, state), allowed[clear])
        assert sum(planning.lines.refusals.counts.values()) - before == int((~clear).sum())
        counts[True], counts[False] = counts[True] + int(clear.sum()), counts[False] + int((~clear).sum())
    assert min(counts.values()) > 100


def test_what_lies_beside_a_piece_is_kept_clear_of_by_its_error_as_well(
    search: Search, feed: Feed, workcell: Workcell
) -> None:
    planning = search.planning
    piece, other = (step.piece for step in search.plan.steps[:2])
    spot, graph = planning.spots[piece], planning.graph(piece)
    beside = translate(spot.pose, (2.5 * workcell.body(piece).radius, 0.0, 0.0))
    state = planning.empty(0).moved(other, beside)
    parts = [part.moved(beside) for part in workcell.body(other).parts]
    sweep = graph.sweep(spot.pose, opening=OPENING)
    above = sweep.above(0.0) > SUPPORT_MARGIN
    clear = {}
    for off in (0.0, CLOSER):
        planning.spots[other] = Spot(beside, off)
        planning.forget()
        clear[off] = planning.clear_at(Fetch(piece, spot, state), spot)
        third = [n for n in state.poses if n not in (piece, other)]
        rest = [p.moved(state.poses[n]) for n in third for p in workcell.body(n).parts]
        expected = above & (sweep.separation(parts) > MARGIN + off) & (sweep.separation(rest) > MARGIN)
        np.testing.assert_array_equal(clear[off], expected)
    assert (clear[0.0] & ~clear[CLOSER]).any() and clear[CLOSER].any()


def test_a_piece_that_is_not_quite_there_is_met_with_a_wider_hand(search: Search) -> None:
    planning, state = search.planning, search.planning.empty(0)
    piece = search.plan.steps[0].piece
    graph, hand, pose = planning.graph(piece), planning.workcell.hand(0), planning.spots[piece].pose
    grip = graph.grip(int(np.argmin(graph.widths)))
    exact, loose, very = (planning.opened(piece, Spot(pose, off), 0, grip) for off in (0.0, CLOSER, 1.0))
    assert exact == pytest.approx(grip.width + 2 * OPENING)
    assert loose == pytest.approx(exact + 2 * CLOSER) and very == hand.opening
    fetch = Fetch(piece, Spot(pose, CLOSER), state)
    clear = planning.clear_at(fetch, fetch.source)
    assert not clear[graph.widths + 2 * CLOSER > hand.opening].any()


# --- what stands --------------------------------------------------------------------------------------------


def test_a_state_stands_as_the_plan_says(search: Search) -> None:
    placed, settled = frozenset[str](), search.placer.changes
    for step in search.plan.steps:
        placed |= {step.piece}
        holds = frozenset(hold.piece for hold in step.holds)
        assert settled.stands(placed, holds)
        if holds:
            assert not settled.stands(placed, frozenset())


def test_nothing_is_let_go_of_that_would_fall(
    workcell: Workcell, plan: AssemblyPlan, feed: Feed, held: CellState
) -> None:
    """Also where a plan does not ask for the hold."""
    careless = replace(plan, steps=(replace(plan.steps[0], holds=()), *plan.steps[1:]))
    search = Scheduler(workcell, careless, feed).feed_search
    assert search.placer.changes.settle(0, held) is None
    assert any("let the state fall" in r.cause for r in search.lines.refusals.counts)
    kept = Scheduler(workcell, plan, feed).feed_search.placer.changes.settle(0, held)
    assert kept is not None and kept.actions == () and kept.state.held == held.held


def test_a_hand_that_need_not_hold_any_more_goes(
    workcell: Workcell, plan: AssemblyPlan, feed: Feed, schedule: Schedule, held: CellState
) -> None:
    """The second piece is in place, in the other hand, which holds it from then on."""
    state = held
    for action in (*schedule.assignments[1].bring, schedule.assignments[1].insert):
        state = action.effects(workcell, state)
    assert len(state.held) == 2
    changed = Scheduler(workcell, plan, feed).feed_search.placer.changes.settle(1, state)
    assert changed is not None
    assert set(changed.state.held.values()) == {hold.piece for hold in plan.steps[1].holds}
    for arm in changed.state.free:
        np.testing.assert_array_equal(changed.state.qs[arm], workcell.robot.home[arm])


@given(st.lists(st.sampled_from("abcdef"), unique=True, max_size=4), st.booleans())
def test_hands_let_go_before_or_after_another_takes_hold(go: list[str], taking: bool) -> None:
    """At every moment one may take hold, whatever lets go; none does where none is to."""
    found = list(changes._sequences(go, taking))
    assert {after for _, after in found} == (set(range(len(go) + 1)) if taking else {0})
    assert all(sorted(order) == sorted(go) for order, _ in found)
    assert [order for order, after in found if after == 0][0] == go
    assert len({(tuple(order), after) for order, after in found}) == len(found)


# --- the order of the search --------------------------------------------------------------------------------


def test_what_no_step_follows_is_tried_once_but_at_each_step_for_itself(
    search: Search, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A made-up search of three steps: nothing follows the hands as they are after B, but what begins with
    them."""
    state, robot = search.planning.empty(0), search.workcell.robot
    after = {
        name: state.gripping(k % 2, name).with_arm(k % 2, robot.home[k % 2] + k)
        for k, name in enumerate("ABC")
    }
    ways = {(0, ""): "AB", (1, "A"): "BB", (1, "B"): "C", (2, "C"): "A"}
    tried = list[tuple[int, str]]()

    def assignments(k: int, now: CellState, width: int, ranked: object) -> Iterator[tuple[str, CellState]]:
        name = "".join(now.gripped.values())
        tried.append((k, name))
        yield from ((way, after[way]) for way in ways.get((k, name), ""))

    monkeypatch.setattr(search, "_assignments", assignments)
    monkeypatch.setattr(search, "_as_option", lambda way: None)
    monkeypatch.setattr(search, "placer", SimpleNamespace(ruled_out=lambda way: False))
    arms: Any = SimpleNamespace(ranked=lambda k, previous: [])
    (found,) = search._search(0, state, 8, None, arms)
    assert found == ["B", "C", "A"]
    assert tried == [(0, ""), (1, "A"), (2, "B"), (1, "B"), (2, "C")]
