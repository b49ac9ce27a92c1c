"""What segments change: one hand after another has a piece, carries it, puts it in its place, and leaves."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from soma_bullet.frames import inverse
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.task.actions.action import Step
from soma_bullet.task.kinds import (
    APPROACH,
    GRASP,
    KINDS,
    PLACE,
    RELEASE,
    RETREAT,
    SET_DOWN,
    SETTLE,
    TABLE,
    TRANSIT,
    Kind,
    as_planned,
)
from soma_bullet.task.program.make import make_program
from soma_bullet.task.program.program import Program, moments
from soma_bullet.task.segment import Segment
from soma_bullet.task.state import CellState
from soma_bullet.task.workcell import Workcell
from tests.feeds import CROWDED, UNSERVED, laid


@pytest.fixture(scope="module", params=["direct", "put down", "handed over"])
def along(
    request: pytest.FixtureRequest, workcell: Workcell, plan: AssemblyPlan, program: Program
) -> list[tuple[CellState, Segment, CellState]]:
    if request.param != "direct":
        feed = laid(workcell, plan, UNSERVED if request.param == "put down" else CROWDED)
        program = make_program(workcell, plan, feed, 0)
    return list(moments(workcell, program))


def test_what_is_carried_is_in_the_hand_and_moves_with_it(
    workcell: Workcell, along: list[tuple[CellState, Segment, CellState]]
) -> None:
    for before, segment, after in along:
        for state in (before, after):
            assert set(state.carried) <= set(state.gripped)
            for arm, T_tcp_piece in state.carried.items():
                assert state.gripped[arm] not in state.placed
                pose = workcell.robot.tcp(arm, state.qs[arm]) @ T_tcp_piece
                np.testing.assert_allclose(pose, state.poses[state.gripped[arm]], atol=1e-5)
        if segment.kind.carries:
            assert segment.arm in before.carried and before.gripped[segment.arm] == segment.piece
        assert segment.kind.unladen <= (segment.arm not in before.gripped)


def test_only_what_is_carried_moves(along: list[tuple[CellState, Segment, CellState]]) -> None:
    for before, segment, after in along:
        for name, pose in before.poses.items():
            moves = segment.kind.carries and name == segment.piece
            if not moves:
                np.testing.assert_allclose(after.poses[name], pose, atol=1e-9)
        other = 1 - segment.arm
        assert after.qs[other] is before.qs[other] and after.openings[other] == before.openings[other]


def test_hands_take_and_leave(along: list[tuple[CellState, Segment, CellState]]) -> None:
    count = dict.fromkeys(("grasp", "place", "set_down", "release", "retreat"), 0)
    last = along[0][0]
    for before, segment, after in along:
        arm, piece, kind = segment.arm, segment.piece, segment.kind.name
        count[kind] = count.get(kind, 0) + 1
        if kind == "grasp":
            assert after.gripped[arm] == piece and after.openings[arm] == segment.width
            assert (arm in after.carried) == (piece not in before.placed)
        elif kind == "place":
            assert after.placed == before.placed | {piece} and arm not in after.carried
            assert after.gripped[arm] == piece and after.holder(piece) == arm
        elif kind == "set_down":
            assert arm not in after.carried and after.gripped[arm] == piece and after.placed == before.placed
        elif kind == "release":
            assert arm not in after.carried and before.gripped[arm] == piece
            assert after.openings[arm] == segment.opening > before.openings[arm]
        elif kind == "retreat":
            assert before.gripped[arm] == piece and arm not in after.gripped
        else:
            assert after.gripped == last.gripped and after.carried.keys() == last.carried.keys()
        last = after
    assert count["grasp"] == count["release"] == count["retreat"] >= 3 and count["place"] == 3


def test_a_hand_that_takes_hold_of_what_stands_does_not_carry_it(workcell: Workcell) -> None:
    piece = workcell.assembly.names[0]
    state = workcell.idle(workcell.settled).placing(piece)
    held = as_planned(workcell, state, Step(GRASP, 0, piece, width=0.02))
    assert held.held == {0: piece} and held.carried == {} and held.openings[0] == 0.02
    taken = as_planned(workcell, replace(state, placed=frozenset()), Step(GRASP, 0, piece, width=0.02))
    assert taken.held == {} and taken.gripped == {0: piece}
    np.testing.assert_allclose(
        taken.carried[0], inverse(workcell.robot.tcp(0, state.qs[0])) @ state.poses[piece]
    )


def test_a_piece_that_is_placed_settles_wherever_the_hand_ends(workcell: Workcell) -> None:
    piece = workcell.assembly.names[0]
    state = workcell.idle(workcell.goals).gripping(0, piece).carrying(0, np.eye(4))
    after = as_planned(workcell, state, Step(PLACE, 0, piece, state.qs[0] + 0.01))
    np.testing.assert_array_equal(after.poses[piece], workcell.settled[piece])


def near(kind: Kind) -> Iterator[bool]:
    state = CellState({"a": np.eye(4)}, (np.zeros(6), np.zeros(6)), np.zeros(2))
    yield kind.before(state, 0, "a").gripped == {0: "a"}
    yield kind.before(state, 0, "a") is state


def test_a_hand_at_its_piece_has_it_between_its_fingers() -> None:
    for kind in (APPROACH, RELEASE, RETREAT):
        assert list(near(kind)) == [True, False]
    for kind in (TRANSIT, GRASP, SETTLE, SET_DOWN):
        assert list(near(kind)) == [False, True]


def test_what_may_be_touched(workcell: Workcell) -> None:
    for kind in KINDS.values():
        for piece in workcell.assembly.names:
            pairs = kind.touching(workcell, piece)
            assert all(piece in pair for pair in pairs)
            assert (frozenset({piece, TABLE}) in pairs) == (kind.touches == "table")
            assert bool(pairs) == (kind.touches != "nothing")
            if kind.touches == "goal":
                assert pairs == {pair for pair in workcell.touching if piece in pair}


def test_two_kinds_of_one_name_must_be_the_same() -> None:
    assert Kind("transit", "around", unladen=True, fetches=True) == TRANSIT
    with pytest.raises(ValueError, match="another kind of segments called 'transit'"):
        Kind("transit", "line")
    assert KINDS["transit"] is TRANSIT
