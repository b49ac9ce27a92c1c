"""Separating-axis tests between convex bodies, vectorised over many poses of one of them.

Source: S. Gottschalk, M. Lin, D. Manocha, "OBBTree", SIGGRAPH 1996; the candidate axes of two polytopes are
the face normals of either and the cross products of their edges."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from soma_bullet.assembly.hulls import Hull, unique_directions
from soma_bullet.frames import Array

FAR = 0.005  # [m] beyond every margin that is asked for
SMALLEST_AXIS = 1e-9  # a shorter cross product comes from parallel edges


def zonotope_separation(centres: Array, generators: Array, hulls: Sequence[Hull]) -> Array:
    """Largest gap over the separating axes between n zonotopes and the nearest of some polytopes.

    A zonotope is centre + sum of [-1, 1] * generator: a box has three generators, a box swept along a line
    four. Pairs that an axis parts by more than FAR are not looked at along further ones, which could only add
    to the gap.

    Args:
        centres: (n, 3) [m].
        generators: (n, g, 3) [m].
        hulls: polytopes in the same frame.

    Returns:
        (n,) [m]: positive is a gap (a lower bound of the distance), negative a penetration depth; +inf
        without polytopes.
    """
    if not len(centres) or not len(hulls):
        return np.full(len(centres), np.inf)
    # boxes along the axes of the frame tell most pairs apart
    half = np.abs(generators).sum(axis=1)
    low, high = np.array([hull.bounds[0] for hull in hulls]), np.array([hull.bounds[1] for hull in hulls])
    gaps = np.maximum((centres - half)[None] - high[:, None], low[:, None] - (centres + half)[None]).max(
        axis=2
    )
    undecided = np.flatnonzero((gaps < FAR).any(axis=0))
    if len(undecided):
        gaps[:, undecided] = _gaps(centres[undecided], generators[undecided], hulls, gaps[:, undecided])
    return gaps.min(axis=0)


def _gaps(centres: Array, generators: Array, hulls: Sequence[Hull], gaps: Array) -> Array:
    """Gaps (h, n) [m] of n zonotopes from every hull, given lower bounds of them; those beyond FAR are left
    as they are."""
    # coordinates first: sums over them are then sums of whole arrays
    middle, spread = centres.T, np.moveaxis(generators, 2, 0)
    first, second = np.triu_indices(generators.shape[1], 1)
    own = _cross(spread[:, :, first], spread[:, :, second])
    at, reach = _span(own, middle, spread)
    for hull, gap in zip(hulls, gaps, strict=True):
        close = np.flatnonzero(gap < FAR)
        if len(close):
            gap[close] = np.maximum(gap[close], _widest_gap(own[:, close], (at[close], reach[close]), hull))
            shared = np.broadcast_to(hull.axes.T[:, None], (3, len(close), len(hull.axes)))
            gap[close] = np.maximum(
                gap[close], _widest_gap(shared, _span(shared, middle[:, close], spread[:, close]), hull)
            )
        near = close[gap[close] < FAR]
        if len(near):
            crossed = _cross(spread[:, near, :, None], hull.edges.T[:, None, None]).reshape(3, len(near), -1)
            gap[near] = np.maximum(
                gap[near], _widest_gap(crossed, _span(crossed, middle[:, near], spread[:, near]), hull)
            )
    return gaps


def pair_separation(first: tuple[Array, Array], second: tuple[Array, Array]) -> Array:
    """Largest gap (a, b) [m] over the separating axes between a zonotopes and b others; negative is a
    penetration depth.

    Gaps beyond FAR are not told apart.

    Args:
        first: centres (a, 3) [m] and generators (a, g, 3) [m].
        second: centres (b, 3) [m] and generators (b, h, 3) [m].
    """
    (centre_a, spread_a), (centre_b, spread_b) = first, second
    gap = np.full((len(centre_a), len(centre_b)), FAR)
    apart = np.linalg.norm(centre_a[:, None] - centre_b, axis=2)
    reach_a, reach_b = (np.linalg.norm(spread, axis=2).sum(axis=1) for spread in (spread_a, spread_b))
    i, j = np.nonzero(apart - reach_a[:, None] - reach_b < FAR)  # the bounding balls of the others are apart
    if not len(i):
        return gap
    # coordinates first: sums over them are then sums of whole arrays (3, pairs, generators)
    a, b = np.moveaxis(spread_a, 2, 0)[:, i], np.moveaxis(spread_b, 2, 0)[:, j]
    between = (centre_b[j] - centre_a[i]).T
    (p, q), (r, t) = np.triu_indices(a.shape[2], 1), np.triu_indices(b.shape[2], 1)
    widest = np.full(len(i), -np.inf)
    for axes in (_cross(a[:, :, p], a[:, :, q]), _cross(b[:, :, r], b[:, :, t]), None):
        left = np.flatnonzero(widest < FAR)
        if not len(left):
            break
        some_a, some_b = a[:, left], b[:, left]
        if axes is None:
            crossed = _cross(some_a[:, :, :, None], some_b[:, :, None, :]).reshape(3, len(left), -1)
        else:
            crossed = axes[:, left]
        at, reach = _span(crossed, between[:, left], np.concatenate([some_a, some_b], axis=2))
        length = np.sqrt((crossed * crossed).sum(axis=0))
        usable = length > SMALLEST_AXIS
        distance = np.where(usable, (np.abs(at) - reach) / np.where(usable, length, 1.0), -np.inf)
        widest[left] = np.maximum(widest[left], distance.max(axis=1))
    gap[i, j] = np.minimum(widest, FAR)
    return gap


def _cross(a: Array, b: Array) -> Array:
    """Cross products of vectors whose coordinates are the first axis."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _span(axes: Array, middle: Array, spread: Array) -> tuple[Array, Array]:
    """Middle and half width (n, a) of zonotopes seen along axes (3, n, a) of any length."""
    at = axes[0] * middle[0][:, None] + axes[1] * middle[1][:, None] + axes[2] * middle[2][:, None]
    reach = np.zeros(axes.shape[1:])
    for g in np.moveaxis(spread, 2, 0):
        reach += np.abs(axes[0] * g[0][:, None] + axes[1] * g[1][:, None] + axes[2] * g[2][:, None])
    return at, reach


def _widest_gap(axes: Array, span: tuple[Array, Array], hull: Hull) -> Array:
    """Largest gap (n,) [m] along axes (3, n, a) of any length; -inf where all of them vanish."""
    at, reach = span
    flat = axes.reshape(3, -1)
    if hull.box is not None:
        centre, box_axes, half = hull.box
        away = np.abs(at - (centre @ flat).reshape(at.shape))
        extent = np.abs((box_axes * half[:, None]) @ flat).sum(axis=0).reshape(at.shape)
        gap = away - extent - reach
    else:
        projected = hull.vertices @ flat
        low, high = projected.min(axis=0).reshape(at.shape), projected.max(axis=0).reshape(at.shape)
        gap = np.maximum(low - at, at - high) - reach
    length = np.sqrt((axes * axes).sum(axis=0))
    usable = length > SMALLEST_AXIS
    return np.where(usable, gap / np.where(usable, length, 1.0), -np.inf).max(axis=1, initial=-np.inf)


def plane_separation(centres: Array, generators: Array, height: float) -> Array:
    """Gap (n,) [m] of n zonotopes above the half-space z < height; negative below."""
    return centres[:, 2] - np.abs(generators[:, :, 2]).sum(axis=1) - height


def swept_separation(
    moving: Sequence[Hull], sweep: Array, fixed: Sequence[Hull], margin: float = 0.0
) -> float:
    """Gap [m] between polytopes swept along `sweep` (3,) [m] and fixed ones, along the axis that shows the
    most of it; negative is a penetration depth. A gap of more than `margin` [m] may be told too small, but
    not below that."""
    smallest = np.inf
    length = np.linalg.norm(sweep)
    line = sweep[None] / length if length > 0 else np.zeros((0, 3))
    for body in moving:
        edges = np.vstack([body.edges, line])
        normals = (
            np.vstack([body.axes, np.cross(line.repeat(len(body.edges), 0), body.edges)])
            if length > 0
            else body.axes
        )
        low, high = body.bounds[0] + np.minimum(sweep, 0.0), body.bounds[1] + np.maximum(sweep, 0.0)
        for other in fixed:
            apart = float(np.maximum(other.bounds[0] - high, low - other.bounds[1]).max())
            if apart > margin:  # their boxes tell: a gap along an axis of the frame
                smallest = min(smallest, apart)
                continue
            crossed = np.cross(edges[:, None], other.edges[None]).reshape(-1, 3)
            axes = np.vstack([normals, other.axes, crossed])
            norms = np.linalg.norm(axes, axis=1)
            axes = axes[norms > 1e-9] / norms[norms > 1e-9, None]
            axes = unique_directions(axes) if len(axes) < 64 else axes
            along = axes @ sweep
            mine = axes @ body.vertices.T
            theirs = axes @ other.vertices.T
            near, far = mine.min(1) + np.minimum(along, 0), mine.max(1) + np.maximum(along, 0)
            gap = np.maximum(theirs.min(1) - far, near - theirs.max(1)).max()
            smallest = min(smallest, float(gap))
    return smallest
