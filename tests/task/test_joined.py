"""Joined pieces are one body: they move together, are carried by one hand, and are placed together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soma_bullet.frames import Array, inverse, make_transform, rotation_about, translate
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.task.actions.action import Action, Identity, Step, Steps
from soma_bullet.task.kinds import INSERT, LIFT, PLACE, SET_DOWN, as_planned
from soma_bullet.task.program.builder import MotionError, ProgramBuilder
from soma_bullet.task.program.motions import scene_of
from soma_bullet.task.program.overlap.sweeps import Sweep
from soma_bullet.task.program.program import Program, moments
from soma_bullet.task.schedule import Schedule
from soma_bullet.task.segment import UP
from soma_bullet.task.state import CellState
from soma_bullet.task.workcell import Workcell

HIGHER = 0.08  # [m]


def of_body(state: CellState, body: str, piece: str) -> Array:
    """T_body_piece (4, 4)."""
    return inverse(state.poses[body]) @ state.poses[piece]


@pytest.fixture(scope="module")
def names(plan: AssemblyPlan) -> tuple[str, str, str]:
    """The body, what is joined to it, and what is not."""
    body, part, other = plan.order
    return body, part, other


@pytest.fixture(scope="module")
def carried(workcell: Workcell, program: Program, names: tuple[str, str, str]) -> CellState:
    """A hand has lifted the first piece, to which the second is joined as it is in the assembly."""
    body, part, _ = names
    state = next(
        after
        for _, segment, after in moments(workcell, program)
        if (segment.kind, segment.piece) == (LIFT, body)
    )
    T_body_part = inverse(workcell.settled[body]) @ workcell.settled[part]
    state = replace(state, poses={**state.poses, part: state.poses[body] @ T_body_part})
    return state.joining(body, [part])


def arm_of(state: CellState) -> int:
    (arm,) = state.carried
    return arm


# --- the state ----------------------------------------------------------------------------------------------


@given(st.floats(-3.0, 3.0), st.floats(-0.3, 0.3), st.floats(0.0, 0.5))
def test_all_pieces_of_a_body_move_as_one(yaw: float, x: float, z: float) -> None:
    poses = {name: make_transform(translation=(k, 0.1 * k, 0.2)) for k, name in enumerate("abcd")}
    idle = CellState(poses, (np.zeros(6),), np.zeros(1))
    state = idle.joining("a", ["b"]).joining("a", ["c"])
    assert state.members("a") == ("a", "b", "c") and state.members("d") == ("d",)
    moved = state.moved("a", make_transform(rotation_about((0, 0, 1), yaw), (x, 0.0, z)))
    for part in "bc":
        np.testing.assert_allclose(of_body(moved, "a", part), of_body(state, "a", part), atol=1e-12)
    assert moved.poses["d"] is state.poses["d"]
    assert moved.placing("a").placed == {"a", "b", "c"} and state.placed == set()
    assert idle.moved("a", poses["d"]).poses["b"] is poses["b"]


def test_a_part_goes_where_the_hand_goes(
    workcell: Workcell, carried: CellState, names: tuple[str, str, str]
) -> None:
    body, part, other = names
    arm = arm_of(carried)
    q = carried.qs[arm] + 0.1
    after = as_planned(workcell, carried, Step(LIFT, arm, body, q))
    np.testing.assert_allclose(after.poses[body], workcell.robot.tcp(arm, q) @ carried.carried[arm])
    np.testing.assert_allclose(of_body(after, body, part), of_body(carried, body, part), atol=1e-12)
    assert after.poses[other] is carried.poses[other]


def test_what_is_placed_is_all_of_it(
    workcell: Workcell, carried: CellState, names: tuple[str, str, str]
) -> None:
    body, part, other = names
    after = as_planned(workcell, carried, Step(PLACE, arm_of(carried), body))
    assert after.placed == {body, part} and after.carried == {}
    for name in (body, part):
        np.testing.assert_allclose(after.poses[name], workcell.settled[name], atol=1e-9)
    assert after.held == {arm_of(carried): body}
    left = as_planned(workcell, carried, Step(SET_DOWN, arm_of(carried), body))
    assert left.placed == set() and left.carried == {}
    for name, pose in carried.poses.items():
        np.testing.assert_allclose(left.poses[name], pose, atol=1e-6)


# --- the scene ----------------------------------------------------------------------------------------------


def test_both_are_in_the_scene_as_carried(
    workcell: Workcell, carried: CellState, names: tuple[str, str, str]
) -> None:
    body, part, other = names
    arm = arm_of(carried)
    situation = workcell.scene(carried, arm).situation
    assert set(situation.carried) == {body, part} and set(situation.poses) == {other}
    assert situation.gripped == {body: arm, part: arm}
    tcp = workcell.robot.tcp(arm, carried.qs[arm])
    for name, (with_arm, T_tcp_piece) in situation.carried.items():
        assert with_arm == arm
        np.testing.assert_allclose(tcp @ T_tcp_piece, carried.poses[name], atol=1e-6)
    with_both, with_one = (
        len(Sweep.at_rest(workcell, state, arm).track.shapes)
        for state in (carried, replace(carried, joined={}))
    )
    assert with_both == with_one + len(workcell.body(part).body_parts)


def test_what_a_part_would_meet_is_seen(
    workcell: Workcell, carried: CellState, names: tuple[str, str, str]
) -> None:
    """A third piece stands where only the joined one is."""
    body, part, other = names
    arm = arm_of(carried)
    state = carried.moved(other, carried.poses[part])
    q = workcell.configuration(state, arm, state.qs[arm])
    pairs = [set(pair[:2]) for pair in workcell.scene(state, arm).colliding(q)]
    assert {part, other} in pairs and {body, part} not in pairs
    alone = replace(state, joined={}, poses={n: T for n, T in state.poses.items() if n != part})
    assert {part, other} not in [set(p[:2]) for p in workcell.scene(alone, arm).colliding(q)]


# --- a program ----------------------------------------------------------------------------------------------


class Bring(Action):
    """The hand goes up with what it has, and sets it down where the insertion of its body ends."""

    def __init__(self, arm: int, piece: str, way: Array):
        self.arm, self.piece, self.way = arm, piece, way

    @property
    def identity(self) -> Identity:
        return "bring", self.piece

    def steps(self, cell: Workcell, state: CellState) -> Steps:
        yield Step(INSERT, self.arm, self.piece, offset=UP * self.way[2])
        return (yield Step(LIFT, self.arm, self.piece, offset=-UP * self.way[2] / 2))


def test_segments_keep_it_together(
    workcell: Workcell, program: Program, carried: CellState, names: tuple[str, str, str]
) -> None:
    """Made by the builder from a state in which a hand has it; with something in the way of the part it is
    refused."""
    body, part, other = names
    arm = arm_of(carried)
    start = carried.with_arm(1 - arm, workcell.robot.home[1 - arm], 0.0)
    schedule = Schedule((), {}, (Bring(arm, body, UP * HIGHER),))
    made = list(ProgramBuilder(workcell, program.feed, schedule, 0, start).run())
    assert [s.kind for _, s, _ in made] == [INSERT, LIFT]
    for _, _, after in made:
        np.testing.assert_allclose(of_body(after, body, part), of_body(start, body, part), atol=1e-9)
    np.testing.assert_allclose(
        made[-1][2].poses[part], translate(start.poses[part], UP * HIGHER / 2), atol=1e-4
    )
    assert scene_of(workcell, start, INSERT, arm, body).situation.carried.keys() == {body, part}
    blocked = start.moved(other, translate(start.poses[part], UP * HIGHER))
    with pytest.raises(MotionError, match="collides"):
        list(ProgramBuilder(workcell, program.feed, schedule, 0, blocked).run())
