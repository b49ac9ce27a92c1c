"""Planar facets of a mesh: coplanar triangles of one normal merged into one polygon."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry import MultiPolygon, Polygon
from shapely.geometry.base import BaseGeometry

from soma_bullet.frames import Array, apply, tangents

NORMAL_TOLERANCE = np.deg2rad(0.5)  # [rad] two triangles lie in one facet below this angle
PLANE_TOLERANCE = 1e-5  # [m] ... and below this distance between their planes


@dataclass(frozen=True, eq=False)
class Facet:
    """A planar face, possibly of several polygons with holes.

    Attributes:
        normal: outward unit normal (3,).
        offset: normal . x for every x of the plane [m].
        basis: two unit tangents (2, 3) that span the plane.
        polygon: the face in the basis' coordinates [m].
    """

    normal: Array
    offset: float
    basis: Array
    polygon: BaseGeometry

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
        return Facet(normal, float(normal @ origin), basis, shapely.transform(self.polygon, lambda xy: xy + shift))


def planar_facets(vertices: Array, faces: Array) -> tuple[Facet, ...]:
    """Merge the triangles (f, 3) over vertices (v, 3) [m] into planar facets, largest first.

    Triangles of one plane become one facet whether or not they touch, so the result does not depend on the tessellation.
    """
    triangles = vertices[faces]
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    doubled_area = np.linalg.norm(cross, axis=1)
    kept = doubled_area > 1e-14
    triangles, normals = triangles[kept], cross[kept] / doubled_area[kept, None]
    doubled_area = doubled_area[kept]
    offsets = np.einsum("ij,ij->i", normals, triangles[:, 0])
    free = np.ones(len(triangles), bool)
    facets = []
    for seed in np.argsort(-doubled_area, kind="stable"):
        if not free[seed]:
            continue
        same = free & (normals @ normals[seed] > np.cos(NORMAL_TOLERANCE))
        same &= np.abs(triangles @ normals[seed] - offsets[seed]).max(axis=1) < PLANE_TOLERANCE
        free &= ~same
        facets.append(_merge(normals[seed], offsets[seed], triangles[same]))
    return tuple(sorted(facets, key=lambda facet: -round(facet.area, 12)))


def _merge(normal: Array, offset: float, triangles: Array) -> Facet:
    basis = np.stack(tangents(normal))
    flat = triangles @ basis.T
    merged = shapely.union_all([Polygon(corners) for corners in flat], grid_size=1e-9)
    return Facet(normal, float(offset), basis, merged.simplify(1e-7))


def outline_vertices(polygon: BaseGeometry) -> Array:
    """Corners (n, 2) of the convex hull of a polygon, collinear ones dropped, counter-clockwise."""
    hull = shapely.orient_polygons(polygon.convex_hull.simplify(1e-6))
    return np.array(hull.exterior.coords[:-1])


def polygons(geometry: BaseGeometry) -> list[Polygon]:
    """The simple polygons of a geometry; lines and points are dropped."""
    if isinstance(geometry, Polygon):
        return [] if geometry.is_empty else [geometry]
    if isinstance(geometry, MultiPolygon) or hasattr(geometry, "geoms"):
        return [part for piece in geometry.geoms for part in polygons(piece)]
    return []
