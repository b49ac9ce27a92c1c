"""Friction against the textbook: blocks on slopes, and contacts that form anew where friction drives."""

from __future__ import annotations

import numpy as np
import pytest

from soma_bullet.bullet.quiet import pybullet as p
from soma_bullet.bullet.simulator import LOOKS_EVERY
from soma_bullet.frames import (
    Array,
    make_transform,
    rotation_about,
)
from soma_bullet.robot.model import Cell
from soma_bullet.world.options import Physics
from tests.blocks import SIDE, assembly, box, cells
from tests.bullet.hand_world import GRAVITY, run, running

YAWS = (0.0, 30.0, 45.0, 90.0)  # [deg] of blocks against the slope
SLIDES = np.rad2deg(np.arctan(0.5))  # 26.57 deg: the steepest slope that friction 0.5 can hold


def slides(cell: Cell, physics: Physics, slope_deg: float, azimuth_deg: float) -> Array:
    """How far blocks at YAWS get [mm] in half a second after gravity has tilted as if the table were a
    slope."""
    blocks = [cells([(0, 0, 0), (1, 0, 0)], f"block{k}") for k in range(len(YAWS))]
    bottom = blocks[0].vertices[:, 2].min() + blocks[0].clearance
    poses = {
        block.name: make_transform(rotation_about((0, 0, 1), np.deg2rad(yaw)), (0.1 * k - 0.2, 0.25, -bottom))
        for k, (block, yaw) in enumerate(zip(blocks, YAWS, strict=True))
    }
    with running(
        cell, assembly(blocks, [(float(k), 0, 0) for k in range(len(blocks))]), poses, physics
    ) as world:
        run(world, 0.05)
        slope, azimuth = np.deg2rad([slope_deg, azimuth_deg])
        down = np.array([np.sin(slope) * np.cos(azimuth), np.sin(slope) * np.sin(azimuth), -np.cos(slope)])
        p.setGravity(*(GRAVITY * down).tolist(), physicsClientId=world.client)
        start = world.piece_poses()
        run(world, 0.5)
        end = world.piece_poses()
    return np.array([np.linalg.norm(end[b.name][:3, 3] - start[b.name][:3, 3]) for b in blocks]) * 1e3


@pytest.mark.parametrize("azimuth", [0.0, 90.0])
@pytest.mark.parametrize("solver", ["dantzig", "pgs"])
def test_a_block_stays_at_25_deg_and_slides_at_28(cell: Cell, solver: str, azimuth: float) -> None:
    physics = Physics(solver=solver)  # type: ignore[arg-type]
    slope = np.deg2rad(28.0)
    free_run = GRAVITY * (np.sin(slope) - 0.5 * np.cos(slope)) * 0.5**2 / 2 * 1e3  # [mm] by Coulomb's law
    assert slides(cell, physics, 25.0, azimuth).max() < 0.15
    np.testing.assert_allclose(slides(cell, physics, 28.0, azimuth), free_run, rtol=0.03)


@pytest.mark.parametrize("azimuth", [22.5, 45.0, 70.0])
@pytest.mark.parametrize("solver", ["dantzig", "pgs"])
def test_friction_across_the_axes_is_a_pyramid(cell: Cell, solver: str, azimuth: float) -> None:
    """A block at rest stays wherever friction 0.5 holds it, and never where 0.5 * sqrt(2) would not.

    In between the solvers differ. Bullet's friction at rest acts along two axes of the world, each with its
    own bound: down a diagonal dantzig holds a block up to about 35 deg, where a cone would let go at 26.57.
    pgs lets go at 26 to 27 deg."""
    physics = Physics(solver=solver)  # type: ignore[arg-type]
    assert slides(cell, physics, 25.0, azimuth).max() < 0.2
    assert slides(cell, physics, np.rad2deg(np.arctan(0.5 * np.sqrt(2))) + 1.5, azimuth).min() > 10.0
    if solver == "pgs":
        assert slides(cell, physics, SLIDES + 1.5, azimuth).min() > 10.0


@pytest.mark.parametrize(
    ("factor", "slope", "stays"),
    [(0.5, 13.0, True), (0.5, 16.0, False), (2.0, 43.0, True), (2.0, 47.0, False)],
)
def test_the_factor_on_friction_is_the_factor_on_friction(
    cell: Cell, factor: float, slope: float, stays: bool
) -> None:
    """tan 14.0 deg = 0.25, tan 45 deg = 1."""
    assert (slides(cell, Physics(friction=factor), slope, 0.0).max() < 0.2) == stays


@pytest.mark.parametrize(
    ("slope_deg", "seems_to_slide", "renewed"),
    [
        (5.0, "up", False),
        (5.0, "down", False),
        (28.0, "down", False),
        (28.0, "up", True),
        (28.0, "across", False),
    ],
)
def test_contacts_form_anew_where_friction_drives(
    cell: Cell, monkeypatch: pytest.MonkeyPatch, slope_deg: float, seems_to_slide: str, renewed: bool
) -> None:
    """Friction points up the slope, and is at its limit at 28 deg alone: it would drive a block that came
    from below."""
    block = cells([(0, 0, 0), (1, 0, 0)], "block")
    pose = make_transform(translation=(0.0, 0.25, -block.vertices[:, 2].min() - block.clearance))
    with running(cell, assembly([block], [(0, 0, 0)]), {"block": pose}) as world:
        slope = np.deg2rad(slope_deg)
        p.setGravity(GRAVITY * np.sin(slope), 0.0, -GRAVITY * np.cos(slope), physicsClientId=world.client)
        run(world, 0.3)
        forgotten = list[int]()
        monkeypatch.setattr(
            p, "setCollisionFilterGroupMask", lambda body, *args, **named: forgotten.append(body)
        )
        way = {"down": (1e-4, 0.0), "up": (-1e-4, 0.0), "across": (0.0, 1e-4)}[seems_to_slide]
        world.last_looked = world.places_of_pieces() - (*way, *[0.0] * 5)
        world.look()
    assert forgotten == ([world.pieces["block"]] if renewed else [])


def test_a_block_that_slides_keeps_its_contacts(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    block = cells([(0, 0, 0), (1, 0, 0)], "block")
    pose = make_transform(translation=(0.0, 0.25, -block.vertices[:, 2].min() - block.clearance))
    with running(cell, assembly([block], [(0, 0, 0)]), {"block": pose}) as world:
        p.setGravity(GRAVITY * np.sin(0.5), 0.0, -GRAVITY * np.cos(0.5), physicsClientId=world.client)
        monkeypatch.setattr(
            p, "setCollisionFilterGroupMask", lambda *args, **named: pytest.fail("formed anew")
        )
        run(world, 2.5 * LOOKS_EVERY)
        assert world.piece_poses()["block"][0, 3] > 5e-3


def test_friction_is_the_geometric_mean_of_two_bodies(cell: Cell) -> None:
    wood = [cells([(0, 0, 0)], "half"), box((SIDE,) * 3, "slippery", friction=0.125)]
    poses = {piece.name: make_transform(translation=(0.1 * k, 0.25, SIDE)) for k, piece in enumerate(wood)}
    with running(cell, assembly(wood, [(0, 0, 0), (1, 0, 0)]), poses) as world:
        found = {
            name: p.getDynamicsInfo(body, -1, physicsClientId=world.client)[1]
            for name, body in world.pieces.items()
        }
        table = p.getDynamicsInfo(world.fixtures["table"], -1, physicsClientId=world.client)[1]
        pads = [p.getDynamicsInfo(*part, physicsClientId=world.client)[1] for part in world.finger_links[0]]
    assert found["half"] * table == pytest.approx(0.5)
    assert found["slippery"] * table == pytest.approx(np.sqrt(0.125 * 0.5))
    assert [found["half"] * pad for pad in pads] == pytest.approx(
        [np.sqrt(0.5 * cell.arms[0].hand.pad_friction)] * 2
    )
