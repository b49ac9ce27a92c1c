"""Contacts between workpieces, and between workpieces and the support: patches, and where there is none edges
and corners.

A patch is the planar polygon that two opposite facets share (shapely clips one against the other); coplanar
patches of one body pair are one patch. Facets that tile a curved face touch within the angle and the depth of
their tessellation; they give points and normals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from soma_bullet.assembly.contact import ANGLE_TOLERANCE, GAP_TOLERANCE, SUPPORT, Contact
from soma_bullet.assembly.edge_contacts import Surface, pair_edges, support_edges, without_grazing
from soma_bullet.assembly.facets import LARGEST_SAGITTA, Facet, outline_vertices
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.frames import Array, Mask, readonly, tangents

__all__ = ["ANGLE_TOLERANCE", "GAP_TOLERANCE", "SUPPORT", "Contact", "find_contacts"]

SMALLEST_AREA = 1e-6  # [m2]
SMALLEST_WIDTH = 2e-6  # [m]
SMALLEST_STRIP = 1e-9  # [m2] of a curved face's facets


@dataclass(frozen=True, eq=False)
class _Patch:
    """What two facets share: normal (3,) from the first, plane offset, corners (k, 3), area, and gap along
    the normal."""

    normal: Array
    offset: float
    points: Array
    area: float
    gap: float


def find_contacts(pieces: Sequence[Workpiece], goals: Array, support_height: float) -> tuple[Contact, ...]:
    """All contacts among pieces at poses (n, 4, 4) and with the support plane z = support_height [m]."""
    facets = [
        tuple(facet.moved(goal) for facet in piece.facets)
        for piece, goal in zip(pieces, np.asarray(goals), strict=True)
    ]
    boxes = [np.array([[*f.lift(np.array(f.polygon.envelope.exterior.coords))] for f in fs]) for fs in facets]
    lows, highs = [b.min(axis=1) for b in boxes], [b.max(axis=1) for b in boxes]
    surfaces = []
    for k, (piece, goal) in enumerate(zip(pieces, np.asarray(goals), strict=True)):
        edges, corners = piece.edges
        surfaces.append(Surface.of(facets[k], edges.moved(goal), corners.moved(goal), lows[k], highs[k]))
    contacts: list[Contact] = []
    for a in range(len(pieces)):
        gap = pieces[a].clearance + GAP_TOLERANCE
        patches = _support_patches(a, facets[a], support_height, gap)
        contacts += patches + support_edges(a, surfaces[a], support_height, gap, patches)
        for b in range(a + 1, len(pieces)):
            gap = pieces[a].clearance + pieces[b].clearance + GAP_TOLERANCE
            near = np.all(lows[a].min(0) < highs[b].max(0) + gap) and np.all(
                lows[b].min(0) < highs[a].max(0) + gap
            )
            if near:
                reach = gap + 2 * LARGEST_SAGITTA
                close = (lows[a][:, None] < highs[b] + reach).all(axis=2) & (
                    lows[b] < highs[a][:, None] + reach
                ).all(axis=2)
                patches = _pair_patches(a, b, facets[a], facets[b], gap, close)
                contacts += patches + pair_edges(a, b, surfaces[a], surfaces[b], gap, patches)
    return tuple(without_grazing(contacts, GAP_TOLERANCE))


def _support_patches(piece: int, facets: Sequence[Facet], height: float, gap: float) -> list[Contact]:
    found = []
    for facet in facets:
        if facet.normal[2] > -np.cos(ANGLE_TOLERANCE + facet.turn / 2):
            continue
        points = facet.lift(shapely.get_coordinates(facet.polygon))
        low = points[:, 2] - height
        if facet.turn == 0.0:
            if abs(np.median(low)) <= gap:
                found.append(_Patch(-facet.normal, -facet.offset, points, facet.area, float(np.median(low))))
        elif (np.abs(low) <= gap + facet.sagitta).any():
            # a curved face rests on the points that are low enough
            points = points[np.abs(low) <= gap + facet.sagitta]
            found.append(_Patch(np.array([0.0, 0.0, 1.0]), height, points, facet.area, 0.0))
    return _merged(SUPPORT, piece, found)


def _pair_patches(
    a: int, b: int, facets_a: Sequence[Facet], facets_b: Sequence[Facet], gap: float, close: Mask
) -> list[Contact]:
    normals_a, normals_b = (np.array([f.normal for f in fs]) for fs in (facets_a, facets_b))
    turns_a, turns_b = (np.array([f.turn for f in fs]) for fs in (facets_a, facets_b))
    opposite = normals_a @ normals_b.T < -np.cos(ANGLE_TOLERANCE + (turns_a[:, None] + turns_b) / 2)
    found = []
    for i, j in np.argwhere(opposite & close):
        first, second = facets_a[i], facets_b[j]
        patch = (
            _curved_patch(first, second, gap)
            if first.turn or second.turn
            else _flat_patch(first, second, gap)
        )
        if patch is not None:
            found.append(patch)
    return _merged(a, b, found)


def _flat_patch(first: Facet, second: Facet, gap: float) -> _Patch | None:
    """What two flat faces share: the second lies in the first's plane, its corners projected into the first's
    basis."""
    distances = second.lift(shapely.get_coordinates(second.polygon)) @ first.normal - first.offset
    if abs(np.median(distances)) > gap:
        return None
    shared = _opened(first.polygon.intersection(_projected(second, first)))
    if shared.area <= SMALLEST_AREA:
        return None
    corners = first.lift(shapely.get_coordinates(shared))
    return _Patch(first.normal, first.offset, corners, shared.area, float(np.median(distances)))


def _curved_patch(first: Facet, second: Facet, gap: float) -> _Patch | None:
    """What two facets share of which at least one tiles a curved face: points and a normal; the area decides
    nothing."""
    gap += first.sagitta + second.sagitta
    corners = second.lift(shapely.get_coordinates(second.polygon.envelope))
    distances = corners @ first.normal - first.offset
    if distances.min() > gap or distances.max() < -gap:
        return None
    shared = first.polygon.intersection(_projected(second, first))
    if shared.area < SMALLEST_STRIP:
        return None
    points = first.lift(shapely.get_coordinates(shared))
    apart = (second.offset - points @ second.normal) / (
        first.normal @ second.normal
    )  # along the first's normal
    points, apart = points[np.abs(apart) <= gap], apart[np.abs(apart) <= gap]
    if not len(points):
        return None
    flat = [facet.normal * sign for facet, sign in ((first, 1.0), (second, -1.0)) if not facet.turn]
    normal = flat[0] if flat else first.normal - second.normal
    normal = normal / np.linalg.norm(normal)
    points = points + apart[:, None] / 2 * first.normal
    return _Patch(normal, float((points @ normal).mean()), points, shared.area, 0.0)


def _projected(second: Facet, first: Facet) -> shapely.Geometry:
    """The second facet's polygon seen along the first's normal, in the first's basis."""
    return shapely.transform(second.polygon, lambda xy: second.lift(xy) @ first.basis.T)


def _opened(shape: shapely.Geometry) -> shapely.Geometry:
    """The shape without the lines, points and slivers that faces share where they only meet at an edge."""
    inner = shape.buffer(-SMALLEST_WIDTH / 2, join_style="mitre", mitre_limit=50.0)
    return inner.buffer(SMALLEST_WIDTH / 2, join_style="mitre", mitre_limit=50.0)


def _merged(a: int, b: int, found: list[_Patch]) -> list[Contact]:
    """Join coplanar patches of one body pair; the patch lies midway between the two faces."""
    groups: list[list[_Patch]] = []
    for patch in found:
        for group in groups:
            other = group[0]
            if (
                patch.normal @ other.normal > np.cos(ANGLE_TOLERANCE)
                and abs(patch.offset - other.offset) < GAP_TOLERANCE
            ):
                group.append(patch)
                break
        else:
            groups.append([patch])
    contacts = []
    for group in groups:
        normal, offset, gap = group[0].normal, group[0].offset, group[0].gap
        basis = np.stack(tangents(normal))
        outline = outline_vertices(
            shapely.multipoints(np.vstack([patch.points for patch in group]) @ basis.T)
        )
        points = outline @ basis + normal * (offset + (0.0 if a == SUPPORT else gap / 2))
        contacts.append(
            Contact(a, b, readonly(normal), readonly(points), float(sum(patch.area for patch in group)))
        )
    return contacts
