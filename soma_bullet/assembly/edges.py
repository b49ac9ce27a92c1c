"""Convex edges and corners of a body's own surface, from its planar facets: cuts inside it have none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from soma_bullet.assembly.facets import SMOOTH, Facet, polygons
from soma_bullet.frames import Array, Mask, apply

ON_LINE = 1e-5  # [m] between sides of two facets that are one edge
SHORTEST = 1e-4  # [m] of an edge; what is shorter comes from rounding
PARALLEL = np.cos(np.deg2rad(0.5))  # of two sides that are one edge
AT_CORNER = 1e-5  # [m] between ends of edges that meet


@dataclass(frozen=True, eq=False)
class Edges:
    """Straight convex edges at which two facets meet.

    Attributes:
        ends: (e, 2, 3) [m].
        normals: outward unit normals of the two facets (e, 2, 3).
        inwards: unit vectors (e, 2, 3) across the edge, along either facet into it.
        turns: of the facets (e, 2) [rad]; 0 where flat.
        recess: where the edge goes when both facets move inwards by 1 (e, 3), turned round.
    """

    ends: Array
    normals: Array
    inwards: Array
    turns: Array
    recess: Array

    @property
    def along(self) -> Array:
        """Unit vectors (e, 3) from the first end to the second."""
        along = self.ends[:, 1] - self.ends[:, 0]
        return np.asarray(along / np.linalg.norm(along, axis=1)[:, None])

    def moved(self, transform: Array) -> Edges:
        """The same edges after a rigid motion (4, 4)."""
        turn = transform[:3, :3].T
        ends = apply(transform, self.ends.reshape(-1, 3)).reshape(self.ends.shape)
        return Edges(ends, self.normals @ turn, self.inwards @ turn, self.turns, self.recess @ turn)

    def chosen(self, which: Mask) -> Edges:
        """Those that a mask (e,) names."""
        return Edges(
            self.ends[which],
            self.normals[which],
            self.inwards[which],
            self.turns[which],
            self.recess[which],
        )


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners at which all edges are convex.

    Attributes:
        points: (c, 3) [m].
        spokes: unit vectors (c, s, 3) from a corner along its edges; where there are fewer than s the first
            comes again.
        recess: where the corner goes when all its facets move inwards by 1 (c, 3), turned round.
    """

    points: Array
    spokes: Array
    recess: Array

    def moved(self, transform: Array) -> Corners:
        """The same corners after a rigid motion (4, 4)."""
        turn = transform[:3, :3].T
        return Corners(apply(transform, self.points), self.spokes @ turn, self.recess @ turn)


@dataclass(frozen=True, eq=False)
class _Sides:
    """Straight sides of all facets: ends (s, 2, 3) [m], inward unit vectors (s, 3), facet of each (s,)."""

    ends: Array
    inward: Array
    facet: Array


def convex_edges(facets: Sequence[Facet]) -> tuple[Edges, Corners]:
    """The convex edges of a body with the given planar facets, and its convex corners.

    Edges inside a curved face, between facets that tile it, are left out. Sides of the facets' outlines are
    compared, not triangles: the tessellation does not matter."""
    sides = _sides(facets)
    normals, turns = np.array([f.normal for f in facets]), np.array([f.turn for f in facets])
    pairs, ends = _shared(sides)
    first, second = sides.facet[pairs[:, 0]], sides.facet[pairs[:, 1]]
    bend = np.einsum("ij,ij->i", sides.inward[pairs[:, 0]], normals[second])
    both = np.stack([normals[first], normals[second]], axis=1)
    cosine = np.einsum("ij,ij->i", both[:, 0], both[:, 1])
    edges = Edges(
        ends,
        both,
        sides.inward[pairs],
        np.stack([turns[first], turns[second]], axis=1),
        both.sum(axis=1) / np.maximum(1 + cosine, 1e-9)[:, None],
    )
    convex = bend < -np.sin(np.deg2rad(0.5))
    smooth = (edges.turns > 0).all(axis=1) & (cosine > np.cos(SMOOTH))
    return edges.chosen(convex & ~smooth), _corners(edges, convex, smooth)


def _sides(facets: Sequence[Facet]) -> _Sides:
    ends, inward, owner = [], [], []
    for k, facet in enumerate(facets):
        for polygon in polygons(facet.polygon):
            polygon = shapely.orient_polygons(polygon)  # the inside is on the left
            for ring in (polygon.exterior, *polygon.interiors):
                points = facet.lift(shapely.get_coordinates(ring))
                steps = np.diff(points, axis=0)
                lengths = np.linalg.norm(steps, axis=1)
                kept = lengths > SHORTEST
                ends.append(np.stack([points[:-1], points[1:]], axis=1)[kept])
                inward.append(np.cross(facet.normal, steps[kept] / lengths[kept, None]))
                owner.append(np.full(int(kept.sum()), k))
    return _Sides(np.vstack(ends), np.vstack(inward), np.concatenate(owner))


def _shared(sides: _Sides) -> tuple[Array, Array]:
    """Pairs of sides (e, 2) of different facets that lie along each other, and the ends (e, 2, 3) of what
    they share."""
    start = sides.ends[:, 0]
    step = sides.ends[:, 1] - start
    length = np.linalg.norm(step, axis=1)
    along = step / length[:, None]
    middle, half = sides.ends.mean(axis=1), length / 2
    # a side runs the other way round in the neighbouring facet
    close = (along @ along.T < -PARALLEL) & (sides.facet[:, None] < sides.facet)
    i, j = np.nonzero(close)
    near = np.linalg.norm(middle[i] - middle[j], axis=1) < half[i] + half[j]
    i, j = i[near], j[near]
    at = np.einsum("kij,kj->ki", sides.ends[j] - start[i][:, None], along[i])
    off = sides.ends[j] - start[i][:, None] - at[..., None] * along[i][:, None]
    low, high = np.maximum(at.min(axis=1), 0.0), np.minimum(at.max(axis=1), length[i])
    kept = (np.linalg.norm(off, axis=2).max(axis=1) < ON_LINE) & (high - low > SHORTEST)
    i, j, reach = i[kept], j[kept], np.stack([low, high], axis=1)[kept]
    return np.stack([i, j], axis=1), start[i][:, None] + reach[..., None] * along[i][:, None]


def _corners(edges: Edges, convex: Mask, smooth: Mask) -> Corners:
    """Where the edges end; corners with a concave edge are left out, and those inside a curved face."""
    tips = edges.ends.reshape(-1, 3)
    spokes = np.stack([edges.along, -edges.along], axis=1).reshape(-1, 3)
    bad, sharp = np.repeat(~convex, 2), np.repeat(~smooth, 2)
    left = np.ones(len(tips), bool)
    points, rays, recess = [], [], []
    for k in range(len(tips)):
        if not left[k]:
            continue
        here = np.flatnonzero(left & (np.abs(tips - tips[k]).max(axis=1) < AT_CORNER))
        left[here] = False
        if bad[here].any() or len(here) < 3 or not sharp[here].any():
            continue
        normals = edges.normals[here // 2].reshape(-1, 3)
        points.append(tips[k])
        rays.append(spokes[here])
        recess.append(np.linalg.lstsq(normals, np.ones(len(normals)), rcond=None)[0])
    most = max((len(r) for r in rays), default=1)
    padded = [np.vstack([r, np.repeat(r[:1], most - len(r), axis=0)]) for r in rays]
    return Corners(
        np.array(points).reshape(-1, 3),
        np.array(padded).reshape(-1, most, 3),
        np.array(recess).reshape(-1, 3),
    )
