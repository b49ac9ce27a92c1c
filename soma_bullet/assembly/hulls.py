"""Convex polytopes, and the boxes that a mesh may be made of."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection

from soma_bullet.frames import Array, Indices, readonly


@dataclass(frozen=True, eq=False)
class Hull:
    """A convex polytope.

    Attributes:
        vertices: corners (v, 3) [m].
        normals: outward unit face normals (f, 3), one for each plane.
        offsets: normal . x on each plane (f,) [m].
        edges: unit edge directions (e, 3), one for each direction up to sign.
        box: (centre, axes, half extents) where the polytope is a box, else None.
    """

    vertices: Array
    normals: Array
    offsets: Array
    edges: Array
    box: tuple[Array, Array, Array] | None = None

    @cached_property
    def axes(self) -> Array:
        """Face normals (k, 3), one for each direction up to sign."""
        return unique_directions(self.normals)

    @cached_property
    def bounds(self) -> Array:
        """Smallest and largest coordinates (2, 3) [m]."""
        return np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    def moved(self, transform: Array) -> Hull:
        """The same polytope after a rigid motion (4, 4)."""
        rotation, shift = transform[:3, :3], transform[:3, 3]
        normals = self.normals @ rotation.T
        box = None
        if self.box is not None:
            centre, axes, half = self.box
            box = (centre @ rotation.T + shift, axes @ rotation.T, half)
        return Hull(
            self.vertices @ rotation.T + shift,
            normals,
            self.offsets + normals @ shift,
            self.edges @ rotation.T,
            box,
        )

    def inset(self, distance: float, faces: Indices | None = None) -> Hull:
        """The polytope with its faces, or only those at the indices `faces`, moved inwards by `distance` [m].

        Raises:
            ValueError: nothing is left.
        """
        if distance == 0.0 or (faces is not None and not len(faces)):
            return self
        if self.box is not None and (faces is None or len(faces) == len(self.normals)):
            centre, axes, half = self.box
            if np.any(half <= distance):
                raise ValueError(
                    f"an inset of {distance * 1e3:g} mm leaves nothing of a box of {2e3 * half.min():g} mm"
                )
            return box_hull(centre, axes, half - distance)
        steps = np.zeros(len(self.normals))
        steps[slice(None) if faces is None else faces] = distance
        planes = np.column_stack([self.normals, -(self.offsets - steps)])
        depth, inside = _deepest_point(planes)
        if depth <= 1e-9:
            raise ValueError(f"an inset of {distance * 1e3:g} mm leaves nothing of a polytope")
        return hull_of_points(HalfspaceIntersection(planes, inside).intersections)

    def cut(self, planes: Array) -> Hull:
        """What of the polytope lies in half-spaces (k, 4) normal . x + offset <= 0.

        Raises:
            ValueError: nothing is left.
        """
        if not len(planes):
            return self
        every = np.vstack([np.column_stack([self.normals, -self.offsets]), planes])
        depth, inside = _deepest_point(every)
        if depth <= 1e-9:
            raise ValueError("nothing of a polytope is left by its cuts")
        return hull_of_points(HalfspaceIntersection(every, inside).intersections)


def _deepest_point(planes: Array) -> tuple[float, Array]:
    """Radius [m] and centre (3,) of the largest ball inside half-spaces (f, 4) normal . x + offset <= 0."""
    result = linprog(
        (0, 0, 0, -1),
        A_ub=np.column_stack([planes[:, :3], np.ones(len(planes))]),
        b_ub=-planes[:, 3],
        bounds=(None, None),
    )
    return (float(result.x[3]), result.x[:3]) if result.success else (0.0, np.zeros(3))


def unique_directions(directions: Array, tolerance: float = 1e-4) -> Array:
    """The unit directions (n, 3) without repeats up to sign (k, 3), in order of appearance."""
    kept = np.empty((len(directions), 3))
    count = 0
    for direction in directions:
        if (np.abs(np.abs(kept[:count] @ direction) - 1.0) > tolerance**2).all():
            kept[count] = direction
            count += 1
    return kept[:count].copy()


def box_hull(centre: Array, axes: Array, half: Array) -> Hull:
    """A box as a Hull: centre (3,), axes (3, 3) with one unit axis a row, half extents (3,) [m]."""
    signs = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], float)
    vertices = centre + (signs * half) @ axes
    normals = np.vstack([axes, -axes])
    offsets = np.concatenate([axes @ centre + half, -(axes @ centre) + half])
    return Hull(
        readonly(vertices), readonly(normals), readonly(offsets), readonly(axes), (centre, axes, half)
    )


def hull_of_points(points: Array) -> Hull:
    """Convex hull of points (n, 3) [m], coplanar triangles merged; a box is recognised as such."""
    hull = ConvexHull(points)
    planes = np.empty((0, 4))
    edges: list[Array] = []
    for plane in hull.equations:
        if (planes[:, :3] @ plane[:3] < 1 - 1e-7).all():
            planes = np.vstack([planes, plane])
    for simplex, neighbours, plane in zip(hull.simplices, hull.neighbors, hull.equations, strict=True):
        for corner, neighbour in enumerate(neighbours):
            if plane[:3] @ hull.equations[neighbour][:3] < 1 - 1e-7:
                first, second = np.delete(simplex, corner)
                edge = points[second] - points[first]
                edges.append(edge / np.linalg.norm(edge))
    normals = planes[:, :3]
    directions = unique_directions(normals)
    if (
        len(normals) == 6
        and len(directions) == 3
        and np.allclose(directions @ directions.T, np.eye(3), atol=1e-6)
    ):
        reach = points @ directions.T
        low, high = reach.min(axis=0), reach.max(axis=0)
        return box_hull((low + high) / 2 @ directions, directions, (high - low) / 2)
    return Hull(
        readonly(points[hull.vertices]),
        readonly(normals),
        readonly(-planes[:, 3]),
        readonly(unique_directions(np.array(edges))),
    )


def winding_numbers(vertices: Array, faces: Array, points: Array) -> Array:
    """Generalised winding number (n,) of a closed mesh about points (n, 3): 1 inside, 0 outside.

    Source: A. van Oosterom, J. Strackee, "The solid angle of a plane triangle", IEEE Trans. Biomed. Eng.,
    1983."""
    a, b, c = (vertices[faces[:, k]][None] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    numerator = np.einsum("ijk,ijk->ij", a, np.cross(b, c))
    dot = lambda u, v: np.einsum("ijk,ijk->ij", u, v)  # noqa: E731
    denominator = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    return np.arctan2(numerator, denominator).sum(axis=1) / (2 * np.pi)


def box_parts(vertices: Array, faces: Array, facet_normals: Array) -> list[Hull] | None:
    """All maximal boxes of a mesh whose faces have three orthogonal directions; None for any other mesh.

    Every box inside the body lies in one of them, so that the union of the boxes inset by c is the body
    eroded by c."""
    axes = unique_directions(facet_normals)
    if len(axes) != 3 or not np.allclose(axes @ axes.T, np.eye(3), atol=1e-4):
        return None
    local = vertices @ axes.T
    ticks = [_distinct(local[:, k]) for k in range(3)]
    if np.prod([len(t) - 1 for t in ticks]) > 20_000:
        return None
    middles = [(t[1:] + t[:-1]) / 2 for t in ticks]
    grid = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1).reshape(-1, 3)
    filled = (winding_numbers(local, faces, grid) > 0.5).reshape([len(m) for m in middles])
    if np.linalg.det(axes) < 0:  # a mirrored frame turns the winding number's sign
        filled = (winding_numbers(local, faces[:, ::-1], grid) > 0.5).reshape(filled.shape)
    parts = []
    for low, high in _maximal_boxes(filled):
        corner_a = np.array([ticks[k][low[k]] for k in range(3)])
        corner_b = np.array([ticks[k][high[k]] for k in range(3)])
        parts.append(box_hull((corner_a + corner_b) / 2 @ axes, axes, (corner_b - corner_a) / 2))
    return parts


def _distinct(values: Array, tolerance: float = 1e-6) -> Array:
    ordered = np.sort(values)
    return ordered[np.concatenate([[True], np.diff(ordered) > tolerance])]


def _maximal_boxes(filled: NDArray[np.bool_]) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Index ranges [low, high) of all boxes of filled cells that no filled box contains."""
    total = np.zeros(np.array(filled.shape) + 1, int)
    total[1:, 1:, 1:] = filled.cumsum(0).cumsum(1).cumsum(2)

    def full(low: tuple[int, ...], high: tuple[int, ...]) -> bool:
        (a, b, c), (d, e, f) = low, high
        count = total[d, e, f] - total[a, e, f] - total[d, b, f] - total[d, e, c]
        count += total[a, b, f] + total[a, e, c] + total[d, b, c] - total[a, b, c]
        return bool(count == (d - a) * (e - b) * (f - c))

    start: list[tuple[tuple[int, ...], tuple[int, ...]]] = [
        ((int(i), int(j), int(k)), (int(i) + 1, int(j) + 1, int(k) + 1)) for i, j, k in np.argwhere(filled)
    ]
    seen, maximal = set(start), []
    while start:
        low, high = start.pop()
        grown = False
        for axis in range(3):
            for low_step, high_step in ((1, 0), (0, 1)):
                new_low = tuple(v - low_step * (k == axis) for k, v in enumerate(low))
                new_high = tuple(v + high_step * (k == axis) for k, v in enumerate(high))
                if new_low[axis] < 0 or new_high[axis] > filled.shape[axis] or not full(new_low, new_high):
                    continue
                grown = True
                if (new_low, new_high) not in seen:
                    seen.add((new_low, new_high))
                    start.append((new_low, new_high))
        if not grown:
            maximal.append((low, high))
    return sorted(maximal)
