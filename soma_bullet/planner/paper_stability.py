"""Stability of one piece against fixed neighbours, as the paper measures it (Sec. IV-B).

The paper leaves the friction cones unbounded; here every generator is bounded by KAPPA weights of the piece,
and the wrench set is the convex hull of the bounded generators and of no contact at all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import ConvexHull

from soma_bullet.assembly.contacts import Contact
from soma_bullet.frames import Array, tangents

KAPPA = 10.0  # bound of a contact force, in weights of the piece
SIDES = 6  # of the friction pyramid (paper: "an inversed 6-side pyramid")
INTERIOR = 1e-6  # the origin counts as inside beyond this distance
BEYOND = 1e-9  # a point this far outside a facet is outside
ON_FACET = 1e-7  # points this near to the final facet define its plane
FLAT = 1e-8  # a hull thinner than this has no inside


def contact_wrenches(
    contacts: Sequence[Contact], center_of_mass: Array, radius: float, friction: Array, turn: float = 0.0
) -> Array:
    """Generators (m, 6) of the wrench set of a piece, forces above torques / radius.

    Args:
        contacts: patches with their normals into the piece.
        center_of_mass: (3,) [m].
        radius: largest distance of a vertex from the centre of mass [m]: makes torques comparable with
            forces.
        friction: coefficient for each contact (k,).
        turn: rotation of the pyramids about their normals [rad].
    """
    wrenches = []
    angles = turn + 2 * np.pi * np.arange(SIDES) / SIDES
    for contact, mu in zip(contacts, friction, strict=True):
        t, b = tangents(contact.normal)
        forces = contact.normal + mu * (np.cos(angles)[:, None] * t + np.sin(angles)[:, None] * b)
        torques = np.cross((contact.points - center_of_mass)[:, None], forces[None]) / radius
        wrenches.append(np.hstack([np.tile(forces, (len(contact.points), 1)), torques.reshape(-1, 3)]))
    return np.vstack(wrenches) if wrenches else np.zeros((0, 6))


def wrench_margin(generators: Array, kappa: float = KAPPA) -> float:
    """Distance of the origin from the boundary of conv({0} u kappa * generators) + gravity if it is inside,
    else 0.

    Unit: weights of the piece. Source: paper Sec. IV-B, s = min{d | d in convexhull(W)}.
    """
    if len(generators) < 6:
        return 0.0
    gravity = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
    points = np.unique(np.round(np.vstack([np.zeros(6), kappa * generators]), 12), axis=0) + gravity
    distance = round(smallest_offset(points), 9)
    return distance if distance > INTERIOR else 0.0


def smallest_offset(points: Array) -> float:
    """Distance of the origin from the nearest facet of conv(points (n, d)); outside a facet's, below 0; 0 for
    a flat hull.

    The expanding polytope algorithm (G. van den Bergen, "Proximity queries and penetration depth computation
    on 3D game objects", GDC 2001) in d dimensions: of a simplex that grows towards the points only the
    nearest facet is pushed out. One that no point lies beyond is a facet of the whole hull, and none is
    nearer: of thousands of facets a few hundred are made."""
    try:
        return _expanded(points)
    except np.linalg.LinAlgError:  # a facet that is flat to the last digit; joggled, none is
        return float((-ConvexHull(points, qhull_options="QJ").equations[:, -1]).min())


def _expanded(points: Array) -> float:
    dimension = points.shape[1]
    simplex = _wide_simplex(points)
    if simplex is None:
        return 0.0
    centre = points[simplex].mean(axis=0)
    about = points - centre  # a facet is {x : x . normal = 1}
    corners = np.sort([[j for j in simplex if j != k] for k in simplex], axis=1)
    others = np.array([[j for j in range(dimension) if j != k] for k in range(dimension)])
    powers = len(points) ** np.arange(dimension - 1, dtype=np.int64)  # a number for each ridge
    normals, lengths = _planes(about[corners])
    while True:
        offsets = (1 + normals @ centre) / lengths
        nearest = int(offsets.argmin())
        beyond = (about @ normals[nearest] - 1) / lengths[nearest]
        farthest = int(beyond.argmax())
        if beyond[farthest] <= BEYOND:
            on = about[
                np.abs(beyond) < ON_FACET
            ]  # all of them: the corners of a sliver would tell its plane badly
            normal = np.linalg.lstsq(on, np.ones(len(on)), rcond=None)[0]
            return float((1 + normal @ centre) / np.linalg.norm(normal))
        # the facets that the farthest point sees give way to those between it and their rim
        seen = (normals @ about[farthest] - 1) / lengths > BEYOND / 2
        ridges = corners[seen][:, others].reshape(-1, dimension - 1)
        _, first, count = np.unique(ridges @ powers, return_index=True, return_counts=True)
        rim = ridges[first[count == 1]]
        new = np.sort(np.column_stack([rim, np.full(len(rim), farthest)]), axis=1)
        more, more_lengths = _planes(about[new])
        corners, normals = np.vstack([corners[~seen], new]), np.vstack([normals[~seen], more])
        lengths = np.concatenate([lengths[~seen], more_lengths])


def _wide_simplex(points: Array) -> list[int] | None:
    """Indices of d + 1 points, each far from the span of those before; None where all points lie in a
    plane."""
    chosen = [int(np.argmax(((points - points.mean(axis=0)) ** 2).sum(axis=1)))]
    rest = points - points[chosen[0]]
    for _ in range(points.shape[1]):
        squared = (rest * rest).sum(axis=1)
        chosen.append(int(squared.argmax()))
        if squared[chosen[-1]] < FLAT**2:
            return None
        axis = rest[chosen[-1]] / np.sqrt(squared[chosen[-1]])
        rest = rest - np.outer(rest @ axis, axis)
    return chosen


def _planes(corners: Array) -> tuple[Array, Array]:
    """Normals (m, d) of the facets {x : x . normal = 1} with corners (m, d, d), and their lengths."""
    normals = np.asarray(np.linalg.solve(corners, np.ones((*corners.shape[:2], 1)))[:, :, 0], float)
    return normals, np.linalg.norm(normals, axis=1)
