"""What is wrong with a piece, or with the goals of an assembly, that a plan would only trip over later."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import manifold3d
import numpy as np

from soma_bullet.assembly.contacts import SUPPORT
from soma_bullet.assembly.decomposition import NotDecomposableError
from soma_bullet.assembly.hulls import Hull
from soma_bullet.assembly.model import Assembly
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.frames import Indices, apply

SMALLEST, LARGEST = 0.002, 1.0  # [m] plausible sizes of a piece; outside them the unit is the likelier cause
LARGEST_CLEARANCE = 0.25  # of the thinnest part
OPPOSITE = np.deg2rad(15.0)  # [rad] between faces that count as the two sides of a wall
LARGEST_OVERLAP = 1e-4  # of the smaller piece's volume
LARGEST_SINKING = 1e-5  # [m] of a goal below the support
SEARCH = 1000.0  # [mm] within which the nearest neighbour of a lost piece is looked for


def piece_faults(piece: Workpiece) -> Iterator[str]:
    """Faults of the piece by itself: size, shape, clearance."""
    where = f"piece {piece.name!r}"
    extents = np.ptp(piece.vertices, axis=0)
    if not SMALLEST <= extents.max() <= LARGEST:
        size = " x ".join(f"{extent * 1e3:.4g}" for extent in extents)
        yield (
            f"{where}: its size is {size} mm, and pieces between {SMALLEST * 1e3:g} mm and "
            f"{LARGEST * 1e3:g} mm are expected; "
            "is unit, or mesh_unit, right?"
        )
        return
    try:
        decomposition = piece.decomposition
    except NotDecomposableError as error:
        yield f"{where}: {error}"
        return
    thinnest = min(
        _thickness(part, faces)
        for part, faces in zip(decomposition.parts, decomposition.solid_faces, strict=True)
    )
    if piece.clearance >= LARGEST_CLEARANCE * thinnest:
        yield (
            f"{where}: clearance {piece.clearance * 1e3:g} mm eats a part that is {thinnest * 1e3:.4g} mm "
            f"thin; "
            f"it must be below {LARGEST_CLEARANCE * thinnest * 1e3:.4g} mm"
        )
    elif 2 * piece.chamfer >= thinnest - 2 * piece.clearance:
        half = thinnest / 2 - piece.clearance
        yield (
            f"{where}: chamfer {piece.chamfer * 1e3:g} mm leaves nothing of a face of a part that is "
            f"{thinnest * 1e3:.4g} mm "
            f"thin; it must be below {half * 1e3:.4g} mm"
        )


def _thickness(part: Hull, faces: Indices) -> float:
    """Smallest distance [m] between two opposite faces of a part that both bound the piece; a cut inside it
    does not move."""
    if len(faces) == len(part.normals):
        return float(np.ptp(part.vertices @ part.axes.T, axis=0).min())
    normals, offsets = part.normals[faces], part.offsets[faces]
    opposite = normals @ normals.T < -np.cos(OPPOSITE)
    return float(np.where(opposite, offsets[:, None] + offsets, np.inf).min(initial=np.inf))


def goal_faults(assembly: Assembly, whole: bool) -> list[str]:
    """Faults of the goals: overlaps and goals below the support; where the assembly is whole, also what
    floats."""
    bodies = [_manifold(assembly, piece) for piece in range(len(assembly.pieces))]
    faults = [*_overlaps(assembly, bodies), *_sunk(assembly)]
    return faults or ([*_floating(assembly, bodies)] if whole else [])


def _manifold(assembly: Assembly, piece: int) -> manifold3d.Manifold:
    """The piece at its goal [mm]."""
    vertices = apply(assembly.goals[piece], assembly.pieces[piece].vertices) * 1e3
    return manifold3d.Manifold(manifold3d.Mesh64(vertices, assembly.pieces[piece].faces.astype(np.uint64)))


def _overlaps(assembly: Assembly, bodies: list[manifold3d.Manifold]) -> Iterator[str]:
    for (a, body_a), (b, body_b) in combinations(enumerate(bodies), 2):
        shared = body_a ^ body_b
        smaller = min(body_a.volume(), body_b.volume())
        if shared.volume() > LARGEST_OVERLAP * smaller + _tessellation(
            assembly.pieces[a], assembly.pieces[b]
        ):
            box = np.reshape(shared.bounding_box(), (2, 3))
            size = " x ".join(f"{extent:.4g}" for extent in box[1] - box[0])
            yield (
                f"pieces {assembly.names[a]!r} and {assembly.names[b]!r}: their goals overlap by "
                f"{shared.volume():.4g} mm3, "
                f"{size} mm ({shared.volume() / smaller:.2%} of the smaller)"
            )


def _tessellation(first: Workpiece, second: Workpiece) -> float:
    """Volume [mm3] by which two pieces overlap where facets tile a curved face that they share, each in its
    own way."""
    curved = [[(f.area, f.sagitta) for f in piece.facets if f.turn] for piece in (first, second)]
    if not all(curved):
        return 0.0
    depth = sum(max(sagitta for _, sagitta in facets) for facets in curved)
    return min(sum(area for area, _ in facets) for facets in curved) * depth * 1e9


def _sunk(assembly: Assembly) -> Iterator[str]:
    for name, gap in zip(assembly.names, _heights(assembly), strict=True):
        if gap < -LARGEST_SINKING:
            support = f"the support at {assembly.support.height * 1e3:g} mm"
            yield f"piece {name!r}: its goal reaches {-gap * 1e3:.4g} mm below {support}"


def _heights(assembly: Assembly) -> list[float]:
    """How high each piece hovers above the support at its goal [m]."""
    return [
        float(apply(goal, piece.vertices)[:, 2].min() - assembly.support.height)
        for piece, goal in zip(assembly.pieces, assembly.goals, strict=True)
    ]


def _floating(assembly: Assembly, bodies: list[manifold3d.Manifold]) -> Iterator[str]:
    """Pieces that no chain of contacts joins to the support."""
    heights = _heights(assembly)
    standing = {contact.body_b for contact in assembly.contacts if contact.body_a == SUPPORT}
    if not standing:
        yield f"nothing stands on the support: the lowest goal is {min(heights) * 1e3:.4g} mm above it"
    neighbours: dict[int, set[int]] = {piece: set() for piece in range(len(bodies))}
    for contact in assembly.contacts:
        if contact.body_a != SUPPORT:
            neighbours[contact.body_a].add(contact.body_b)
            neighbours[contact.body_b].add(contact.body_a)
    left = set(range(len(bodies)))
    while left:
        group, border = set(), {min(left)}
        while border:
            group |= border
            border = set().union(*(neighbours[piece] for piece in border)) - group
        left -= group
        if group & standing or (not standing and len(group) > 1):
            continue
        gaps = [(heights[a] * 1e3, "the support") for a in group]
        others = neighbours.keys() - group
        gaps += [
            (bodies[a].min_gap(bodies[b], SEARCH), repr(assembly.names[b])) for a in group for b in others
        ]
        gap, nearest = min(gaps)
        names = ", ".join(repr(assembly.names[piece]) for piece in sorted(group))
        what = f"piece {names} touches" if len(group) == 1 else f"pieces {names} hang together but touch"
        yield (f"{what} neither the support nor another piece: nearest is {nearest}, {gap:.4g} mm away")
