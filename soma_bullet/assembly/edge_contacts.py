"""Contacts along an edge and at a corner, between two pieces or with the support.

A contact counts where the surfaces next to it leave one normal, or a range of them that no face begins:
- an edge on a face: both faces of the edge rise from it. Two points, the face's normal;
- a corner on a face: all its edges rise from it. One point, the face's normal;
- an edge across an edge: one point, the normal of both edges;
- an edge along an edge: two points. Each direction that is a normal of both edges parts the bodies, and rigid
  bodies at rest may press along any of them. The normal is the middle of that range: the one that is farthest
  from slipping off either edge, and by symmetry that of two boards that lean against each other.
Faces that are merely in line press on nothing: edges of which one has a face in the plane of a face of the
other, turned against it, are left out (diagonal neighbours of polycubes), as are corners on an edge or a
corner. Where a patch with the same normal lies already, it stands for its rim: also where another body
carries a piece by it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from soma_bullet.assembly.contact import ANGLE_TOLERANCE, GAP_TOLERANCE, SUPPORT, Contact
from soma_bullet.assembly.edges import Corners, Edges
from soma_bullet.assembly.facets import Facet
from soma_bullet.frames import Array, Mask, readonly, tangents

FLUSH = np.deg2rad(0.1)  # [rad] a face that rises by less lies on the other one
ALONG = np.sin(ANGLE_TOLERANCE)  # an edge that rises by more touches with its end alone
LYING = 0.1  # a piece lies on what has so much of its normal upwards
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Surface:
    """What of one piece at its pose may touch others.

    Attributes:
        facets: its planar faces.
        edges, corners: convex ones.
        normals, offsets, turns: of the facets (f, 3), (f,) [m], (f,) [rad].
        low, high: corners (3,) [m] of the box around it.
    """

    facets: tuple[Facet, ...]
    edges: Edges
    corners: Corners
    normals: Array
    offsets: Array
    turns: Array
    low: Array
    high: Array

    @classmethod
    def of(
        cls, facets: tuple[Facet, ...], edges: Edges, corners: Corners, lows: Array, highs: Array
    ) -> Surface:
        """The surface with these facets, in boxes from `lows` to `highs` (f, 3) [m], edges and corners."""
        normals = np.array([f.normal for f in facets])
        offsets, turns = np.array([f.offset for f in facets]), np.array([f.turn for f in facets])
        low, high = lows.min(axis=0), highs.max(axis=0)
        return cls(facets, edges, corners, normals, offsets, turns, low, high)

    def near(self, low: Array, high: Array, reach: float) -> tuple[Edges, Array, Array, Array]:
        """Edges, and corners, spokes and recesses, within `reach` [m] of a box."""
        ends = self.edges.ends
        touched = (ends.min(axis=1) <= high + reach).all(axis=1) & (ends.max(axis=1) >= low - reach).all(
            axis=1
        )
        points = self.corners.points
        inside = (points <= high + reach).all(axis=1) & (points >= low - reach).all(axis=1)
        return (
            self.edges.chosen(touched),
            points[inside],
            self.corners.spokes[inside],
            self.corners.recess[inside],
        )


@dataclass(frozen=True, eq=False)
class _Touch:
    """Points (k, 3) where a body touches, the unit normal (3,) out of the other into it, and both
    recesses."""

    points: Array
    normal: Array
    own: float
    other: float = 1.0


def support_edges(
    piece: int, surface: Surface, height: float, gap: float, patches: Sequence[Contact]
) -> list[Contact]:
    """Edges and corners by which a piece stands on the plane z = height [m], without those of its patches."""
    edges = surface.edges
    rises = edges.inwards[:, :, 2] > np.sin(FLUSH + edges.turns / 2)
    levels = edges.ends[:, :, 2] - height
    low = levels.min(axis=1)
    found = []
    for k in np.flatnonzero(rises.all(axis=1) & (np.abs(edges.along[:, 2]) < ALONG) & (np.abs(low) <= gap)):
        found.append(_Touch(_lowest(edges.ends[k], levels[k]), UP, -edges.recess[k, 2]))
    corners = surface.corners
    stands = (corners.spokes[:, :, 2] > ALONG).all(axis=1) & (np.abs(corners.points[:, 2] - height) <= gap)
    found += [_Touch(corners.points[k][None], UP, -corners.recess[k, 2]) for k in np.flatnonzero(stands)]
    contacts = [_contact(SUPPORT, piece, touch) for touch in found]
    return [c for c in contacts if not _within(c, patches, gap)]


def pair_edges(
    a: int, b: int, first: Surface, second: Surface, gap: float, patches: Sequence[Contact]
) -> list[Contact]:
    """Edges and corners at which two pieces touch, within a gap [m], without those of their patches."""
    edges_a, *corners_a = first.near(second.low, second.high, gap)
    edges_b, *corners_b = second.near(first.low, first.high, gap)
    contacts = [
        _contact(b, a, touch).into(b)
        for touch in (*_on_faces(edges_a, second, gap), *_at_faces(corners_a, second, gap))
    ]
    contacts += [
        _contact(a, b, touch)
        for touch in (*_on_faces(edges_b, first, gap), *_at_faces(corners_b, first, gap))
    ]
    if len(edges_a.ends) and len(edges_b.ends):
        contacts += [_contact(a, b, t) for t in _across(edges_a, edges_b, gap)]
        contacts += [_contact(a, b, t) for t in _beside(edges_a, edges_b, gap)]
    return [c for c in contacts if not _within(c, patches, gap)]


def _contact(a: int, b: int, touch: _Touch) -> Contact:
    """The contact of body b, whose points and normal are given, with body a."""
    points, normal = readonly(touch.points), readonly(touch.normal)
    return Contact(a, b, normal, points, 0.0, float(touch.other), float(touch.own))


def _lowest(ends: Array, levels: Array) -> Array:
    """What of a line (2, 3) is higher by less than GAP_TOLERANCE than its lower end, given the levels (2,)
    [m] of both."""
    rise = float(np.ptp(levels))
    if rise <= GAP_TOLERANCE:
        return ends
    low = int(levels.argmin())
    return np.stack([ends[low], ends[low] + (ends[1 - low] - ends[low]) * GAP_TOLERANCE / rise])


def _on_faces(edges: Edges, surface: Surface, gap: float) -> list[_Touch]:
    """Edges of one body on faces of another."""
    normals, found = surface.normals.T, []
    levels = edges.ends @ normals - surface.offsets  # (e, 2, f)
    rises = edges.inwards @ normals > np.sin(FLUSH + (edges.turns[..., None] + surface.turns) / 2)
    lies = np.abs(edges.along @ normals) < ALONG
    near = (levels.min(axis=1) <= gap) & (levels.max(axis=1) >= -gap)
    for e, f in np.argwhere(rises.all(axis=1) & lies & near):
        facet, ends = surface.facets[f], edges.ends[e]
        line = shapely.LineString(ends @ facet.basis.T)
        if _inside(facet).intersection(line).length < GAP_TOLERANCE:
            continue
        shared = facet.polygon.intersection(line)
        step = ends[1] - ends[0]
        flat = facet.basis @ step
        at = (shapely.get_coordinates(shared) - facet.basis @ ends[0]) @ flat / (flat @ flat)
        points = ends[0] + np.array([[at.min()], [at.max()]]) * step
        level = points @ facet.normal - facet.offset
        if abs(level.min()) > gap:
            continue
        points = _lowest(points, level)
        points = points - 0.5 * (points @ facet.normal - facet.offset)[:, None] * facet.normal
        found.append(_Touch(points, facet.normal, -edges.recess[e] @ facet.normal))
    return found


def _inside(facet: Facet) -> shapely.Geometry:
    """A face without its rim, where what touches it slips off."""
    return facet.polygon.buffer(-GAP_TOLERANCE, join_style="mitre")


def _at_faces(corners: Sequence[Array], surface: Surface, gap: float) -> list[_Touch]:
    """Corners of one body, given as points, spokes and recesses, on faces of another."""
    points, spokes, recess = corners
    levels = points @ surface.normals.T - surface.offsets  # (c, f)
    rises = (spokes @ surface.normals.T > ALONG + np.sin(surface.turns / 2)).all(axis=1)
    found = []
    for c, f in np.argwhere(rises & (np.abs(levels) <= gap)):
        facet = surface.facets[f]
        if _inside(facet).contains(shapely.Point(facet.basis @ points[c])):
            point = points[c] - 0.5 * levels[c, f] * facet.normal
            found.append(_Touch(point[None], facet.normal, -recess[c] @ facet.normal))
    return found


def _boxed(first: Edges, second: Edges, gap: float) -> Mask:
    """Pairs (e, g) of edges whose boxes are within a gap."""
    low_a, high_a = first.ends.min(axis=1)[:, None], first.ends.max(axis=1)[:, None]
    low_b, high_b = second.ends.min(axis=1), second.ends.max(axis=1)
    return np.asarray(((low_a <= high_b + gap) & (low_b <= high_a + gap)).all(axis=2))


def _across(first: Edges, second: Edges, gap: float) -> list[_Touch]:
    """Edges that cross, normals into the second body."""
    along_a, along_b = first.along, second.along
    i, j = np.nonzero(_boxed(first, second, gap) & (np.abs(along_a @ along_b.T) < np.cos(ANGLE_TOLERANCE)))
    normal = np.cross(along_a[i], along_b[j])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    into_a = np.einsum("kij,kj->ki", first.inwards[i], normal)
    normal *= -np.sign(into_a[:, :1])  # out of the first body
    out_a = -np.einsum("kij,kj->ki", first.inwards[i], normal)
    into_b = np.einsum("kij,kj->ki", second.inwards[j], normal)
    sharp = (out_a > np.sin(FLUSH + first.turns[i] / 2)) & (into_b > np.sin(FLUSH + second.turns[j] / 2))
    kept = sharp.all(axis=1)
    found = []
    for e, g, n in zip(i[kept], j[kept], normal[kept], strict=True):
        (p, p_end), (q, q_end) = first.ends[e], second.ends[g]
        # p + s (p_end - p) + apart n = q + t (q_end - q)
        s, t, apart = np.linalg.solve(np.stack([p_end - p, q - q_end, n], axis=1), q - p)
        rim_a = GAP_TOLERANCE / np.linalg.norm(p_end - p)
        rim_b = GAP_TOLERANCE / np.linalg.norm(q_end - q)
        if abs(apart) <= gap and rim_a < s < 1 - rim_a and rim_b < t < 1 - rim_b:
            point = p + s * (p_end - p) + apart / 2 * n
            found.append(_Touch(point[None], n, second.recess[g] @ -n, first.recess[e] @ n))
    return found


def _beside(first: Edges, second: Edges, gap: float) -> list[_Touch]:
    """Edges along each other, normals into the second body."""
    along_a, along_b = first.along, second.along
    opposite = np.einsum("eiv,gjv->egij", first.normals, second.normals).min(axis=(2, 3))
    in_line = opposite < -np.cos(ANGLE_TOLERANCE)  # faces of one plane, turned against each other
    parallel = np.abs(along_a @ along_b.T) >= np.cos(ANGLE_TOLERANCE)
    found = []
    for e, g in np.argwhere(_boxed(first, second, gap) & parallel & ~in_line):
        d, start = along_a[e], first.ends[e, 0]
        normal = _middle_normal(first.normals[e], first.inwards[e], second.normals[g], second.inwards[g], d)
        if normal is None:
            continue
        at = (second.ends[g] - start) @ d
        reach = np.array([max(at.min(), 0.0), min(at.max(), np.linalg.norm(first.ends[e, 1] - start))])
        if reach[1] - reach[0] < GAP_TOLERANCE:
            continue
        mine = start + reach[:, None] * d
        share = (reach - at[0]) / (at[1] - at[0])
        theirs = second.ends[g, 0] + share[:, None] * (second.ends[g, 1] - second.ends[g, 0])
        apart = theirs - mine
        aside = np.abs(apart @ np.cross(normal, d))
        if (np.abs(apart @ normal) <= gap).all() and (aside <= GAP_TOLERANCE).all():
            recess = second.recess[g] @ -normal, first.recess[e] @ normal
            found.append(_Touch((mine + theirs) / 2, normal, *recess))
    return found


def _middle_normal(
    normals_a: Array, inwards_a: Array, normals_b: Array, inwards_b: Array, along: Array
) -> Array | None:
    """Middle of the directions that point out of one edge and into another one, given the normals (2, 3) and
    inward vectors (2, 3) of both; None where they are too few to tell."""
    rays = np.vstack([normals_a, -normals_b])
    rays = rays - np.outer(rays @ along, along)
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    both = (rays @ inwards_a.T < ALONG).all(axis=1) & (rays @ inwards_b.T > -ALONG).all(axis=1)
    rays = rays[both]
    if len(rays) < 2:
        return None
    cosines = rays @ rays.T
    if cosines.min() > np.cos(ANGLE_TOLERANCE):
        return None
    i, j = np.unravel_index(cosines.argmin(), cosines.shape)
    middle = rays[i] + rays[j]
    return np.asarray(middle / np.linalg.norm(middle))


def without_grazing(contacts: Sequence[Contact], gap: float) -> list[Contact]:
    """The contacts without the edges and corners that a piece merely grazes: those which a patch by which it
    lies on another body, in the same plane within a gap [m], has at its rim. The patch carries it there."""
    patches: dict[int, list[Contact]] = {}
    for c in contacts:
        if c.area > 0:
            for body in (c.body_a, c.body_b):
                patches.setdefault(body, []).append(c.into(body))
    kept = []
    for c in contacts:
        upper = c.body_b if c.normal[2] > 0 else c.body_a
        lies = c.area > 0 or abs(c.normal[2]) < LYING or upper == SUPPORT
        if lies or not _within(c.into(upper), patches.get(upper, []), gap):
            kept.append(c)
    return kept


def _within(contact: Contact, patches: Sequence[Contact], gap: float) -> bool:
    """Whether one of some patches, with the same normal, has the contact's points already."""
    for patch in patches:
        if contact.normal @ patch.normal < np.cos(ANGLE_TOLERANCE):
            continue
        basis = np.stack(tangents(patch.normal))
        hull = shapely.MultiPoint(patch.points @ basis.T).convex_hull.buffer(2 * GAP_TOLERANCE)
        level = np.abs((contact.points - patch.points[0]) @ patch.normal)
        if level.max() <= 2 * gap and hull.covers(shapely.MultiPoint(contact.points @ basis.T)):
            return True
    return False
