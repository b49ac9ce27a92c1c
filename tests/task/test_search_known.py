"""What a search knows already: picks and insertions of each arm, and when they are looked at anew."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from soma_bullet.frames import inverse, translate
from soma_bullet.task.actions import insert, pick
from soma_bullet.task.actions.insert import Candidate
from soma_bullet.task.kinds import LIFT
from soma_bullet.task.search.planning import Fetch
from soma_bullet.task.search.search import Search
from soma_bullet.task.state import CellState
from soma_bullet.task.workcell import Workcell


def fetch_of(search: Search, k: int, state: CellState) -> Fetch:
    piece = search.plan.steps[k].piece
    return Fetch(piece, search.planning.spots[piece], state)


def both_arms(search: Search, k: int, found: Callable[[int, Fetch, int], bool]) -> int:
    """A grasp of the piece of a step that `found` holds of for either arm."""
    fetch = fetch_of(search, k, search.planning.empty(k))
    return next(
        int(g) for g in search.planning.allowed(k) if all(found(arm, fetch, int(g)) for arm in (0, 1))
    )


def test_each_arm_has_its_own_picks(search: Search, workcell: Workcell) -> None:
    planning, fetch = search.planning, fetch_of(search, 0, search.planning.empty(0))
    graph = planning.graph(fetch.piece)

    def picked_by(arm: int, fetch: Fetch, g: int) -> bool:
        return bool(pick.candidates(planning, fetch, fetch.source, arm, graph.grip(g)))

    grip = graph.grip(both_arms(search, 0, picked_by))
    for arm in (0, 1):
        for approach, lift in pick.candidates(planning, fetch, fetch.source, arm, grip):
            for line in (approach, lift):
                np.testing.assert_allclose(
                    workcell.robot.tcp(arm, line[0]), fetch.source.pose @ grip.T_piece_tcp, atol=1e-5
                )
        picked = pick.check(planning, fetch, fetch.source, arm, grip)
        assert picked is not None and picked.arm == arm
        assert pick.check(planning, fetch, fetch.source, arm, grip) is picked


def test_each_arm_has_its_own_insertions(search: Search, workcell: Workcell) -> None:
    planning, piece = search.planning, search.plan.steps[0].piece
    graph = planning.graph(piece)
    index = both_arms(
        search, 0, lambda arm, _, g: bool(insert.candidates(planning, 0, Candidate(arm, graph.grip(g))))
    )
    grip = graph.grip(index)
    for arm in (0, 1):
        for line in insert.candidates(planning, 0, Candidate(arm, grip)):
            np.testing.assert_allclose(
                workcell.robot.tcp(arm, line[0]), workcell.settled[piece] @ grip.T_piece_tcp, atol=1e-5
            )


def test_a_pick_is_looked_at_anew_where_the_other_arm_is_elsewhere(
    search: Search, workcell: Workcell, held: CellState
) -> None:
    """As if the hand that holds were at the piece that is to be picked."""
    planning = search.planning
    fetch = fetch_of(search, 1, held)
    ((holder, piece),) = held.held.items()
    arm, graph = 1 - holder, planning.graph(fetch.piece)
    picked = next(
        found
        for g in planning.allowed(1)
        if (found := pick.check(planning, fetch, fetch.source, arm, graph.grip(int(g)))) is not None
    )
    T = workcell.robot.tcp(arm, picked.q_pick)
    in_the_way = workcell.robot.inverse(holder, T, held.qs[holder])
    assert len(in_the_way)
    elsewhere = replace(fetch, state=held.with_arm(holder, in_the_way[0]))
    assert pick.check(planning, elsewhere, fetch.source, arm, graph.grip(picked.grasp)) is None
    assert pick.check(planning, fetch, fetch.source, arm, graph.grip(picked.grasp)) is picked


def test_a_pick_is_free_of_the_other_arm_on_both_of_its_lines(
    search: Search, workcell: Workcell, held: CellState
) -> None:
    """Wherever that is; judged by the scenes of approach and lift."""
    planning, rng = search.planning, np.random.default_rng(0)
    ((holder, _),) = held.held.items()
    fetch, arm = fetch_of(search, 1, held), 1 - holder
    graph, robot = planning.graph(fetch.piece), workcell.robot
    grips = [graph.grip(int(g)) for g in planning.allowed(1) if planning.clear_at(fetch, fetch.source)[g]]
    usable = [g for g in grips if pick.candidates(planning, fetch, fetch.source, arm, g)][:4]
    seen = {True: 0, False: 0}
    for grip in usable:
        lines = pick.candidates(planning, fetch, fetch.source, arm, grip)
        lifted = robot.tcp(arm, lines[0][1][-1])
        for _ in range(24):
            near = translate(lifted, rng.normal(0.0, 0.12, 3) * (1.0, 1.0, 0.5))
            there = robot.inverse(holder, near, held.qs[holder])
            if not len(there):
                continue
            state = held.with_arm(holder, there[0])
            at_piece = state.gripping(arm, fetch.piece)
            carrying = at_piece.carrying(arm, inverse(grip.T_piece_tcp))
            opened = planning.opened(fetch.piece, fetch.source, arm, grip)
            scenes = (
                workcell.scene(at_piece, arm),
                workcell.scene(carrying, arm, LIFT.touching(workcell, fetch.piece)),
            )
            free = any(
                not any(
                    scene.collides(workcell.configuration(at_piece, arm, q, width))
                    for scene, line, width in zip(scenes, branch, (opened, grip.width), strict=True)
                    for q in line
                )
                for branch in lines
            )
            found = pick.check(planning, replace(fetch, state=state), fetch.source, arm, grip)
            assert (found is not None) == free
            seen[free] += 1
    assert min(seen.values()) >= 5


def test_what_lies_elsewhere_is_looked_at_anew(search: Search) -> None:
    planning, state = search.planning, search.planning.empty(0)
    piece, other = (step.piece for step in search.plan.steps[:2])
    fetch = Fetch(piece, planning.spots[piece], state)
    before = planning.clear_at(fetch, fetch.source)
    upon = replace(fetch, state=state.moved(other, fetch.source.pose))
    planning.forget()
    assert (before & ~planning.clear_at(upon, fetch.source)).any()
