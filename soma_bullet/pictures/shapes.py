"""Bodies of a still that are not workpieces: hands at grasps, arrows, plates; and the side from which a scene
is seen best."""

from __future__ import annotations

import numpy as np
import trimesh

from soma_bullet.assembly.hulls import Hull
from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import Array, Indices, make_transform, tangents
from soma_bullet.grasp.clearance import hand_hulls
from soma_bullet.grasp.hand import Hand
from soma_bullet.pictures.raster import Body, Caster, Color, body, fit_camera

ELEVATION = np.deg2rad(24.0)  # [rad] of every view
AZIMUTHS = np.deg2rad(np.arange(0.0, 360.0, 15.0) + 5.0)  # [rad] never straight along an axis
BAR = 0.007  # [m] thickness of the bar that joins cut fingers


def piece_body(assembly: Assembly, piece: int, shift: Array | None = None, alpha: float = 1.0) -> Body:
    """A workpiece at its goal, moved by `shift` (3,) [m]."""
    workpiece = assembly.pieces[piece]
    moved = body(workpiece.vertices, workpiece.faces, workpiece.color, assembly.goals[piece], alpha)
    return moved if shift is None else Body(moved.triangles + shift, moved.color, alpha)


def assembly_size(assembly: Assembly) -> float:
    """Diagonal of the finished assembly [m]."""
    corners = np.vstack([part.vertices for parts in assembly.goal_parts for part in parts])
    return float(np.linalg.norm(np.ptp(corners, axis=0)))


def hand_body(hand: Hand, T_tcp: Array, width: float, color: Color, alpha: float, depth: float) -> Body:
    """The hand's boxes at a TCP pose (4, 4) gripping `width` [m], as far as `depth` [m] behind the TCP.

    A whole hand would hide the pieces; where its fingers are cut, a bar joins them.
    """
    fingers = (*hand.left_boxes, *hand.right_boxes)
    end = max(-depth, min(float(box.T[2, 3] - np.abs(box.T[2, :3]) @ box.half) for box in fingers) - BAR)
    approach = T_tcp[:3, 2]
    plane = float(approach @ T_tcp[:3, 3]) + end
    clouds, joint = [], []
    for hull in hand_hulls(hand, T_tcp, width):
        kept = _cut(hull, approach, plane)
        if len(kept) >= 4:
            clouds.append(kept)
            joint.append(kept[kept @ approach < plane + 1e-9])
    corners = np.vstack(joint)
    if len(corners) >= 4:
        clouds.append(np.vstack([corners, corners - BAR * approach]))
    solids = [trimesh.convex.convex_hull(cloud) for cloud in clouds]
    return Body(np.concatenate([solid.triangles for solid in solids]), color, alpha)


def _cut(hull: Hull, normal: Array, offset: float) -> Array:
    """Points (n, 3) whose convex hull is the part of a polytope with normal . x >= offset."""
    points = np.asarray(hull.vertices)
    height = points @ normal - offset
    above, below = points[height > 0], points[height <= 0]
    if not len(above) or not len(below):
        return above
    up, down = height[height > 0][:, None, None], height[height <= 0][None, :, None]
    crossing = above[:, None] + (below[None] - above[:, None]) * (up / (up - down))
    return np.vstack([above, crossing.reshape(-1, 3)])


def arrow(start: Array, end: Array, radius: float, color: Color, on_top: bool = False) -> Body:
    """An arrow from `start` (3,) to `end` (3,) [m] with a shaft of `radius` [m]."""
    length = float(np.linalg.norm(end - start))
    direction = (end - start) / length
    head = min(5.0 * radius, 0.6 * length)
    profile = np.array(
        ((0, 0), (radius, 0), (radius, length - head), (2.4 * radius, length - head), (0, length))
    )
    solid = trimesh.creation.revolve(profile, sections=32)
    t, b = tangents(direction)
    T = make_transform(np.column_stack([t, np.cross(direction, t), direction]), start)
    moved = body(solid.vertices, solid.faces, color, T)
    return Body(moved.triangles, color, on_top=on_top)


def plate(low: Array, high: Array, top: float, thickness: float, color: Color) -> Body:
    """A flat box over [low, high] (2,) [m] whose upper face is at `top` [m]."""
    solid = trimesh.creation.box(bounds=((*low, top - thickness), (*high, top)))
    return body(solid.vertices, solid.faces, color)


def best_azimuth(bodies: tuple[Body, ...], directions: Array | None = None) -> float:
    """From where [rad] most of every body is seen, corners are seen as corners, and directions (n, 3) are not
    foreshortened."""
    points = np.concatenate([b.triangles.reshape(-1, 3) for b in bodies])
    caster = Caster(bodies)
    areas, scores = [], []
    for azimuth in AZIMUTHS:
        camera = fit_camera(points, azimuth, ELEVATION, 96, 96)
        hits = caster.first(camera.eye, camera.rays(1).reshape(-1, 3))
        seen = hits.body >= 0
        scale = (
            np.linalg.norm(camera.eye - points.mean(axis=0)) / camera.focal
        ) ** 2  # [m2] that a pixel covers
        areas.append(np.bincount(hits.body[seen], minlength=len(bodies)) * scale)
        # a view on one or two sides alone is flat: the share of the third largest tells
        _, count = np.unique(np.round(hits.normal[seen] * 2), axis=0, return_counts=True)
        sides = np.sort(count)[-3:] / seen.sum()
        depth = min(1.0, 4.0 * float(sides[0])) if len(sides) == 3 else 0.0
        along = np.zeros(1)
        if directions is not None and len(directions):
            along = np.linalg.norm(directions @ camera.axes[:2].T, axis=1)
        scores.append(0.6 * depth + 0.3 * float(along.mean()) + 0.4 * float(along.min()))
    shares = np.array(areas) / np.maximum(np.max(areas, axis=0), 1e-12)
    return float(
        AZIMUTHS[
            int(np.argmax(np.round(np.array(scores) + shares.min(axis=1) + 0.5 * shares.mean(axis=1), 6)))
        ]
    )


def spread_grasps(Ts_tcp: Array, count: int, to_camera: Array) -> Indices:
    """Rows of up to `count` of n TCP poses (n, 4, 4) that differ most, those first whose hand leaves the view
    free.

    Args:
        to_camera: unit direction (3,) from the scene to the camera.
    """
    out = -Ts_tcp[:, :3, 2]
    free = np.flatnonzero(out @ to_camera < 0.45)
    allowed = free if len(free) else np.arange(len(Ts_tcp))
    palms = apply_all(Ts_tcp[allowed], np.array((0.0, 0.0, -0.08)))
    features = np.hstack([palms, 0.02 * np.abs(Ts_tcp[allowed, :3, 0])])
    chosen = (
        [int(np.argmax(np.round(palms[:, 2] - 0.05 * (out[allowed] @ to_camera), 9)))] if len(allowed) else []
    )
    distance = np.full(len(allowed), np.inf)
    while chosen and len(chosen) < min(count, len(allowed)):
        distance = np.minimum(distance, np.linalg.norm(features - features[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(np.round(distance, 9))))
    return np.asarray(allowed[chosen], int)


def apply_all(Ts: Array, point: Array) -> Array:
    """One point (3,) in each of n frames (n, 4, 4), seen from outside (n, 3)."""
    moved: Array = Ts[:, :3, :3] @ point + Ts[:, :3, 3]
    return moved
