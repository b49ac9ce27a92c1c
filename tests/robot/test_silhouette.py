"""Arms as shapes: where pinocchio has them, how far they move, and what they come near to."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.frames import Array, make_transform, rotation_about
from soma_bullet.robot.cell import load_cell
from soma_bullet.robot.collision import CollisionModel, Situation
from soma_bullet.robot.kinematics import Robot
from soma_bullet.robot.silhouette import Obstacle, Silhouette, distance

CARRIED = {"Z": make_transform(rotation_about((0, 1, 0), 0.4), (0.01, 0.02, 0.03))}


@pytest.fixture(scope="module")
def model() -> CollisionModel:
    robot = Robot(load_cell("ur5e_pair"), (0.05, 0.05))
    return CollisionModel(robot, {piece.name: piece.body_parts for piece in load_assembly("soma3").pieces})


def somewhere(model: CollisionModel, arm: int, seed: int, count: int = 40) -> Array:
    """A wandering path (count, 6) about home."""
    rng = np.random.default_rng(seed)
    ends = model.robot.home[arm] + rng.uniform(-0.8, 0.8, (3, 6))
    s = np.linspace(0, 1, count)[:, None]
    path: Array = (1 - s) ** 2 * ends[0] + 2 * s * (1 - s) * ends[1] + s**2 * ends[2]
    return path


@pytest.mark.parametrize("arm", [0, 1])
def test_shapes_are_where_the_collision_scene_has_them(model: CollisionModel, arm: int) -> None:
    opening, (piece, T_tcp_piece) = 0.03, *CARRIED.items()
    scene = model.scene(Situation({}, frozenset({arm}), {piece: (arm, T_tcp_piece)}, {piece: arm}))
    mine = [k for k, body in enumerate(model.bodies) if model.arm_of[k] == arm or body == piece]
    path = somewhere(model, arm, arm, 5)
    track = Silhouette(model, arm, opening, CARRIED).along(path)
    for k, q in enumerate(path):
        qs, openings = np.array(model.robot.home), np.zeros(2)
        qs[arm], openings[arm] = q, opening
        configuration = model.robot.configuration(qs, openings)
        pin.updateGeometryPlacements(
            model.robot.model, scene.data, scene.geometry, scene.geometry_data, configuration
        )
        places = [scene.geometry_data.oMg[index] for index in mine]
        np.testing.assert_allclose(track.rotations[k], [place.rotation for place in places], atol=1e-12)
        np.testing.assert_allclose(track.origins[k], [place.translation for place in places], atol=1e-12)


def test_no_corner_comes_farther_than_the_bound(model: CollisionModel) -> None:
    """Corners of the boxes around the shapes that lie in the balls around them; the carried piece's among
    them."""
    silhouette = Silhouette(model, 0, 0.03, CARRIED)
    track = silhouette.along(somewhere(model, 0, 3))
    signs = 2 * np.indices((2, 2, 2)).reshape(3, -1).T - 1.0
    for m, shape in enumerate(track.shapes):
        points = np.array(shape.aabb_center) + signs * float(shape.aabb_radius) / np.sqrt(3)
        corners = points @ track.rotations[:, m].transpose(0, 2, 1) + track.origins[:, m, None]
        for a, b in ((0, 39), (5, 20), (17, 18)):
            moved = np.linalg.norm(corners[b] - corners[a], axis=1).max()
            assert moved <= track.arcs[b, m] - track.arcs[a, m] + 1e-9
    assert track.arcs[-1].max() < 3.0


def over(model: CollisionModel, arm: int, place: tuple[float, float, float]) -> Array:
    """Joints (6,) with the hand at a place [m], pointing down."""
    T = np.diag((1.0, -1.0, -1.0, 1.0))
    T[:3, 3] = place
    joints: Array = model.robot.inverse(arm, T, model.robot.home[arm])[0]
    return joints


def test_an_obstacle_is_near_where_one_of_its_places_is(model: CollisionModel) -> None:
    mover, other = Silhouette(model, 0, 0.03, CARRIED), Silhouette(model, 1, 0.0)
    ghosts = [other.at(over(model, 1, (0.0, y, 0.3))) for y in np.linspace(-0.2, 0.2, 9)]
    margin, seen = 0.04, {True: 0, False: 0}
    obstacle = Obstacle(ghosts, margin)
    assert 0 < len(obstacle) < 9 * len(other.shapes)  # the base stands still
    rng = np.random.default_rng(0)
    for _ in range(60):
        placed = mover.at(
            over(model, 0, (rng.uniform(-0.35, 0.0), rng.uniform(-0.3, 0.3), rng.uniform(0.15, 0.5)))
        )
        nearest = min(distance(placed, ghost, 1.0) for ghost in ghosts)
        if abs(nearest - margin) < 0.006:
            continue  # places nearer to each other than 5 mm are one
        assert obstacle.near(placed) == (nearest < margin)
        seen[nearest < margin] += 1
    assert min(seen.values()) >= 5, seen
