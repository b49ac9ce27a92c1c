"""Convex parts of any solid: exact where that is possible, measured and refused where it is not good enough.

In order of preference: all maximal boxes of a mesh that is made of boxes; the mesh itself where it is convex;
the pieces that remain when it is cut through its notches (exact); an approximate decomposition (CoACD), which
stands out of the mesh by an amount that is measured.

Sources: B. Chazelle, "Convex partitions of polyhedra", SIAM J. Comput. 13(3), 1984 (cuts through notches); X.
Wei et al., "Approximate convex decomposition for 3D meshes with collision-aware concavity and tree search",
SIGGRAPH 2022."""

from __future__ import annotations

import hashlib
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import manifold3d
import numpy as np
import trimesh
from scipy.spatial import QhullError

from soma_bullet.assembly.facets import Facet
from soma_bullet.assembly.hulls import Hull, box_parts, hull_of_points, winding_numbers
from soma_bullet.frames import Array, Indices

Kind = Literal["boxes", "convex", "cuts", "approximate"]

CONVEX_TOLERANCE = 1e-4  # relative volume that a hull may add to a mesh that counts as convex
NOTCH = np.deg2rad(1.0)  # [rad] an edge that opens outwards by more is cut
MOST_NOTCHES = 1200  # planes through them; a mesh with more is curved inwards and gets approximated
MOST_PARTS = 150
MOST_CUTS = 10 * MOST_PARTS
STRAIGHT = 1e-6  # relative volume that the hull of a convex cut may add
FILM = 5e-5  # [mm] ... and what is thinner than this
SLIVER = 1e-6  # of the volume: what a cut leaves below this is rounding
LARGEST_RATIO = 1.05  # volume of the parts' union in volumes of the mesh
LARGEST_DEVIATION = 1e-3  # [m] by which a part may stand out of the mesh
CONCAVITY = 0.02  # CoACD's threshold
MILLI = 1e3  # cuts are made in mm, where the library's tolerances fit
_VERSION = "3"  # of the cached parts


class NotDecomposableError(ValueError):
    """No decomposition is close enough to the mesh."""


@dataclass(frozen=True, eq=False)
class Decomposition:
    """Convex polytopes that stand for a solid.

    Attributes:
        parts: the polytopes, in the mesh's frame.
        kind: how they were found; all but `approximate` are exact.
        volume_ratio: volume of their union in volumes of the mesh.
        deviation: how far they stand out of the mesh [m].
        solid_faces: for each part which of its faces (f,) bound the solid; the others are cuts inside it.
    """

    parts: tuple[Hull, ...]
    kind: Kind
    volume_ratio: float
    deviation: float
    solid_faces: tuple[Indices, ...]

    def inset(self, distance: float) -> tuple[Hull, ...]:
        """The parts with every face of the solid moved inwards by `distance` [m]; what vanishes is left
        out."""
        shrunk = []
        for part, faces in zip(self.parts, self.solid_faces, strict=True):
            try:
                shrunk.append(part.inset(distance, faces))
            except (
                ValueError
            ):  # a thin part of many; where nothing is left the clearance is refused elsewhere
                continue
        return tuple(shrunk)


def decompose(vertices: Array, faces: Array, facets: tuple[Facet, ...]) -> Decomposition:
    """Convex parts of a closed mesh: vertices (v, 3) [m], outward triangles (f, 3), and its planar facets.

    Raises:
        NotDecomposableError: the closest decomposition exceeds LARGEST_RATIO or LARGEST_DEVIATION; says by
            how much.
    """
    boxes = box_parts(vertices, faces, np.array([facet.normal for facet in facets]))
    if boxes:
        return _exact(boxes, "boxes", facets)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if mesh.convex_hull.volume <= mesh.volume * (1 + CONVEX_TOLERANCE):
        return _exact([hull_of_points(np.asarray(vertices))], "convex", facets)
    kind, clouds = _cached_parts(vertices, faces)
    parts = [hull_of_points(points) for points in clouds]
    if kind == "cuts":
        return _exact(parts, "cuts", facets)
    ratio, deviation = _union_ratio(clouds, mesh), _deviation(parts, vertices, faces)
    if ratio > LARGEST_RATIO or deviation > LARGEST_DEVIATION:
        hull = mesh.convex_hull.volume / mesh.volume
        raise NotDecomposableError(
            f"is concave (its hull has {hull:.2f} x its volume) and no convex decomposition is close enough: "
            f"{len(parts)} parts have {ratio:.3f} x its volume and stand out by {deviation * 1e3:.2f} mm; "
            f"at most "
            f"{LARGEST_RATIO:g} x and {LARGEST_DEVIATION * 1e3:g} mm are accepted; cut the piece into "
            f"simpler ones, or model "
            "it with fewer inward curves"
        )
    return Decomposition(
        tuple(parts), "approximate", ratio, deviation, tuple(np.arange(len(p.normals)) for p in parts)
    )


def _exact(parts: list[Hull], kind: Kind, facets: tuple[Facet, ...]) -> Decomposition:
    if kind != "cuts":  # maximal boxes overlap: all of their faces may move
        return Decomposition(tuple(parts), kind, 1.0, 0.0, tuple(np.arange(len(p.normals)) for p in parts))
    normals, offsets = np.array([f.normal for f in facets]), np.array([f.offset for f in facets])
    solid = []
    for part in parts:
        same = (part.normals @ normals.T > np.cos(np.deg2rad(0.2))) & (
            np.abs(part.offsets[:, None] - offsets) < 1e-5
        )
        solid.append(np.flatnonzero(same.any(axis=1)))
    return Decomposition(tuple(parts), kind, 1.0, 0.0, tuple(solid))


def cut_at_notches(vertices: Array, faces: Array) -> list[Array] | None:
    """Corners (k, 3) [m] of the convex pieces of a closed mesh, cut at its notches; None if these are too
    many.

    Each cut goes through a notch and halves its angle; the one that resolves the most notches comes first.
    """
    whole = manifold3d.Manifold(manifold3d.Mesh64(np.asarray(vertices) * MILLI, np.asarray(faces, np.uint64)))
    if whole.status() != manifold3d.Error.NoError:
        return None
    smallest = SLIVER * whole.volume()
    waiting, convex = [whole], []
    for _ in range(MOST_CUTS):
        if not waiting:
            break
        body = waiting.pop()
        if body.hull().volume() <= body.volume() * (1 + STRAIGHT):
            convex.append(np.asarray(body.to_mesh64().vert_properties)[:, :3] / MILLI)
            continue
        planes = _notch_planes(body)
        if len(planes) > MOST_NOTCHES or len(convex) + len(waiting) > MOST_PARTS:
            return None
        split = (body.split_by_plane(plane[:3], plane[3]) for plane in planes)
        halves = next((pair for pair in split if min(half.volume() for half in pair) > 0.0), None)
        if halves is None:
            return None
        parts = [part for half in halves for part in half.decompose()]
        waiting += [part for part in parts if part.volume() > max(smallest, FILM * part.surface_area())]
    if waiting:
        return None
    return sorted(convex, key=lambda points: tuple(np.round(points.mean(axis=0), 9)))


def _notch_planes(body: manifold3d.Manifold) -> Array:
    """Planes (k, 4) [mm] that halve the notches of a body, those that resolve most of them first."""
    raw = body.to_mesh64()
    corners, triangles = np.asarray(raw.vert_properties)[:, :3], np.asarray(raw.tri_verts, int)
    points = corners[triangles]
    cross = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    double = np.linalg.norm(cross, axis=1)
    normals = cross / np.maximum(double, 1e-300)[:, None]
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    order = np.lexsort(edges.T)
    pairs = (order // 3).reshape(-1, 2)  # closed: every edge has two triangles
    first, second = pairs[:, 0], pairs[:, 1]
    ends = corners[edges[order[::2]]]
    angle = np.arccos(np.clip(np.einsum("ij,ij->i", normals[first], normals[second]), -1, 1))
    # the second triangle's far corner lies in front of the first one's plane: the edge opens inwards
    ahead = np.einsum("ij,ij->i", points[second].mean(axis=1) - ends[:, 0], normals[first])
    solid = (double[first] > 1e-9) & (double[second] > 1e-9)
    notch = np.flatnonzero((angle > NOTCH) & (ahead > 1e-7) & solid)
    # not along a face: a cut in the plane of a face leaves slivers
    along = ends[notch][:, 1] - ends[notch][:, 0]
    across = np.cross(normals[first[notch]] + normals[second[notch]], along)
    across /= np.linalg.norm(across, axis=1)[:, None]
    across *= np.where(across[np.arange(len(across)), np.abs(across).argmax(axis=1)] < 0, -1, 1)[:, None]
    planes = np.column_stack([across, np.einsum("ij,ij->i", across, ends[notch][:, 0])])
    _, unique = np.unique(np.round(planes, 6), axis=0, return_index=True)
    planes = planes[np.sort(unique)]
    through = (
        np.abs(np.einsum("ekj,pj->epk", ends[notch], planes[:, :3]) - planes[:, 3][None, :, None]).max(axis=2)
        < 1e-4
    )
    return planes[np.argsort(-np.round(np.linalg.norm(along, axis=1) @ through, 6), kind="stable")]


def _approximate(vertices: Array, faces: Array) -> list[Array]:
    """Corners of CoACD's convex parts."""
    import coacd

    coacd.set_log_level("error")
    found = coacd.run_coacd(
        coacd.Mesh(np.asarray(vertices), np.asarray(faces)),
        threshold=CONCAVITY, mcts_iterations=30, mcts_max_depth=2, seed=0,
    )  # fmt: skip
    return [np.asarray(points) for points, _ in found]


def _union_ratio(clouds: list[Array], mesh: trimesh.Trimesh) -> float:
    hulls = [manifold3d.Manifold.hull_points(points * MILLI) for points in clouds]
    union = manifold3d.Manifold.batch_boolean(hulls, manifold3d.OpType.Add)
    return float(union.volume() / MILLI**3 / mesh.volume)


def _deviation(parts: list[Hull], vertices: Array, faces: Array) -> float:
    """Largest distance [m] from the mesh of points on the parts' surfaces that lie outside it."""
    samples = []
    for part in parts:
        surface = trimesh.convex.convex_hull(part.vertices)
        spread, _ = trimesh.sample.sample_surface(surface, 60, seed=0)
        samples += [surface.vertices, surface.triangles_center, spread]
    points = np.unique(np.round(np.vstack(samples), 7), axis=0)
    outside = points[winding_numbers(vertices, faces, points) < 0.5]
    if not len(outside):
        return 0.0
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    _, distance, _ = trimesh.proximity.closest_point(mesh, outside)
    return float(distance.max())


def cache_folder() -> Path:
    """Where decompositions are kept by content."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "soma_bullet" / "parts"


def _cached_parts(vertices: Array, faces: Array) -> tuple[Kind, list[Array]]:
    """Cuts, or else an approximation; computed once for each mesh and kept by its content where the disk
    allows."""
    content = (
        _VERSION.encode()
        + np.ascontiguousarray(vertices).tobytes()
        + np.ascontiguousarray(faces, np.int64).tobytes()
    )
    file = cache_folder() / f"{hashlib.sha256(content).hexdigest()[:32]}.npz"
    try:
        with np.load(file) as kept:
            return str(kept["kind"]), [kept[f"part{k}"] for k in range(int(kept["count"]))]  # type: ignore[return-value]
    except (OSError, ValueError, KeyError):  # not there, or damaged: it is made anew
        pass
    kind: Kind = "cuts"
    clouds = cut_at_notches(vertices, faces)
    if clouds is None or not _fits(clouds, vertices, faces):
        kind, clouds = "approximate", _approximate(vertices, faces)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=file.parent, suffix=".npz", delete=False) as part:
            arrays = {"kind": np.array(kind), "count": np.array(len(clouds))}
            np.savez(part, **arrays, **{f"part{k}": points for k, points in enumerate(clouds)})  # type: ignore[arg-type]
        os.replace(part.name, file)
    except OSError:  # a read-only home is no reason to fail
        pass
    return kind, clouds


def _fits(clouds: list[Array], vertices: Array, faces: Array) -> bool:
    """Whether the hulls of the cut pieces have the mesh's volume together."""
    try:
        total = sum(trimesh.convex.convex_hull(points).volume for points in clouds)
    except QhullError:
        return False
    return bool(abs(total / trimesh.Trimesh(vertices, faces, process=False).volume - 1) < CONVEX_TOLERANCE)
