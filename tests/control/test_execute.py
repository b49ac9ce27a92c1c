"""The executor: what a segment does to the world, what it reports, and what goes into the log."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from soma_bullet.assembly.model import Assembly
from soma_bullet.bullet.simulator import BulletSimulator
from soma_bullet.control.execute import FINAL_SETTLE, Executor
from soma_bullet.control.options import Compliance
from soma_bullet.frames import Array, make_transform, readonly
from soma_bullet.motion.line import sample_line
from soma_bullet.motion.timing import HandLimits, time_path
from soma_bullet.robot.cell import load_cell
from soma_bullet.robot.kinematics import Robot
from soma_bullet.robot.model import Cell
from soma_bullet.sizes import Sizes
from soma_bullet.task.kinds import KINDS
from soma_bullet.task.segment import CLOSING, DT, FOLLOWING, Segment
from soma_bullet.world.options import Physics
from tests.blocks import SIDE, assembly, box

SIZES = Sizes(1.0)
GUARD, BEYOND = SIZES.guard, SIZES.beyond
STAND = (0.03, 0.03)
PLACE = np.array((-0.1, 0.25, 2 * SIDE))  # of the TCP over the block [m]
DOWN = np.diag([1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def cell() -> Cell:
    return load_cell("ur5e_pair")


@pytest.fixture(scope="module")
def robot(cell: Cell) -> Robot:
    return Robot(cell, STAND)


@pytest.fixture(scope="module")
def block() -> Assembly:
    return assembly([box((SIDE, SIDE, 3 * SIDE), "block")], [(0, 0, 0)])


def executor(
    cell: Cell, whole: Assembly, q: Array, block_at: tuple[float, float] = (-0.1, 0.25), record_every: int = 5
) -> Executor:
    """A world with the left arm at q and a block that stands on the table, and a program of one
    assignment."""
    stands = make_transform(translation=(*block_at, 1.5 * SIDE - whole.pieces[0].clearance))
    qs = np.array([q, cell.arms[1].q_home])
    physics = Physics(grip_force=20.0)
    world = BulletSimulator(cell, whole, STAND, {"block": stands}, qs, physics)
    schedule = SimpleNamespace(assignments=())
    program: Any = SimpleNamespace(
        schedule=schedule,
        assembly="test",
        digest="",
        seed=3,
        order=("block",),
        stand=STAND,
        T_world_assembly=np.eye(4),
    )
    return Executor(world, program, SIZES, record_every=record_every)


def reach(robot: Robot, cell: Cell, place: Array) -> Array:
    q: Array = robot.inverse(0, make_transform(DOWN, place), cell.arms[0].q_home)[0]
    return q


def pressed(world: BulletSimulator) -> float:
    """Force between block and table [N]."""
    names = world.part_names()
    return sum(force for a, b, force, _ in world.contacts() if {names[a], names[b]} == {"block", "table"})


def wait(kind: str, duration: float, opening: float | None = None) -> Segment:
    return Segment(KINDS[kind], 0, 0, "block", opening=opening, duration=duration, width=SIDE)


def line(
    robot: Robot, cell: Cell, q: Array, offset: Array, kind: str, guard: float = 0.0, speed: float = 0.1
) -> Segment:
    path, travel = sample_line(robot, 0, q, offset)
    arm = cell.arms[0]
    timed = time_path(path, arm.velocity, arm.acceleration, DT, travel, HandLimits(speed, 0.3))
    return Segment(KINDS[kind], 0, 0, "block", readonly(timed), readonly(offset), guard=guard)


def lowered(over: Executor, robot: Robot, by: float, kind: str) -> Segment:
    """A guarded line straight down from where the arm is, that yields."""
    segment = line(robot, over.world.cell, over.world.targets[0], np.array((0, 0, -by)), kind, GUARD, 0.010)
    return replace(segment, compliance=readonly(np.linalg.pinv(robot.jacobian(0, segment.path[-1]))))


@pytest.fixture
def over(cell: Cell, robot: Robot, block: Assembly) -> Iterator[Executor]:
    """The hand open around the block."""
    found = executor(cell, block, reach(robot, cell, PLACE + (0, 0, 0.06)))
    found.run(wait("release", 0.5, SIDE + 5e-3))
    found.run(line(robot, cell, found.world.targets[0], np.array((0, 0, -0.06)), "approach"))
    yield found
    found.world.close()


def test_a_wait_takes_as_long_as_it_says(cell: Cell, block: Assembly) -> None:
    run = executor(cell, block, cell.arms[0].q_home)
    seen = run.run(wait("settle", 0.2))
    log = run.log("done")
    run.world.close()
    assert run.world.time == pytest.approx(0.2)
    assert seen.outcome == "as planned" and seen.remaining == 0.0
    np.testing.assert_allclose(seen.qs, [arm.q_home for arm in cell.arms], atol=1e-4)
    np.testing.assert_allclose(np.diff(log.times), 5 * DT)
    assert [(s.kind, s.arm, s.piece, s.start, s.end) for s in log.segments] == [
        ("settle", "left", "block", 0.0, pytest.approx(0.2))
    ]


def test_a_path_is_followed(cell: Cell, robot: Robot, block: Assembly) -> None:
    q = reach(robot, cell, PLACE + (0, 0, 0.2))
    run = executor(cell, block, q, record_every=1)
    segment = line(robot, cell, q, np.array((0.03, 0.0, 0.05)), "lift")
    seen = run.run(segment)
    log = run.log("done")
    run.world.close()
    columns = [log.joint_names.index(name) for name in cell.arms[0].joint_names]
    assert np.abs(log.joints[:, columns] - segment.path[1:]).max() < 2e-4
    np.testing.assert_allclose(seen.qs[0], segment.path[-1], atol=2e-4)
    np.testing.assert_allclose(log.tcp_pose(-1, "left")[:3, 3], PLACE + (0.03, 0.0, 0.25), atol=1e-4)
    assert run.world.time == pytest.approx(segment.seconds)


def test_a_block_is_gripped_lifted_and_let_go(over: Executor, cell: Cell, robot: Robot) -> None:
    grasped = over.run(wait("grasp", CLOSING, 0.0))
    assert grasped.outcome == "as planned"
    assert grasped.openings[0] == pytest.approx(SIDE, abs=5e-4)
    up = over.run(line(robot, cell, over.world.targets[0], np.array((0, 0, 0.05)), "lift"))
    assert up.outcome == "as planned"
    lifted = over.world.piece_poses()["block"]
    assert lifted[2, 3] == pytest.approx(1.5 * SIDE + 0.05, abs=5e-4)
    over.run(line(robot, cell, over.world.targets[0], np.array((0, 0, -0.05)), "insert"))
    over.run(wait("release", 0.4, SIDE + 8e-3))
    log = over.log("done")
    assert over.world.openings()[0] == pytest.approx(SIDE + 8e-3, abs=5e-4)
    np.testing.assert_allclose(
        over.world.piece_poses()["block"][:3, 3], log.piece_pose(0, "block")[:3, 3], atol=3e-4
    )
    held = log.between(log.segments[2].end - 0.02, log.segments[3].end)
    assert log.grips[held, 0].min() > 15.0 and log.grips[held, 0].max() < 25.0
    assert log.grips[:, 1].max() == 0.0


def test_a_hand_that_closes_on_nothing_has_lost_it(cell: Cell, robot: Robot, block: Assembly) -> None:
    run = executor(cell, block, reach(robot, cell, PLACE), block_at=(0.1, 0.25))
    run.run(wait("release", 0.4, SIDE + 5e-3))
    seen = run.run(wait("grasp", CLOSING, 0.0))
    run.world.close()
    assert seen.outcome == "lost"
    assert seen.openings[0] < 1e-3
    assert run.recorder.segments[-1].outcome == "lost"


@pytest.mark.parametrize(
    ("below", "outcome"), [(-0.002, "as planned"), (0.001, "stopped early"), (0.005, "jammed")]
)
def test_a_guarded_motion_stops_on_contact(
    cell: Cell, robot: Robot, block: Assembly, below: float, outcome: str
) -> None:
    """The closed hand comes down on the table, to an end that lies `below` it [m]."""
    # the tips of the fingers stand out below the TCP
    tip = max(float(b.T[2, 3] + np.abs(b.T[2, :3]) @ b.half) for b in cell.arms[0].hand.boxes(0.0))
    q = reach(robot, cell, np.array((-0.1, 0.25, tip + 0.010 - below)))
    run = executor(cell, block, q, block_at=(0.1, 0.25))
    segment = line(robot, cell, q, np.array((0, 0, -0.010)), "place", GUARD, 0.010)
    seen = run.run(segment)
    run.world.close()
    record = run.recorder.segments[-1]
    assert seen.outcome == record.outcome == outcome
    if outcome == "as planned":
        assert seen.remaining == 0.0 and record.peak_force < GUARD
    else:
        assert seen.remaining == record.remaining == pytest.approx(below, abs=6e-4)
        # a stiff arm on a rigid table, with nothing between the fingers to give way: some 110 N within four
        # samples
        assert GUARD < np.linalg.norm(seen.force) <= record.peak_force < 200.0


@pytest.mark.parametrize("beyond", [0.0, 1.5e-3])
@pytest.mark.parametrize("high", [0.0, 0.8e-3])
def test_a_piece_that_sits_high_in_the_hand_is_set_down_where_it_touches(
    over: Executor, robot: Robot, high: float, beyond: float
) -> None:
    """Lifted by 20 mm and lowered by that less `high`: it goes on until it stands, where it may."""
    over.travel.compliance = Compliance()
    over.run(wait("grasp", CLOSING, 0.0))
    over.run(line(robot, over.world.cell, over.world.targets[0], np.array((0, 0, 0.02)), "lift"))
    lowering = lowered(over, robot, 0.02 - high, "place")
    seen = over.run(replace(lowering, beyond=beyond))
    stands = 1.5 * SIDE - over.world.assembly.pieces[0].clearance
    height = over.world.piece_poses()["block"][2, 3] - stands
    record = over.recorder.segments[-1]
    assert seen.outcome in ("as planned", "stopped early") and record.peak_force < 15.0
    assert height == pytest.approx(high if high and not beyond else 0.0, abs=0.1e-3)
    assert (record.peak_force > GUARD) == (not high or beyond > 0.0)


@pytest.mark.parametrize(("deeper", "outcome"), [(0.6e-3, "stopped early"), (4e-3, "jammed")])
def test_a_piece_that_meets_the_table_too_early_is_not_searched_with(
    over: Executor, robot: Robot, deeper: float, outcome: str
) -> None:
    """Lifted by 20 mm and put down by that and `deeper`: the hand sees soon that it is stopped, and stays
    over its place."""
    over.travel.compliance = Compliance()
    over.run(wait("grasp", CLOSING, 0.0))
    over.run(line(robot, over.world.cell, over.world.targets[0], np.array((0, 0, 0.02)), "lift"))
    before = over.world.piece_poses()["block"]
    lowering = lowered(over, robot, 0.02 + deeper, "set_down")
    seen = over.run(lowering)
    record = over.recorder.segments[-1]
    assert seen.outcome == outcome
    assert record.remaining == pytest.approx(deeper, abs=1.5e-3)  # it bounces
    assert record.end - record.start < lowering.seconds + 2.0
    after = over.world.piece_poses()["block"]
    assert np.linalg.norm(after[:2, 3] - before[:2, 3]) < 0.2e-3


@pytest.mark.parametrize("high", [0.0, 0.6e-3])
def test_what_is_held_follows_down_until_it_rests(over: Executor, robot: Robot, high: float) -> None:
    """Lifted by `high`, as if what had carried it were gone: it comes down by that, is not pressed on, and
    stays straight."""
    over.travel.compliance = Compliance()
    over.run(wait("grasp", CLOSING, 0.0))
    if high:
        for way in (0.02, high - 0.02):
            over.run(line(robot, over.world.cell, over.world.targets[0], np.array((0, 0, way)), "lift"))
    before, pressed_before = over.world.piece_poses()["block"], pressed(over.world)
    jacobian = robot.jacobian(0, over.world.targets[0])
    seen = over.run(
        replace(
            wait("follow", FOLLOWING),
            guard=GUARD,
            compliance=readonly(np.linalg.pinv(jacobian)),
            beyond=BEYOND,
        )
    )
    after = over.world.piece_poses()["block"]
    assert seen.outcome in ("as planned", "stopped early")
    assert after[2, 3] == pytest.approx(1.5 * SIDE - over.world.assembly.pieces[0].clearance, abs=0.1e-3)
    assert np.linalg.norm(after[:2, 3] - before[:2, 3]) < 0.1e-3
    assert after[2, 2] > np.cos(np.deg2rad(0.2))
    over.wait(0.1)
    assert (pressed_before == 0.0) == (high > 0.0)
    assert pressed(over.world) < pressed_before + GUARD


def test_what_rests_on_something_is_not_pressed(over: Executor, robot: Robot) -> None:
    """After a placing the hand knows what the piece weighs in the air: one that rests on something does not
    go down."""
    over.travel.compliance = Compliance()
    over.run(wait("grasp", CLOSING, 0.0))
    over.run(line(robot, over.world.cell, over.world.targets[0], np.array((0, 0, 0.02)), "lift"))
    lowering = lowered(over, robot, 0.02, "place")
    over.run(replace(lowering, beyond=BEYOND))
    over.travel.tares[0] = over.travel.tares[0] - (
        0.0,
        0.0,
        2 * SIZES.resting,
        0.0,
        0.0,
        0.0,
    )  # something leans on it from below
    held = over.world.target(0)
    seen = over.run(
        replace(wait("follow", FOLLOWING), guard=GUARD, compliance=lowering.compliance, beyond=BEYOND)
    )
    assert seen.outcome == "as planned" and over.recorder.segments[-1].peak_force == 0.0
    np.testing.assert_array_equal(over.world.target(0), held)


def test_without_compliance_a_hand_that_should_follow_stays(over: Executor) -> None:
    over.run(wait("grasp", CLOSING, 0.0))
    before = over.world.target(0)
    seen = over.run(replace(wait("follow", FOLLOWING), guard=GUARD, beyond=BEYOND))
    np.testing.assert_array_equal(over.world.target(0), before)
    record = over.recorder.segments[-1]
    assert seen.outcome == "as planned" and record.end - record.start == pytest.approx(FOLLOWING)


def test_the_final_rest_ends_the_log(cell: Cell, block: Assembly) -> None:
    run = executor(cell, block, cell.arms[0].q_home)
    run.settle()
    log = run.log("done")
    run.world.close()
    assert (log.segments[-1].kind, log.segments[-1].end) == ("final", pytest.approx(FINAL_SETTLE))
    count = len(log.times)
    assert log.joints.shape == (count, len(log.joint_names)) and log.targets.shape == (count, 12)
    assert log.poses.shape == (count, 1, 7) and log.tcps.shape == (count, 2, 7)
    assert log.wrenches.shape == (count, 2, 6) and log.grips.shape == (count, 2)
    assert log.contacts.shape[1] == 5 and (log.contacts[:, 0] < count).all()
    named = {frozenset((log.bodies[int(a)], log.bodies[int(b)])) for _, a, b, _, _ in log.contacts}
    assert named == {frozenset(("block", "table"))}
    force = log.contacts[log.contacts[:, 0] == count - 1, 3].sum()
    assert force == pytest.approx(block.pieces[0].mass * 9.81, rel=0.02)
    assert log.ended == "done" and log.seed == 3 and not log.poses.flags.writeable


def test_letting_go_is_an_ablation_in_the_log(over: Executor) -> None:
    segment = wait("settle", 0.2)
    over.run(wait("grasp", CLOSING, 0.0))
    over.let_go(segment, SIDE + 8e-3)
    assert over.recorder.segments[-1].kind == "ablation"
    assert over.world.openings()[0] == pytest.approx(SIDE + 8e-3, abs=5e-4)
