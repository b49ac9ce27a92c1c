"""The program: one motion after another without a jump, within every limit, clear of everything."""

from __future__ import annotations

import contextlib
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from soma_bullet.motion.timing import limit_margins
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.records import read_npz, write_npz
from soma_bullet.task.actions.release import Release
from soma_bullet.task.feed import Feed
from soma_bullet.task.kinds import PLACE, as_planned
from soma_bullet.task.program.builder import guarded
from soma_bullet.task.program.make import make_program
from soma_bullet.task.program.program import Program, moments
from soma_bullet.task.segment import DT
from soma_bullet.task.workcell import STAND, Workcell
from tests.task.paths import EXCESS, assert_straight, states, tips

STEP = ["transit", "approach", "grasp", "lift", "transfer", "insert", "place", "settle"]

# --- order and continuity -----------------------------------------------------------------------------------


def test_every_piece_goes_through_every_stage(program: Program, plan: AssemblyPlan) -> None:
    for step, piece in enumerate(plan.order):
        mine = [s for s in program.segments if s.step == step]
        assert [s.kind.name for s in mine[: len(STEP)]] == STEP
        assert all(
            (s.piece, s.arm) == (piece, program.schedule.assignments[step].arm) for s in mine[: len(STEP)]
        )
        rest = [s.kind.name for s in mine[len(STEP) :]]
        releases = len(program.schedule.assignments[step].releases)
        changes = [kind for kind in rest if kind != "follow"]
        assert changes[: 2 * releases] == ["release", "retreat"] * releases
        assert set(changes[2 * releases :]) <= {"home"}
    assert [s.step for s in program.segments] == sorted(s.step for s in program.segments)


def test_what_is_held_on_a_piece_follows_when_that_is_let_go(program: Program, workcell: Workcell) -> None:
    """In soma3 each piece stands on the one before: whoever holds the upper one then lets it down, and nobody
    else does."""
    follows = [k for k, s in enumerate(program.segments) if s.kind.name == "follow"]
    held = {}
    for k, segment in enumerate(program.segments):
        if segment.kind.name == "settle":
            held[segment.arm] = segment.piece
        elif segment.kind.name == "release" and segment.piece in held.values():
            held.pop(segment.arm)
            expected = {(arm, piece) for arm, piece in held.items() if workcell.carries(segment.piece, piece)}
            found = {(program.segments[j].arm, program.segments[j].piece) for j in (k + 1,) if j in follows}
            assert found == expected
    assert follows and all(program.segments[k].beyond > 0.0 < program.segments[k].guard for k in follows)


def test_segments_start_where_the_arm_is(program: Program, workcell: Workcell) -> None:
    for _, segment, qs in states(program, workcell):
        if segment.kind.moves:
            assert np.abs(segment.path[0] - qs[segment.arm]).max() < 1e-6, segment.kind
        else:
            assert len(segment.path) == 0 and segment.duration > 0


def test_both_arms_end_at_home_with_empty_hands(program: Program, workcell: Workcell) -> None:
    qs = np.array(workcell.robot.home)
    gripped: dict[str, int] = {}
    for segment in program.segments:
        if len(segment.path):
            qs[segment.arm] = segment.path[-1]
        if segment.kind.name == "grasp":
            gripped[segment.piece] = segment.arm
        elif segment.kind.name == "release":
            assert gripped.pop(segment.piece) == segment.arm
        elif segment.kind.name in ("transit", "home"):
            assert segment.arm not in gripped.values()
    assert gripped == {}
    np.testing.assert_allclose(qs, workcell.robot.home, atol=1e-6)


def test_an_insertion_ends_at_the_goal(program: Program, workcell: Workcell) -> None:
    for a in program.schedule.assignments:
        insert, place = (
            next(s for s in program.segments if (s.kind.name, s.step) == (kind, a.step))
            for kind in ("insert", "place")
        )
        np.testing.assert_allclose(insert.path[0], a.insert.q_ready, atol=1e-6)
        np.testing.assert_allclose(place.path[-1], a.insert.q_goal, atol=1e-6)
        np.testing.assert_allclose(
            insert.offset + place.offset, a.insert.way.length * a.insert.way.direction, atol=1e-12
        )
        assert np.linalg.norm(place.offset) == pytest.approx(workcell.sizes.place)
        assert place.guard > 0 and insert.guard == 0


# --- limits -------------------------------------------------------------------------------------------------


def test_joints_keep_their_ranges_and_speeds(program: Program, workcell: Workcell) -> None:
    for segment in program.segments:
        if not len(segment.path):
            continue
        arm = workcell.robot.arm(segment.arm)
        assert (segment.path >= arm.lower).all() and (segment.path <= arm.upper).all()
        speed, acceleration = limit_margins(segment.path, arm.velocity, arm.acceleration, DT)
        assert speed <= EXCESS and acceleration <= EXCESS, segment.kind


def test_lines_are_straight_and_slow(program: Program, workcell: Workcell) -> None:
    lines = [segment for segment in program.segments if segment.kind.way == "line"]
    assert {segment.kind.name for segment in lines} == {"approach", "lift", "insert", "place", "retreat"}
    for segment in lines:
        assert_straight(workcell, segment)
        steps = np.linalg.norm(np.diff(tips(workcell, segment, 10)[:-1, :3, 3], axis=0), axis=1)
        assert steps.max(initial=0.0) / (10 * DT) <= segment.kind.limits.speed * EXCESS
        if segment.kind.name == "place":
            assert 1.0 <= segment.seconds <= 2.0


def test_motions_start_and_end_at_rest(program: Program, workcell: Workcell) -> None:
    for segment in program.segments:
        if len(segment.path) > 10:
            largest = workcell.robot.arm(segment.arm).acceleration * DT**2 * 1.5
            for ends in (segment.path[:2], segment.path[-2:]):
                assert (np.abs(ends[1] - ends[0]) <= largest).all(), segment.kind


def test_makespan_is_the_sum_of_the_segments(program: Program) -> None:
    assert program.makespan == pytest.approx(
        sum(s.duration + max(0, len(s.path) - 1) * DT for s in program.segments)
    )


# --- clear of everything ------------------------------------------------------------------------------------


def test_arms_never_meet_each_other_or_the_table(program: Program, workcell: Workcell) -> None:
    """Checked again every 50 ms without the pieces, with the hands as wide as they are then."""
    hands = workcell.idle()
    for _, segment, qs in states(program, workcell):
        hands = replace(hands, qs=tuple(qs))
        scene = workcell.scene(hands, segment.arm)
        for q in segment.path[:: round(0.05 / DT)]:
            assert not scene.collides(workcell.configuration(hands, segment.arm, q)), segment.kind
        if segment.kind.name == "grasp":
            hands = hands.with_arm(segment.arm, qs[segment.arm], segment.width)
        elif segment.opening is not None:
            hands = hands.with_arm(segment.arm, qs[segment.arm], segment.opening)


def test_pieces_in_place_stay_clear_of_empty_hands(program: Program, workcell: Workcell) -> None:
    """Transits and ways home, every 50 ms, against every piece where it is then: in the feed or settled."""
    placed: set[str] = set()
    hands = workcell.idle()
    gripped: dict[int, str] = {}
    for _, segment, qs in states(program, workcell):
        if segment.kind.name in ("transit", "home"):
            poses = {
                n: workcell.settled[n] if n in placed else program.feed.pose(n) for n in program.feed.names
            }
            now = replace(hands, poses=poses, qs=tuple(qs), gripped=dict(gripped))
            scene = workcell.scene(now, segment.arm)
            for q in segment.path[:: round(0.05 / DT)]:
                assert not scene.collides(workcell.configuration(now, segment.arm, q, segment.opening)), (
                    segment.kind
                )
        if segment.kind.name == "grasp":
            gripped[segment.arm] = segment.piece
            hands = hands.with_arm(segment.arm, qs[segment.arm], segment.width)
        elif segment.kind.name == "settle":
            placed.add(segment.piece)
        elif segment.kind.name == "retreat":
            gripped.pop(segment.arm)
        if segment.opening is not None and segment.kind.name != "grasp":
            hands = hands.with_arm(segment.arm, qs[segment.arm], segment.opening)


# --- files and seeds ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_same_seed_makes_the_same_bytes(
    program: Program, workcell: Workcell, plan: AssemblyPlan, feed: Feed, tmp_path: Path
) -> None:
    write_npz(program, tmp_path / "one.npz")
    write_npz(make_program(workcell, plan, feed, 0), tmp_path / "two.npz")
    write_npz(read_npz(Program, tmp_path / "one.npz"), tmp_path / "three.npz")
    first, second, third = ((tmp_path / f"{name}.npz").read_bytes() for name in ("one", "two", "three"))
    assert first == second == third


# --- where a hand goes on, and what goes home ---------------------------------------------------------------


def test_a_placing_goes_on_beyond_its_end_only_where_something_should_stop_it(
    program: Program, workcell: Workcell
) -> None:
    for before, segment, _ in moments(workcell, program):
        if segment.kind is PLACE:
            assert segment.beyond == workcell.sizes.beyond
            alone = guarded(
                workcell, replace(segment, beyond=0.0), replace(before, placed=frozenset()), np.inf
            )
            stands = STAND in {name for pair in workcell.touching if segment.piece in pair for name in pair}
            assert alone.beyond == (workcell.sizes.beyond if stands else 0.0)
            assert workcell.sizes.touch <= segment.guard <= alone.guard == workcell.sizes.guard
            np.testing.assert_array_equal(alone.compliance, segment.compliance)


def test_an_arm_that_has_let_go_goes_home_unless_it_acts_next(program: Program, plan: AssemblyPlan) -> None:
    assignments = program.schedule.assignments
    kept = 0
    for a, following in itertools.zip_longest(assignments, assignments[1:]):
        home = [s.arm for s in program.segments if (s.step, s.kind.name) == (a.step, "home")]
        left = {release.arm for release in a.releases}
        acts = following.actions[0].arm if following is not None else None
        assert sorted(home) == sorted(left - {acts})
        kept += acts in left
    assert kept


def test_only_what_stands_on_a_piece_follows_when_that_is_let_go(
    program: Program, workcell: Workcell, plan: AssemblyPlan
) -> None:
    names = plan.order
    for lower, upper in itertools.permutations(names, 2):
        state = workcell.idle(workcell.settled).gripping(0, lower).gripping(1, upper)
        for piece in names:
            state = state.placing(piece)
        steps, kinds = Release(0, lower, state.qs[0]).steps(workcell, state), list[str]()
        with contextlib.suppress(StopIteration):
            step = next(steps)
            while True:
                kinds.append(step.kind.name)
                state = as_planned(workcell, state, step)
                step = steps.send(state)
        follows = ["follow"] if workcell.carries(lower, upper) else []
        assert kinds == ["release", *follows, "retreat"]
    assert {workcell.carries(*pair) for pair in itertools.permutations(names, 2)} == {True, False}
