"""Contact patches between workpieces, and between workpieces and the support.

A patch is the planar polygon that two opposite facets share (shapely clips one against the other); coplanar patches of one
body pair are one patch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely

from soma_bullet.assembly.facets import Facet, outline_vertices
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.frames import Array, readonly, tangents

SUPPORT = -1  # index of the support where the index of a piece may stand
ANGLE_TOLERANCE = np.deg2rad(2.0)  # [rad] between opposite normals
GAP_TOLERANCE = 1e-4  # [m] beyond the fit gap, either sign
SMALLEST_AREA = 1e-6  # [m2]
SMALLEST_WIDTH = 2e-6  # [m]


@dataclass(frozen=True, eq=False)
class Contact:
    """A planar patch.

    Attributes:
        body_a, body_b: indices of the pieces; SUPPORT for the support.
        normal: unit normal (3,) from a into b.
        points: corners (k, 3) [m] of the patch's convex hull: for wrenches they stand for all its points.
        area: [m2] of the patch itself.
    """

    body_a: int
    body_b: int
    normal: Array
    points: Array
    area: float

    def into(self, piece: int) -> Contact:
        """The same patch with its normal pointing into `piece`."""
        if piece == self.body_b:
            return self
        return replace(self, body_a=self.body_b, body_b=self.body_a, normal=-self.normal)


def find_contacts(pieces: Sequence[Workpiece], goals: Array, support_height: float) -> tuple[Contact, ...]:
    """All patches among pieces at poses (n, 4, 4) and with the support plane z = support_height [m]."""
    facets = [tuple(facet.moved(goal) for facet in piece.facets) for piece, goal in zip(pieces, np.asarray(goals), strict=True)]
    boxes = [np.array([[*f.lift(np.array(f.polygon.envelope.exterior.coords))] for f in fs]) for fs in facets]
    lows, highs = [b.min(axis=1) for b in boxes], [b.max(axis=1) for b in boxes]
    patches = []
    for a in range(len(pieces)):
        patches += _support_patches(a, facets[a], support_height, pieces[a].clearance + GAP_TOLERANCE)
        for b in range(a + 1, len(pieces)):
            gap = pieces[a].clearance + pieces[b].clearance + GAP_TOLERANCE
            near = np.all(lows[a].min(0) < highs[b].max(0) + gap) and np.all(lows[b].min(0) < highs[a].max(0) + gap)
            if near:
                patches += _pair_patches(a, b, facets[a], facets[b], gap)
    return tuple(patches)


def _support_patches(piece: int, facets: Sequence[Facet], height: float, gap: float) -> list[Contact]:
    down = [f for f in facets if f.normal[2] < -np.cos(ANGLE_TOLERANCE) and abs(-f.offset - height) <= gap]
    return _merged(SUPPORT, piece, [(f, f.polygon, height + f.offset) for f in down], flip=True)


def _pair_patches(a: int, b: int, facets_a: Sequence[Facet], facets_b: Sequence[Facet], gap: float) -> list[Contact]:
    normals_a, normals_b = (np.array([f.normal for f in fs]) for fs in (facets_a, facets_b))
    opposite = normals_a @ normals_b.T < -np.cos(ANGLE_TOLERANCE)
    found = []
    for i, j in np.argwhere(opposite):
        first, second = facets_a[i], facets_b[j]
        # second lies in first's plane: its corners projected into first's basis
        corners = second.lift(shapely.get_coordinates(second.polygon))
        distances = corners @ first.normal - first.offset
        if abs(np.median(distances)) > gap:
            continue
        flat = shapely.transform(second.polygon, lambda xy, s=second, f=first: s.lift(xy) @ f.basis.T)
        shared = _opened(first.polygon.intersection(flat))
        if shared.area > SMALLEST_AREA:
            found.append((first, shared, float(np.median(distances))))
    return _merged(a, b, found, flip=False)


def _opened(shape: shapely.Geometry) -> shapely.Geometry:
    """The shape without the lines, points and slivers that faces share where they only meet at an edge."""
    inner = shape.buffer(-SMALLEST_WIDTH / 2, join_style="mitre", mitre_limit=50.0)
    return inner.buffer(SMALLEST_WIDTH / 2, join_style="mitre", mitre_limit=50.0)


def _merged(a: int, b: int, found: list[tuple[Facet, shapely.Geometry, float]], flip: bool) -> list[Contact]:
    """Join coplanar patches of one body pair; the patch lies midway between the two faces."""
    groups: list[list[tuple[Facet, shapely.Geometry, float]]] = []
    for item in found:
        facet = item[0]
        for group in groups:
            other = group[0][0]
            if facet.normal @ other.normal > np.cos(ANGLE_TOLERANCE) and abs(facet.offset - other.offset) < GAP_TOLERANCE:
                group.append(item)
                break
        else:
            groups.append([item])
    contacts = []
    for group in groups:
        facet, _, gap = group[0]
        lifted = np.vstack([f.lift(shapely.get_coordinates(shape)) for f, shape, _ in group])
        basis = np.stack(tangents(facet.normal))
        outline = outline_vertices(shapely.multipoints(lifted @ basis.T))
        points = outline @ basis + facet.normal * (facet.offset + (0.0 if flip else gap / 2))
        normal = -facet.normal if flip else facet.normal
        contacts.append(Contact(a, b, readonly(normal), readonly(points), float(sum(shape.area for _, shape, _ in group))))
    return contacts
