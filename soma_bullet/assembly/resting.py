"""Resting poses of a piece on a plane: the facets of its convex hull over which its centre of mass lies."""

from __future__ import annotations

import numpy as np
import shapely
from scipy.spatial import ConvexHull, QhullError

from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.frames import Array, apply

# [rad], [m] a resting pose that less upsets would tip at a touch
STEADY_TILT, STEADY_MARGIN = np.deg2rad(10.0), 2e-3
SMALLEST_TILT = np.deg2rad(5.0)  # [rad] a pose that a smaller tilt upsets is no resting pose


def resting_poses(piece: Workpiece) -> Array:
    """T_plane_piece (k, 4, 4), most stable first.

    The real body (inset by its clearance) lies on z = 0, its centre of mass above the origin.
    """
    hull = ConvexHull(piece.vertices)
    found: list[tuple[float, Array]] = []
    for normal, offset in _planes(hull):
        height = -offset - normal @ piece.center_of_mass
        margin = _support_margin(piece.vertices, normal, offset, piece.center_of_mass)
        tilt = np.arctan2(margin, height)
        if tilt > SMALLEST_TILT:
            pose = np.eye(4)
            pose[:3, :3] = _down(normal)
            pose[:3, 3] = -pose[:3, :3] @ piece.center_of_mass
            pose[2, 3] = -(pose[:3, :3] @ piece.vertices.T)[2].min() - piece.clearance
            found.append((float(tilt), pose))
    return np.array([pose for _, pose in sorted(found, key=lambda item: -round(item[0], 9))]).reshape(
        -1, 4, 4
    )


def steady_poses(piece: Workpiece) -> Array:
    """T_plane_piece (k, 4, 4) of the resting poses that no touch upsets, most stable first.

    The centre of mass lies at least STEADY_MARGIN inside what the piece stands on, and a tilt of STEADY_TILT
    about any edge of it falls back. Narrow facets of a round side, on which a piece rolls, are out by either.
    Where none is steady, the most stable one counts."""
    poses = resting_poses(piece)
    steady = []
    for pose in poses:
        vertices = apply(pose, piece.vertices)
        low = vertices[:, 2].min()
        base = shapely.multipoints(vertices[vertices[:, 2] < low + 1e-6][:, :2]).convex_hull
        com = apply(pose, piece.center_of_mass)
        margin = base.exterior.distance(shapely.Point(com[:2])) if base.geom_type == "Polygon" else 0.0
        steady.append(margin > STEADY_MARGIN and np.arctan2(margin, com[2] - low) > STEADY_TILT)
    return poses[steady] if any(steady) else poses[:1]


def _planes(hull: ConvexHull) -> list[tuple[Array, float]]:
    planes: list[tuple[Array, float]] = []
    for equation in hull.equations:
        if all(equation[:3] @ normal < 1 - 1e-7 for normal, _ in planes):
            planes.append((equation[:3], float(equation[3])))
    return planes


def _support_margin(vertices: Array, normal: Array, offset: float, com: Array) -> float:
    """Distance [m] of the centre of mass, seen along the normal, from the edge of the facet; negative
    outside."""
    feet = vertices[np.abs(vertices @ normal + offset) < 1e-6]
    basis = _down(normal)[:2]
    flat = feet @ basis.T
    try:
        outline = ConvexHull(flat)
    except QhullError:
        return -np.inf
    return float(-(outline.equations[:, :2] @ (basis @ com) + outline.equations[:, 2]).max())


def _down(normal: Array) -> Array:
    """Rotation (3, 3) that turns `normal` to -z, nearest to a quarter turn about an axis of the piece."""
    z = -normal
    x = np.eye(3)[int(np.argmin(np.abs(z)))]
    x = x - z * (x @ z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])
