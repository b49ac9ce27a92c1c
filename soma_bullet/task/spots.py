"""Where pieces may be put down, and where two hands may meet: small fixed sets, the most comfortable
first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import permutations, product

import numpy as np
import shapely

from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.frames import Array, Indices, apply, inverse, make_transform, rotation_about
from soma_bullet.robot.kinematics import Robot
from soma_bullet.task.workcell import Workcell

GRID = (4, 2)  # places a feed area, along x and y
YAWS = 8  # of a piece at a place
ROOM = 0.02  # [m] between a piece that is put down and others
NEAR, FAR = 0.30, 0.65  # [m] from an arm's base: nearer and farther than this becomes awkward
OUTWARD = 0.5  # of a hand that is held well: outwards for each part down
SIDES, HEIGHTS = (0.30, 0.18), (0.24, 0.34)  # [m] of a meeting: from the stand, and above the table


def comfort(robot: Robot, arm: int, Ts_world_tcp: Array) -> Array:
    """How awkward an arm has its hand at poses (..., 4, 4): about the angle [rad] from reaching down and
    outwards."""
    offset = Ts_world_tcp[..., :3, 3] - robot.arm(arm).T_world_base[:3, 3]
    flat = offset * np.array((1.0, 1.0, 0.0))
    outward = flat / np.maximum(np.linalg.norm(flat, axis=-1, keepdims=True), 1e-9)
    ideal = np.array((0.0, 0.0, -1.0)) + OUTWARD * outward
    ideal /= np.linalg.norm(ideal, axis=-1, keepdims=True)
    angle = np.arccos(np.clip((Ts_world_tcp[..., :3, 2] * ideal).sum(axis=-1), -1, 1))
    reach = np.linalg.norm(offset, axis=-1)
    return np.asarray(angle + 5 * (np.maximum(reach - FAR, 0) + np.maximum(NEAR - reach, 0)))


def bearings(poses: Array) -> list[tuple[float, ...]]:
    """Of hands at poses (n, 4, 4) the directions of approach and of closing, coarsely: hands that may fail
    alike are alike."""
    return [tuple(row) for row in np.round(4.0 * poses[:, :3, [2, 0]]).reshape(-1, 6).tolist()]


def spread(poses: Array, indices: Indices, cost: Array) -> list[int]:
    """Grasps (some indices of poses (n, 4, 4)) by cost: the best one of every direction of the hand first."""
    groups: dict[tuple[float, ...], list[int]] = {}
    ranked = indices[np.argsort(np.round(cost, 9), kind="stable")]
    for g, direction in zip(ranked.tolist(), bearings(poses[ranked]), strict=True):
        groups.setdefault(direction, []).append(g)
    longest = max(map(len, groups.values()), default=0)
    return [group[k] for k in range(longest) for group in groups.values() if k < len(group)]


def free_places(
    workcell: Workcell, piece: Workpiece, rest: Array, source: Array, others: Mapping[str, Array]
) -> Array:
    """T_world_piece (m, 4, 4) of a resting pose (4, 4) at free places of the feed areas and where the piece
    is, at all yaws."""
    places = [apply(source, piece.center_of_mass)[:2]]
    for area in workcell.cell.feed_areas:
        columns, rows = (
            low + (np.arange(n) + 0.5) / n * (high - low) for n, (low, high) in zip(GRID, area, strict=True)
        )
        places += [np.array(place) for place in product(columns, rows)]
    assembly = workcell.assembly
    obstacles = [
        _outline(assembly.pieces[assembly.index(name)], pose) for name, pose in sorted(others.items())
    ]
    half = np.array(workcell.robot.stand_size) / 2
    obstacles.append(shapely.box(*(workcell.cell.stand_centre - half), *(workcell.cell.stand_centre + half)))
    areas = [shapely.box(*area[:, 0], *area[:, 1]) for area in workcell.cell.feed_areas]
    found = []
    for place in places:
        if not any(area.buffer(ROOM).contains(shapely.Point(place)) for area in areas):
            continue
        for yaw in 2 * np.pi * np.arange(YAWS) / YAWS:
            pose = make_transform(rotation_about((0, 0, 1), yaw), (*place, 0.0)) @ rest
            outline = _outline(piece, pose)
            if all(outline.distance(other) >= ROOM for other in obstacles):
                found.append(pose)
    return np.array(found).reshape(-1, 4, 4)


def _outline(piece: Workpiece, pose: Array) -> shapely.Geometry:
    return shapely.multipoints(apply(pose, piece.vertices)[:, :2]).convex_hull


def _turns() -> Array:
    """The 24 turns of a cube, and those turned by 45 deg about z (48, 3, 3)."""
    signed = [
        np.diag(s) @ np.eye(3)[list(p)]
        for p in permutations(range(3))
        for s in product((1.0, -1.0), repeat=3)
    ]
    turns = np.array([turn for turn in signed if np.linalg.det(turn) > 0])
    return np.vstack([turns, rotation_about((0, 0, 1), np.pi / 4) @ turns])


TURNS = _turns()


def meeting_poses(
    robot: Robot, arms: Sequence[int], grasps: Sequence[Array], source: Array, com: Array
) -> Array:
    """T_world_piece (m, 4, 4) at which two hands can meet with their grasps T_piece_tcp (4, 4), most
    comfortable first.

    Args:
        source: where the piece comes from (3,) [m]; its side of the table is preferred.
        com: the piece's centre of mass (3,) [m] in its frame: it comes to the place of the meeting.
    """
    side = 1.0 if source[1] >= 0 else -1.0
    poses, cost = [], []
    for rank, (y, z) in enumerate((s * y, z) for s in (side, -side) for y in SIDES for z in HEIGHTS):
        for turn in TURNS:
            rotation = turn @ inverse(grasps[0])[:3, :3]
            poses.append(make_transform(rotation, np.array((0.0, y, z)) - rotation @ com))
            cost.append(0.05 * rank)
    batch = np.array(poses)
    total = np.array(cost)
    for arm, grasp in zip(arms, grasps, strict=True):
        total = total + comfort(robot, arm, batch @ grasp) ** 2
    return np.asarray(batch[np.argsort(np.round(total, 9), kind="stable")])
