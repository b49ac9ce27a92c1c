"""A grip is friction: what is pulled slips at its limit, all else stays, and nothing but fingers holds it."""

from __future__ import annotations

import numpy as np
import pytest

from soma_bullet.bullet.quiet import pybullet as p
from soma_bullet.frames import (
    inverse,
    make_transform,
    rotation_angle,
)
from soma_bullet.robot.kinematics import Robot
from soma_bullet.robot.model import Cell
from soma_bullet.world.options import Physics
from tests.blocks import SIDE, assembly, box
from tests.bullet.hand_world import GRAVITY, GRIP, grip, run, running


@pytest.mark.parametrize("solver", ["dantzig", "pgs"])
@pytest.mark.parametrize("along", ["down", "out of the hand", "across the hand"])
def test_a_gripped_piece_slips_when_pulled_with_twice_mu_f(
    cell: Cell, robot: Robot, solver: str, along: str
) -> None:
    block = box((SIDE, SIDE, 3 * SIDE), "block")
    T = robot.tcp(0, cell.arms[0].q_home)
    pull = {"down": np.array([0.0, 0.0, -1.0]), "out of the hand": T[:3, 2], "across the hand": T[:3, 1]}[
        along
    ]
    mu = np.sqrt(cell.arms[0].hand.pad_friction * block.friction)
    physics = Physics(solver=solver, grip_force=GRIP)  # type: ignore[arg-type]
    with running(cell, assembly([block], [(0, 0, 0)]), {"block": T}, physics, SIDE + 2e-3) as world:
        p.setGravity(
            0, 0, 0, physicsClientId=world.client
        )  # in the hand by hand: it must not fall before the pads close
        grip(world)
        p.setGravity(0, 0, -GRAVITY, physicsClientId=world.client)
        run(world, 0.1)
        start = inverse(world.tcp_pose(0)) @ world.piece_poses()["block"]
        for force in np.arange(0.0, 3 * mu * GRIP, 0.05):
            place = world.piece_poses()["block"][:3, 3].tolist()
            body = world.pieces["block"]
            p.applyExternalForce(
                body, -1, (pull * force).tolist(), place, p.WORLD_FRAME, physicsClientId=world.client
            )
            world.step()
            now = inverse(world.tcp_pose(0)) @ world.piece_poses()["block"]
            if np.linalg.norm(now[:3, 3] - start[:3, 3]) > 5e-4:
                break
    needed = np.linalg.norm(pull * force - (0.0, 0.0, GRAVITY * block.mass))
    assert needed == pytest.approx(2 * mu * GRIP, rel=0.10)


def test_what_is_pinched_and_pushed_aside_stays(cell: Cell, robot: Robot) -> None:
    """Between the table and what a hand presses on it with some 2 N and pushes 0.3 mm aside, one corner at
    its limit."""
    lower, upper = box((SIDE, SIDE, 2 * SIDE), "lower"), box((SIDE, SIDE, 3 * SIDE), "upper")
    heights = {"lower": SIDE - lower.clearance, "upper": 3.5 * SIDE - 3 * lower.clearance}
    poses = {name: make_transform(translation=(-0.1, 0.25, height)) for name, height in heights.items()}
    over = make_transform(np.diag((1.0, -1.0, -1.0)), (-0.1, 0.25, 4.2 * SIDE))
    q = robot.inverse(0, over, cell.arms[0].q_home)[0]
    with running(
        cell, assembly([lower, upper], [(0, 0, 0), (0, 0, 2.5)]), poses, None, SIDE + 2e-3, q
    ) as world:
        grip(world)
        offsets = np.array(((0.0, 0.0, -1e-4), (3e-4, 0.0, -1e-4), (3e-4, 0.0, -5e-5)))
        way = np.linalg.pinv(robot.jacobian(0, q))[:, :3] @ offsets.T
        for start, end in ((np.zeros(6), way[:, 0]), (way[:, 0], way[:, 1]), (way[:, 1], way[:, 2])):
            for k in range(1, 97):
                world.command_arm(0, q + start + (end - start) * k / 96)
                world.step()
        run(world, 0.3)
        before = world.piece_poses()["lower"]
        run(world, 2.0)
        after = world.piece_poses()["lower"]
        pressed = sum(
            force for a, b, force, _ in world.contacts() if {a[0], b[0]} == set(world.pieces.values())
        )
    assert pressed > 1.5
    assert np.linalg.norm(after[:3, 3] - before[:3, 3]) < 5e-6
    assert rotation_angle(before[:3, :3], after[:3, :3]) < np.deg2rad(1e-3)


def test_a_gripped_piece_that_is_not_pulled_stays(cell: Cell, robot: Robot) -> None:
    block = box((SIDE, SIDE, 3 * SIDE), "block")
    T = robot.tcp(0, cell.arms[0].q_home)
    with running(
        cell, assembly([block], [(0, 0, 0)]), {"block": T}, Physics(grip_force=GRIP), SIDE + 2e-3
    ) as world:
        p.setGravity(0, 0, 0, physicsClientId=world.client)
        grip(world)
        p.setGravity(0, 0, -GRAVITY, physicsClientId=world.client)
        start = world.piece_poses()["block"]
        run(world, 2.0)
        end = world.piece_poses()["block"]
    assert np.linalg.norm(end[:3, 3] - start[:3, 3]) < 2e-5
    assert np.rad2deg(rotation_angle(start[:3, :3], end[:3, :3])) < 0.02


def test_a_strong_grip_converges_too(cell: Cell, robot: Robot) -> None:
    """The solver must reach the limit of the motors of the fingers within its iterations, however strong the
    hand."""
    block = box((SIDE, SIDE, 3 * SIDE), "block")
    T = robot.tcp(0, cell.arms[0].q_home)
    physics = Physics(grip_force=80.0)
    with running(cell, assembly([block], [(0, 0, 0)]), {"block": T}, physics, SIDE + 2e-3) as world:
        p.setGravity(0, 0, 0, physicsClientId=world.client)
        grip(world, 80.0)
        p.setGravity(0, 0, -GRAVITY, physicsClientId=world.client)
        start = world.piece_poses()["block"]
        run(world, 1.0)
        end = world.piece_poses()["block"]
        forces = [force for a, b, force, _ in world.contacts() if {a, b} & set(world.finger_links[0])]
    assert np.linalg.norm(end[:3, 3] - start[:3, 3]) < 2e-5
    np.testing.assert_allclose(forces, 80.0, rtol=0.02)


def test_the_only_constraints_are_the_gears_of_the_fingers(cell: Cell, robot: Robot) -> None:
    block = box((SIDE,) * 3, "block")
    expected = [f"gear: {first} - {second}" for first, second in (arm.finger_joints for arm in cell.arms)]
    with running(
        cell, assembly([block], [(0, 0, 0)]), {"block": robot.tcp(0, cell.arms[0].q_home)}, opening=SIDE
    ) as world:
        assert sorted(world.constraints()) == sorted(expected)
        grip(world)
        assert sorted(world.constraints()) == sorted(expected)


def test_a_piece_released_gently_stays(cell: Cell, robot: Robot) -> None:
    """Gripped and let go where it stands: less than 0.1 mm, though the hand need not be centred on it."""
    block = box((SIDE, SIDE, 3 * SIDE), "block")
    stands = make_transform(translation=(-0.1, 0.25, 1.5 * SIDE - block.clearance))
    down = np.diag([1.0, -1.0, -1.0])
    (q, *_) = robot.inverse(0, make_transform(down, (-0.1, 0.25, 2 * SIDE)), cell.arms[0].q_home)
    with running(cell, assembly([block], [(0, 0, 0)]), {"block": stands}, opening=SIDE + 5e-3, q=q) as world:
        run(world, 0.1)
        start = world.piece_poses()["block"]
        grip(world)
        for force in np.linspace(GRIP, 0.5, 72):
            world.squeeze(0, force)
            world.step()
        world.open_hand(0, SIDE + 8e-3, 0.01)
        run(world, 0.05)
        world.open_hand(0, SIDE + 8e-3)
        run(world, 1.0)
        end, touching = world.piece_poses()["block"], world.contacts()
    assert np.linalg.norm(end[:3, 3] - start[:3, 3]) < 1e-4
    assert np.rad2deg(rotation_angle(start[:3, :3], end[:3, :3])) < 0.1
    assert not [
        row for row in touching if (world.pieces["block"], -1) in row[:2] and row[0][0] in world.robots
    ]
