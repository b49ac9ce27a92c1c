"""What the wrist feels: the pull at a gripped piece, and what that stands on."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from soma_bullet.bullet.quiet import pybullet as p
from soma_bullet.bullet.simulator import BulletSimulator
from soma_bullet.frames import (
    Array,
    make_transform,
)
from soma_bullet.robot.kinematics import Robot
from soma_bullet.robot.model import Cell
from soma_bullet.world.options import Physics
from tests.blocks import SIDE, assembly, box
from tests.bullet.hand_world import GRAVITY, GRIP, grip, run, running


def wrist_axes(world: BulletSimulator) -> Array:
    """Axes (3, 3) of the first hand's mount frame in the world."""
    quat_xyzw = p.getLinkState(world.robots[0], world.wrists[0], physicsClientId=world.client)[5]
    return Rotation.from_quat(quat_xyzw).as_matrix()


@pytest.mark.parametrize("along", ["closing axis", "across the hand", "out of the hand", "all at once"])
def test_the_wrist_feels_what_pulls_at_a_gripped_piece(cell: Cell, robot: Robot, along: str) -> None:
    block = box((SIDE, SIDE, 3 * SIDE), "block")
    T = robot.tcp(0, cell.arms[0].q_home)
    pull = 4.0 * {"closing axis": T[:3, 0], "across the hand": T[:3, 1], "out of the hand": T[:3, 2]}.get(
        along, T[:3, :3].sum(1) / np.sqrt(3.0)
    )
    with running(
        cell, assembly([block], [(0, 0, 0)]), {"block": T}, Physics(grip_force=GRIP), SIDE + 2e-3
    ) as world:
        p.setGravity(0, 0, 0, physicsClientId=world.client)
        grip(world)
        p.setGravity(0, 0, -GRAVITY, physicsClientId=world.client)
        run(world, 0.3)
        tare, load = world.wrench(0), world.load(0)
        for sign in (1.0, -1.0):
            for _ in range(60):
                place = world.piece_poses()["block"][:3, 3]
                body, push = world.pieces["block"], (sign * pull).tolist()
                p.applyExternalForce(
                    body, -1, push, place.tolist(), p.WORLD_FRAME, physicsClientId=world.client
                )
                world.step()
            axes, change = wrist_axes(world), world.wrench(0) - tare
            arm = place - np.array(
                p.getLinkState(world.robots[0], world.wrists[0], physicsClientId=world.client)[4]
            )
            np.testing.assert_allclose(-axes @ change[:3], sign * pull, atol=0.05)
            np.testing.assert_allclose(-axes @ change[3:], np.cross(arm, sign * pull), atol=0.02)
            centre = world.tcp_place(0)[:3]
            np.testing.assert_allclose(
                world.load(0) - load, (*sign * pull, *np.cross(place - centre, sign * pull)), atol=0.05
            )
            np.testing.assert_allclose(
                (world.load(0) - load)[3:], np.cross(place - centre, sign * pull), atol=0.02
            )
    weight = GRAVITY * (block.mass + sum(world.hand_masses[0]))
    np.testing.assert_allclose(-axes @ tare[:3], (0.0, 0.0, -weight), atol=0.05)


def test_the_wrist_feels_what_a_gripped_piece_stands_on(cell: Cell, robot: Robot) -> None:
    """Pushed onto the table, as much more as the table carries."""
    tall = box((SIDE, SIDE, 3 * SIDE), "block")
    T = make_transform(translation=(-0.1, 0.25, 1.5 * SIDE - tall.clearance))
    over = make_transform(np.diag((1.0, -1.0, -1.0)), (-0.1, 0.25, 2.0 * SIDE))
    q = robot.inverse(0, over, cell.arms[0].q_home)[0]
    with running(
        cell, assembly([tall], [(0, 0, 0)]), {"block": T}, Physics(grip_force=GRIP), SIDE + 2e-3, q
    ) as world:
        grip(world)

        def carried() -> float:
            return sum(
                force for a, b, force, _ in world.contacts() if (world.fixtures["table"], -1) in (a, b)
            )

        tare, before = world.wrench(0), carried()
        pressed = q - np.linalg.pinv(robot.jacobian(0, q)) @ (0.0, 0.0, 2e-4, 0.0, 0.0, 0.0)
        for k in range(240):
            world.command_arm(0, q + (pressed - q) * min(1.0, k / 200))
            world.step()
        more = carried() - before
        felt = -wrist_axes(world) @ (world.wrench(0) - tare)[:3]
    assert more > 1.0
    assert felt[2] == pytest.approx(more, abs=0.1)
