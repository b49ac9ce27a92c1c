"""Bodies in Bullet: masses, shapes, which arms touch, and that the same commands give the same bits."""

from __future__ import annotations

import numpy as np
import pytest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.bullet.quiet import pybullet as p
from soma_bullet.frames import (
    Array,
    apply,
    from_quat_xyzw,
    inverse,
    make_transform,
    rotation_about,
)
from soma_bullet.robot.kinematics import Robot
from soma_bullet.robot.model import Cell
from soma_bullet.world.options import Physics
from tests.blocks import SIDE, assembly, box, cells
from tests.bullet.hand_world import GRIP, home, run, running


def skewed() -> Workpiece:
    """A body whose inertia has all products: an L in three dimensions."""
    return cells([(0, 0, 0), (1, 0, 0), (2, 0, 0), (2, 1, 0), (2, 1, 1)], "skewed")


@pytest.mark.parametrize("factor", [1.0, 1.7])
def test_masses_and_inertia_are_the_workpieces(cell: Cell, factor: float) -> None:
    pieces = [*load_assembly("soma3").pieces, skewed(), box((0.02, 0.03, 0.05), "heavy", density=7800.0)]
    assert any(np.abs(piece.inertia[np.triu_indices(3, 1)]).min() > 1e-8 for piece in pieces)
    poses = {
        piece.name: make_transform(rotation_about((0, 0, 1), 0.4), (0.1 * k, 0.25, 0.3))
        for k, piece in enumerate(pieces)
    }
    whole = assembly(pieces, [(float(k), 0, 0) for k in range(len(pieces))])
    with running(cell, whole, poses, Physics(mass=factor)) as world:
        placed = world.piece_poses()
        for piece in pieces:
            info = p.getDynamicsInfo(world.pieces[piece.name], -1, physicsClientId=world.client)
            axes = np.array(p.getMatrixFromQuaternion(info[4])).reshape(3, 3)
            assert info[0] == pytest.approx(factor * piece.mass)
            np.testing.assert_allclose(info[3], piece.center_of_mass, atol=1e-9)
            inertia = axes @ np.diag(info[2]) @ axes.T
            np.testing.assert_allclose(
                inertia, factor * piece.inertia, atol=1e-6 * np.abs(piece.inertia).max()
            )
            np.testing.assert_allclose(placed[piece.name], poses[piece.name], atol=1e-7)


def test_collision_shapes_are_the_real_body(cell: Cell) -> None:
    """The boxes of each piece in Bullet span the nominal mesh less the clearance."""
    whole = load_assembly("soma3")
    poses = {
        piece.name: make_transform(translation=(0.1 * k, 0.25, 0.3)) for k, piece in enumerate(whole.pieces)
    }
    unit = np.array(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5])).reshape(3, 8).T
    with running(cell, whole, poses) as world:
        for piece in whole.pieces:
            body = world.pieces[piece.name]
            T_piece_inertial = inverse(world.T_inertial_piece[piece.name])
            corners = []
            for shape in p.getCollisionShapeData(body, -1, physicsClientId=world.client):
                assert shape[2] == p.GEOM_BOX
                T_piece_shape = T_piece_inertial @ from_quat_xyzw(shape[5], shape[6])
                corners.append(apply(T_piece_shape, unit * shape[3]))
            found = np.vstack(corners)
            np.testing.assert_allclose(
                found.min(axis=0), piece.vertices.min(axis=0) + piece.clearance, atol=1e-7
            )
            np.testing.assert_allclose(
                found.max(axis=0), piece.vertices.max(axis=0) - piece.clearance, atol=1e-7
            )


def test_a_piece_rests_where_its_real_body_touches(cell: Cell) -> None:
    block = box((SIDE,) * 3, "block", clearance=5e-4)
    poses = {"block": make_transform(translation=(0.0, 0.25, SIDE / 2))}
    with running(cell, assembly([block], [(0, 0, 0)]), poses) as world:
        run(world, 0.5)
        height = world.piece_poses()["block"][2, 3]
    assert height == pytest.approx(
        SIDE / 2 - 5e-4, abs=2e-5
    )  # Bullet lets resting bodies overlap by about 0.01 mm


@pytest.mark.parametrize("solver", ["dantzig", "pgs"])
def test_the_same_commands_twice_give_the_same_bits(cell: Cell, robot: Robot, solver: str) -> None:
    block = box((SIDE, SIDE, 3 * SIDE), "block")
    T = robot.tcp(0, cell.arms[0].q_home)

    def episode() -> list[bytes]:
        found = []
        physics = Physics(solver=solver)  # type: ignore[arg-type]
        with running(cell, assembly([block], [(0, 0, 0)]), {"block": T}, physics, SIDE + 2e-3) as world:
            world.squeeze(0, GRIP)
            for k in range(200):
                world.command_arm(0, cell.arms[0].q_home + 1e-3 * np.sin(0.05 * k))
                world.step()
                found.append(
                    world.piece_poses()["block"].tobytes()
                    + world.all_joints().tobytes()
                    + world.wrench(0).tobytes()
                )
        return found

    assert episode() == episode()


@pytest.mark.parametrize("solver", ["dantzig", "pgs"])
def test_arms_touch_each_other_and_themselves(cell: Cell, solver: str) -> None:
    """Arms that reach for the same place meet; one that folds its elbow meets itself; neighbours in an arm
    never do."""
    qs = np.deg2rad([[0.0, -60.0, 60.0, -90.0, -90.0, 0.0]] * 2)
    with running(
        cell,
        assembly([box((SIDE,) * 3, "block")], [(0, 0, 0)]),
        {"block": make_transform(translation=(0, 0.3, 0.1))},
        Physics(solver=solver),
    ) as world:  # type: ignore[arg-type]
        names = world.part_names()

        def touching(q: Array) -> set[frozenset[str]]:
            for arm, angles in enumerate(q):
                for joint, angle in zip(world.arm_joints[arm], angles, strict=True):
                    p.resetJointState(world.robots[arm], joint, float(angle), physicsClientId=world.client)
            p.performCollisionDetection(physicsClientId=world.client)
            return {
                frozenset((names[a], names[b])) for a, b, _, distance in world.contacts() if distance < 0.0
            }

        of = lambda pair: {name.split("_")[0] for name in pair}  # noqa: E731
        assert not [pair for pair in touching(home(cell)) if of(pair) & {"left", "right"}]
        assert [pair for pair in touching(qs) if of(pair) == {"left", "right"}]
        folded = home(cell)
        folded[0] = np.deg2rad([32.0, -90.0, 165.0, 0.0, -90.0, 0.0])
        assert [pair for pair in touching(folded) if of(pair) == {"left"}]
