"""Where pieces may be put down, and where two hands may meet: small fixed sets, the most comfortable
first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import permutations, product

import numpy as np
import shapely

from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.frames import Array, apply, inverse, make_transform, rotation_about
from soma_bullet.robot.kinematics import Robot
from soma_bullet.task.posture import posture_cost
from soma_bullet.task.workcell import Workcell

GRID = (4, 2)  # places a feed area, along x and y
YAWS = 8  # of a piece at a place


def free_places(
    workcell: Workcell, piece: Workpiece, rest: Array, source: Array, others: Mapping[str, Array]
) -> list[tuple[tuple[int, int], Array]]:
    """T_world_piece (4, 4) of a resting pose (4, 4) at free places of the feed areas and where the piece is,
    at all yaws; each with the numbers of its place and yaw."""
    places, room = [apply(source, piece.center_of_mass)[:2]], workcell.sizes.room
    for area in workcell.cell.feed_areas:
        columns, rows = (
            low + (np.arange(n) + 0.5) / n * (high - low) for n, (low, high) in zip(GRID, area, strict=True)
        )
        places += [np.array(place) for place in product(columns, rows)]
    obstacles = [_outline(workcell.body(name), pose) for name, pose in sorted(others.items())]
    half = np.array(workcell.robot.stand_size) / 2
    obstacles.append(shapely.box(*(workcell.cell.stand_centre - half), *(workcell.cell.stand_centre + half)))
    areas = [shapely.box(*area[:, 0], *area[:, 1]).buffer(room) for area in workcell.cell.feed_areas]
    found: list[tuple[tuple[int, int], Array]] = []
    for number, place in enumerate(places):
        if not any(area.contains(shapely.Point(place)) for area in areas):
            continue
        for turn, yaw in enumerate(2 * np.pi * np.arange(YAWS) / YAWS):
            pose = make_transform(rotation_about((0, 0, 1), yaw), (*place, 0.0)) @ rest
            outline = _outline(piece, pose)
            if all(outline.distance(other) >= room for other in obstacles):
                found.append(((number, turn), pose))
    return found


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
    reach = min((robot.reaches[arm] for arm in arms), key=lambda reach: reach.scale)
    sides, heights = reach.meeting_sides, reach.meeting_heights
    side = 1.0 if source[1] >= 0 else -1.0
    poses, cost = [], []
    for rank, (y, z) in enumerate((s * y, z) for s in (side, -side) for y in sides for z in heights):
        for turn in TURNS:
            rotation = turn @ inverse(grasps[0])[:3, :3]
            poses.append(make_transform(rotation, np.array((0.0, y, z)) - rotation @ com))
            cost.append(0.05 * rank)
    batch = np.array(poses)
    total = np.array(cost)
    for arm, grasp in zip(arms, grasps, strict=True):
        total = total + posture_cost(robot, arm, batch @ grasp) ** 2
    return np.asarray(batch[np.argsort(np.round(total, 9), kind="stable")])
