"""Stability of one piece against fixed neighbours, as the paper measures it (Sec. IV-B).

The paper leaves the friction cones unbounded; here every generator is bounded by KAPPA weights of the piece, and the wrench
set is the convex hull of the bounded generators and of no contact at all.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import ConvexHull

from soma_bullet.assembly.contacts import Contact
from soma_bullet.frames import Array, tangents

KAPPA = 10.0  # bound of a contact force, in weights of the piece
SIDES = 6  # of the friction pyramid (paper: "an inversed 6-side pyramid")
INTERIOR = 1e-6  # the origin counts as inside beyond this distance


def contact_wrenches(
    contacts: Sequence[Contact], center_of_mass: Array, radius: float, friction: Array, turn: float = 0.0
) -> Array:
    """Generators (m, 6) of the wrench set of a piece, forces above torques / radius.

    Args:
        contacts: patches with their normals into the piece.
        center_of_mass: (3,) [m].
        radius: largest distance of a vertex from the centre of mass [m]: makes torques comparable with forces.
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
    """Distance of the origin from the boundary of conv({0} u kappa * generators) + gravity if it is inside, else 0.

    Unit: weights of the piece. Source: paper Sec. IV-B, s = min{d | d in convexhull(W)}.
    """
    if len(generators) < 6:
        return 0.0
    gravity = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
    points = np.unique(np.round(np.vstack([np.zeros(6), kappa * generators]), 12), axis=0) + gravity
    if np.linalg.matrix_rank(points - points[0], tol=1e-9) < 6:
        return 0.0
    # many points are coplanar: joggled by about 1e-9 (QJ) they give simplices; merged (Q12) into wide facets they may hide the
    # nearest one, by up to a thousandth, and take twice as long
    hull = ConvexHull(points, qhull_options="QJ")
    distance = round(float((-hull.equations[:, -1]).min()), 7)
    return distance if distance > INTERIOR else 0.0
