"""Planar facets of a mesh: coplanar triangles of one normal merged into one polygon, and which of them tile a
curved face."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from soma_bullet.frames import Array, Indices, apply, tangents

NORMAL_TOLERANCE = np.deg2rad(0.5)  # [rad] two triangles lie in one facet below this angle
PLANE_TOLERANCE = 1e-5  # [m] ... and below this distance between their planes
SMOOTH = np.deg2rad(36.0)  # [rad] an edge that bends by less may lie in a curved face: ten sections a turn
LARGEST_SAGITTA = 3e-4  # [m] a facet that departs by more from a smooth surface is meant to be flat


@dataclass(frozen=True, eq=False)
class Facet:
    """A planar face, possibly of several polygons with holes.

    Attributes:
        normal: outward unit normal (3,).
        offset: normal . x for every x of the plane [m].
        basis: two unit tangents (2, 3) that span the plane.
        polygon: the face in the basis' coordinates [m].
        turn: angle by which a curved face turns from one side of the facet to the other [rad]; 0 where the
            face is flat.
        sagitta: how far that curved face departs from the facet [m].
    """

    normal: Array
    offset: float
    basis: Array
    polygon: BaseGeometry
    turn: float = 0.0
    sagitta: float = 0.0

    @property
    def area(self) -> float:
        """Area [m2]."""
        return float(self.polygon.area)

    def lift(self, points: Array) -> Array:
        """Points (n, 2) of the plane as points (n, 3)."""
        return np.asarray(points) @ self.basis + self.normal * self.offset

    def moved(self, transform: Array) -> Facet:
        """The same face after a rigid motion (4, 4)."""
        normal = transform[:3, :3] @ self.normal
        basis = self.basis @ transform[:3, :3].T
        origin = apply(transform, self.normal * self.offset)
        shift = basis @ origin
        polygon = shapely.transform(self.polygon, lambda xy: xy + shift)
        return replace(self, normal=normal, offset=float(normal @ origin), basis=basis, polygon=polygon)


def planar_facets(vertices: Array, faces: Array) -> tuple[Facet, ...]:
    """Merge the triangles (f, 3) over vertices (v, 3) [m] into planar facets, largest first.

    Triangles of one plane become one facet whether or not they touch, so the result does not depend on the
    tessellation."""
    triangles = vertices[faces]
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    doubled_area = np.linalg.norm(cross, axis=1)
    kept = doubled_area > 1e-14
    triangles, normals = triangles[kept], cross[kept] / doubled_area[kept, None]
    doubled_area = doubled_area[kept]
    offsets = np.einsum("ij,ij->i", normals, triangles[:, 0])
    owner = np.full(len(triangles), -1)
    seeds: list[int] = []
    for seed in np.argsort(-doubled_area, kind="stable"):
        if owner[seed] >= 0:
            continue
        same = (owner < 0) & (normals @ normals[seed] > np.cos(NORMAL_TOLERANCE))
        near = np.flatnonzero(same)
        same[near] &= np.abs(triangles[near] @ normals[seed] - offsets[seed]).max(axis=1) < PLANE_TOLERANCE
        owner[same] = len(seeds)
        seeds.append(int(seed))
    bends = _bends(np.asarray(faces)[kept], owner, normals[seeds])
    facets = [
        _merge(normals[seed], offsets[seed], triangles[owner == k], bends[k]) for k, seed in enumerate(seeds)
    ]
    return tuple(sorted(facets, key=lambda facet: -round(facet.area, 12)))


def _bends(faces: Array, owner: Indices, normals: Array) -> list[list[float]]:
    """For each facet the angles [rad] of its edges to neighbours that might continue it smoothly.

    faces: triangles (f, 3); owner: the facet of each (f,); normals: of the facets (k, 3).
    """
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    order = np.lexsort(edges.T)
    paired = (edges[order[1:]] == edges[order[:-1]]).all(axis=1)
    pairs = owner[np.column_stack([order[:-1], order[1:]])[paired] // 3]
    pairs = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)
    angles = np.arccos(np.clip(np.einsum("ij,ij->i", normals[pairs[:, 0]], normals[pairs[:, 1]]), -1, 1))
    bends: list[list[float]] = [[] for _ in normals]
    for (first, second), angle in zip(pairs, angles, strict=True):
        if NORMAL_TOLERANCE < angle < SMOOTH:
            bends[first].append(float(angle))
            bends[second].append(float(angle))
    return bends


def _merge(normal: Array, offset: float, triangles: Array, bends: list[float]) -> Facet:
    basis = np.stack(tangents(normal))
    flat = triangles @ basis.T
    merged = shapely.union_all([Polygon(corners) for corners in flat], grid_size=1e-9).simplify(1e-7)
    if not bends:
        return Facet(normal, float(offset), basis, merged)
    sides = np.array(merged.minimum_rotated_rectangle.exterior.coords)
    width = float(np.linalg.norm(np.diff(sides, axis=0), axis=1).min())
    # an arc over the chord `width` that turns by the angle between the facets
    turn = max(bends)
    sagitta = width * turn / 8
    if sagitta > LARGEST_SAGITTA:
        return Facet(normal, float(offset), basis, merged)
    return Facet(normal, float(offset), basis, merged, turn, sagitta)


def outline_vertices(polygon: BaseGeometry) -> Array:
    """Corners (n, 2) of the convex hull of a geometry, counter-clockwise, collinear ones dropped; a line has
    two."""
    hull = shapely.orient_polygons(polygon.convex_hull.simplify(1e-6))
    return np.array(hull.exterior.coords[:-1] if isinstance(hull, Polygon) else hull.coords)


def polygons(geometry: BaseGeometry) -> list[Polygon]:
    """The simple polygons of a geometry; lines and points are dropped."""
    if isinstance(geometry, Polygon):
        return [] if geometry.is_empty else [geometry]
    if isinstance(geometry, MultiPolygon) or hasattr(geometry, "geoms"):
        return [part for piece in geometry.geoms for part in polygons(piece)]
    return []
