"""The pads' contacts, renewed while the hand turns: nothing slides, and they point where they should."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.bullet.quiet import pybullet as p
from soma_bullet.bullet.upkeep import EVERY, STALE, STALE_POINTS
from soma_bullet.frames import (
    inverse,
    make_transform,
    rotation_about,
    rotation_angle,
)
from soma_bullet.robot.kinematics import Robot
from soma_bullet.robot.model import Cell
from soma_bullet.world.options import Physics
from tests.blocks import SIDE, assembly, box
from tests.bullet.hand_world import GRAVITY, GRIP, grip, run, running


@pytest.mark.parametrize(("loaded", "holds"), [(0.01, True), (0.1, True), (1.15, False)])
def test_renewing_the_contacts_in_flight_lets_nothing_slide(
    cell: Cell, robot: Robot, loaded: float, holds: bool
) -> None:
    """A transfer renews the pads' contacts in turn: a tenth of what the grip could carry hardly moves, the
    fingers not."""
    block = box((SIDE, SIDE, 3 * SIDE), "block")
    T = robot.tcp(0, cell.arms[0].q_home)
    mu = np.sqrt(cell.arms[0].hand.pad_friction * block.friction)
    physics = Physics(grip_force=GRIP, mass=float(loaded * 2 * mu * GRIP / (GRAVITY * block.mass)))
    with running(cell, assembly([block], [(0, 0, 0)]), {"block": T}, physics, SIDE + 2e-3) as world:
        p.setGravity(0, 0, 0, physicsClientId=world.client)
        grip(world)
        p.setGravity(0, 0, -GRAVITY, physicsClientId=world.client)
        run(world, 0.05)
        start, opening = inverse(world.tcp_pose(0)) @ world.piece_poses()["block"], world.openings()[0]
        widths = []
        for k in range(240):
            if k % 50 in (0, 5):
                world.renew_contacts(0, k % 50 // 5)
            world.step()
            widths.append(world.openings()[0])
        moved = inverse(inverse(world.tcp_pose(0)) @ world.piece_poses()["block"]) @ start
    if holds:
        assert np.linalg.norm(moved[:3, 3]) < 2e-4
        assert np.abs(np.array(widths) - opening).max() < 5e-5  # the fingers do not jump
    else:
        assert np.linalg.norm(moved[:3, 3]) > 5e-3


def test_contacts_point_along_the_closing_axis_after_the_hand_has_turned(cell: Cell, robot: Robot) -> None:
    """Bullet keeps anchored contacts with their normals in world axes: after a turn they must have been
    renewed."""
    block = box((SIDE, SIDE, 3 * SIDE), "block")
    T = robot.tcp(0, cell.arms[0].q_home)
    with running(
        cell, assembly([block], [(0, 0, 0)]), {"block": T}, Physics(grip_force=GRIP), SIDE + 2e-3
    ) as world:
        p.setGravity(0, 0, 0, physicsClientId=world.client)
        grip(world)

        def alignment() -> float:
            rows = p.getContactPoints(world.robots[0], world.pieces["block"], physicsClientId=world.client)
            return min(abs(float(np.dot(row[7], world.tcp_pose(0)[:3, 0]))) for row in rows)

        q = np.array(cell.arms[0].q_home)
        for _ in range(240):
            q[5] += np.deg2rad(90) / 240
            world.command_arm(0, q)
            world.step()
        stale = alignment()
        for finger in (0, 1):
            world.renew_contacts(0, finger)
        world.step()
        assert stale < 0.95  # what the renewal is for
        assert alignment() > 0.999


def test_a_round_piece_tilts_less_where_its_contacts_are_renewed_more_often(cell: Cell, robot: Robot) -> None:
    """Each pad presses on a point or two of a cylinder, until it has rolled onto others."""
    mesh = trimesh.creation.cylinder(0.008, 0.05, sections=48)
    peg = Workpiece("peg", np.array(mesh.vertices), np.array(mesh.faces))
    across = make_transform(rotation_about((1, 0, 0), np.pi / 2))

    def tilts(every: float) -> float:
        """[deg] in a hand that turns by 120 deg in a second."""
        T = robot.tcp(0, cell.arms[0].q_home) @ across
        with running(
            cell, assembly([peg], [(0, 0, 0)]), {"peg": T}, Physics(grip_force=GRIP), 18e-3
        ) as world:
            assert not world.touches_flat("peg")
            p.setGravity(0, 0, 0, physicsClientId=world.client)
            grip(world)
            p.setGravity(0, 0, -GRAVITY, physicsClientId=world.client)
            run(world, 0.1)
            start, anchored, stale = (
                inverse(world.tcp_pose(0)) @ world.piece_poses()["peg"],
                world.tcp_pose(0),
                list[int](),
            )
            q = np.array(cell.arms[0].q_home)
            for k in range(480):
                q[5] += np.deg2rad(120) / 480
                world.command_arm(0, q)
                world.step()
                if k % EVERY == 0:
                    here = world.tcp_pose(0)
                    if not stale and rotation_angle(anchored[:3, :3], here[:3, :3]) > every:
                        stale, anchored = [0, 1], here
                    if stale:
                        world.renew_contacts(0, stale.pop())
            end = inverse(world.tcp_pose(0)) @ world.piece_poses()["peg"]
        return float(np.rad2deg(rotation_angle(start[:3, :3], end[:3, :3])))

    assert tilts(STALE_POINTS) < min(0.3, tilts(STALE))
