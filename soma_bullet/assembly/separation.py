"""Separating-axis tests between convex bodies, vectorised over many poses of one of them.

Source: S. Gottschalk, M. Lin, D. Manocha, "OBBTree", SIGGRAPH 1996; the candidate axes of two polytopes are the face
normals of either and the cross products of their edges.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from soma_bullet.assembly.hulls import Hull, unique_directions
from soma_bullet.frames import Array


def zonotope_separation(centres: Array, generators: Array, hulls: Sequence[Hull]) -> Array:
    """Largest gap over the separating axes between n zonotopes and the nearest of some polytopes.

    A zonotope is centre + sum of [-1, 1] * generator: a box has three generators, a box swept along a line four.

    Args:
        centres: (n, 3) [m].
        generators: (n, g, 3) [m].
        hulls: polytopes in the same frame.

    Returns:
        (n,) [m]: positive is a gap (a lower bound of the distance), negative a penetration depth; +inf without polytopes.
    """
    separation = np.full(len(centres), np.inf)
    if not len(centres):
        return separation
    g = generators.shape[1]
    first, second = np.triu_indices(g, 1)
    own = np.cross(generators[:, first], generators[:, second])  # (n, pairs, 3)
    for hull in hulls:
        fixed = np.broadcast_to(hull.axes, (len(centres), *hull.axes.shape))
        crossed = np.cross(generators[:, :, None], hull.edges[None, None]).reshape(len(centres), -1, 3)
        axes = np.concatenate([own, fixed, crossed], axis=1)
        length = np.linalg.norm(axes, axis=2)
        usable = length > 1e-9
        axes = axes / np.where(usable, length, 1.0)[..., None]
        middle = np.einsum("nak,nk->na", axes, centres)
        reach = np.abs(np.einsum("nak,ngk->nag", axes, generators)).sum(axis=2)
        projected = axes @ hull.vertices.T  # (n, a, v)
        gap = np.maximum(projected.min(axis=2) - middle - reach, middle - reach - projected.max(axis=2))
        separation = np.minimum(separation, np.where(usable, gap, -np.inf).max(axis=1))
    return separation


def plane_separation(centres: Array, generators: Array, height: float) -> Array:
    """Gap (n,) [m] of n zonotopes above the half-space z < height; negative below."""
    return centres[:, 2] - np.abs(generators[:, :, 2]).sum(axis=1) - height


def swept_separation(moving: Sequence[Hull], sweep: Array, fixed: Sequence[Hull]) -> float:
    """Gap [m] between polytopes swept along `sweep` (3,) [m] and fixed ones; negative is a penetration depth."""
    smallest = np.inf
    length = np.linalg.norm(sweep)
    line = sweep[None] / length if length > 0 else np.zeros((0, 3))
    for body in moving:
        edges = np.vstack([body.edges, line])
        normals = np.vstack([body.axes, np.cross(line.repeat(len(body.edges), 0), body.edges)]) if length > 0 else body.axes
        for other in fixed:
            crossed = np.cross(edges[:, None], other.edges[None]).reshape(-1, 3)
            axes = np.vstack([normals, other.axes, crossed])
            norms = np.linalg.norm(axes, axis=1)
            axes = axes[norms > 1e-9] / norms[norms > 1e-9, None]
            axes = unique_directions(axes) if len(axes) < 64 else axes
            along = axes @ sweep
            mine = axes @ body.vertices.T
            theirs = axes @ other.vertices.T
            low, high = mine.min(1) + np.minimum(along, 0), mine.max(1) + np.maximum(along, 0)
            gap = np.maximum(theirs.min(1) - high, low - theirs.max(1)).max()
            smallest = min(smallest, float(gap))
    return smallest
