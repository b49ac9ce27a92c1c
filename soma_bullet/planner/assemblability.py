"""Assemblability: how freely a piece goes in, and along which direction (paper Sec. IV-E; nine types).

Contact normals n_i into the piece leave the legal removal directions C = {d : n_i . d >= 0}. The type is
(dimension of C, dimension of its lineality space); the best direction maximises the smallest n_i . d."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from soma_bullet.assembly.contacts import Contact
from soma_bullet.frames import Array, Mask

Scale = Literal["finite", "ordinal"]
Rank = Callable[[Array], tuple[float, ...]]  # of a unit direction (3,)
Blockers = Callable[[Array], tuple[int, ...]]  # of a unit direction (3,)

UP = np.array([0.0, 0.0, 1.0])

SNAP = np.deg2rad(2.0)  # [rad] normals closer than this are one
SMALLEST_CLEARANCE = 0.02  # a smaller t* counts as none
IN_SPAN = 1 - 1e-9  # length of a unit vector, projected, that counts as lying in a span

TYPES = {
    (3, 3): "free",
    (3, 2): "plane",
    (3, 1): "wedge",
    (3, 0): "corner",
    (2, 2): "slot",
    (2, 1): "slot + bottom",
    (2, 0): "slot + bottom + wall",
    (1, 1): "peg through",
    (1, 0): "peg blind",
    (0, 0): "locked",
}
ORDINAL = {
    "free": np.inf, "plane": 10.0, "wedge": 10.0, "corner": 10.0, "slot": 9.0, "slot + bottom": 3.0,
    "slot + bottom + wall": 3.0, "peg through": 2.0, "peg blind": 1.0, "locked": 0.0,
}  # fmt: skip


@dataclass(frozen=True)
class Freedom:
    """What a set of contact normals leaves free.

    Attributes:
        type: one of the nine types of the paper, or `free`.
        clearance: t* = min n_i . d of the best removal direction, inside the span of the legal directions.
        best: unit removal direction (3,), or None where the piece is locked.
        alternatives: further legal removal directions (k, 3), to try when the best is blocked.
        span: orthonormal basis (m, 3) of the legal directions.
    """

    type: str
    clearance: float
    best: Array | None
    alternatives: Array
    span: Array


@dataclass(frozen=True)
class Assemblability:
    """How one piece goes into a placed set.

    Attributes:
        type: see Freedom.
        quality: A, on the chosen scale; 0 where no straight way in exists.
        direction: unit assembly direction (3,) (the removal direction reversed), or None.
        blockers: indices of the pieces in the way of the best direction, where it is blocked.
    """

    type: str
    quality: float
    direction: Array | None
    blockers: tuple[int, ...] = ()


def snap_normals(normals: Array) -> Array:
    """The unit normals (n, 3) without near repeats (k, 3)."""
    kept: list[Array] = []
    for normal in normals:
        if all(normal @ other < np.cos(SNAP) for other in kept):
            kept.append(normal)
    return np.array(kept).reshape(-1, 3)


def widest_direction(normals: Array) -> tuple[Array, float]:
    """The unit d (3,) with the largest min n_i . d over unit normals (n, 3), and that clearance; below 0
    where none is legal.

    At the best d up to three of the n_i . d are smallest, and equal: each choice of them gives one candidate.
    (The point of conv{n_i} nearest to the origin is t* d; non-negative least squares finds it too, but fails
    on dependent normals.)"""
    candidates = [normals]
    for count in (2, 3):
        chosen = np.array(list(itertools.combinations(range(len(normals)), count)), int).reshape(-1, count)
        candidates.append(np.linalg.pinv(normals[chosen]).sum(axis=2))
    directions = np.vstack(candidates)
    length = np.linalg.norm(directions, axis=1)
    directions = directions[length > 1e-9] / length[length > 1e-9, None]
    clearances = np.round((directions @ normals.T).min(axis=1), 12)
    best = int(np.argmax(clearances))
    return directions[best], float(clearances[best])


def analyse_freedom(normals: Array, axes: Array | None = None, rank: Rank | None = None) -> Freedom:
    """Classify contact normals (n, 3), each pointing into the piece.

    Args:
        axes: directions (k, 3) that are tried where the contacts leave a choice; those of the frame by
            default.
        rank: of equally free directions the one of the smallest rank is best.
    """
    axes = np.eye(3) if axes is None else axes
    rank = rank or (lambda direction: tuple(np.round(-direction, 9)))
    normals = snap_normals(np.asarray(normals, float).reshape(-1, 3))
    span = np.eye(3)
    lineality = 3 - (np.linalg.matrix_rank(normals, tol=SMALLEST_CLEARANCE) if len(normals) else 0)
    while len(span) and len(normals):
        flat = normals @ span.T @ span
        length = np.linalg.norm(flat, axis=1)
        flat = flat[length > SMALLEST_CLEARANCE] / length[length > SMALLEST_CLEARANCE, None]
        if not len(flat):
            normals = flat
            break
        best, clearance = widest_direction(flat)
        if clearance >= SMALLEST_CLEARANCE:
            kind = TYPES[len(span), min(lineality, len(span))]
            return Freedom(kind, clearance, best, _alternatives(best, flat, span, axes, rank), span)
        # normals that face each other are equalities: d moves only across them
        facing = _facing(flat, span)
        span = _complement(span, flat[facing] if facing.any() else flat)
    if not len(span):
        return Freedom("locked", 0.0, None, np.zeros((0, 3)), span)
    best = _freest(span, axes, rank)
    return Freedom(
        TYPES[len(span), len(span)], 1.0, best, _alternatives(best, np.zeros((0, 3)), span, axes, rank), span
    )


def _freest(span: Array, axes: Array, rank: Rank) -> Array:
    """Of the directions of a span (m, 3), all equally free: upwards where that is one, else the axis of the
    smallest rank."""
    inside = [d for d in (UP, *axes, *-axes) if np.linalg.norm(span @ d) > IN_SPAN]
    if inside and inside[0] is UP:
        return UP
    return min(inside or [*span, *-span], key=rank)


def _facing(normals: Array, span: Array) -> Mask:
    """Which of the unit normals (n, 3), all in the span (m, 3), every legal d of the span meets at a right
    angle."""
    rays = [*span, *_complement(span, normals)]
    if len(span) == 3:
        along = [normals, _complement(span, normals)]
        rays += [np.cross(a, b) for a, b in itertools.combinations(np.vstack(along), 2)]
    elif len(span) == 2:
        rays += list(np.cross(np.cross(*span), normals))
    directions = np.array(rays)
    length = np.linalg.norm(directions, axis=1)
    directions = directions[length > 1e-6] / length[length > 1e-6, None]
    seen = np.vstack([directions, -directions]) @ normals.T
    legal = seen[seen.min(axis=1) > -SMALLEST_CLEARANCE]
    # slivers that open by less than the smallest clearance on each side count as shut
    return legal.max(axis=0, initial=0.0) < 4 * SMALLEST_CLEARANCE


def _complement(span: Array, normals: Array) -> Array:
    """The part of a span (m, 3) that is orthogonal to the normals (k, 3)."""
    _, singular, right = np.linalg.svd(normals @ span.T)
    rank = int((singular > SMALLEST_CLEARANCE).sum())
    return right[rank:] @ span


def _alternatives(best: Array, normals: Array, span: Array, axes: Array, rank: Rank) -> Array:
    """Extreme directions of the legal cone, the axes in it, and midways, nearest to the best first."""
    candidates = [UP, -UP, *axes, *-axes]
    if len(span) == 1:
        candidates += [*span, *-span]
    for i, first in enumerate(normals):
        for second in normals[i + 1 :]:
            ray = np.cross(first, second)
            if np.linalg.norm(ray) > 1e-6:
                candidates += [ray / np.linalg.norm(ray), -ray / np.linalg.norm(ray)]
    if len(span) == 2:
        candidates += [s * np.cross(np.cross(*span), n) for n in normals for s in (1, -1)]
    legal: list[Array] = []
    for d in candidates:
        inside = np.linalg.norm(span @ d) > IN_SPAN and (not len(normals) or (normals @ d).min() > -1e-6)
        if inside and all(d @ other < 0.9999 for other in [best, *legal]):
            legal.append(d)
    legal += [m / np.linalg.norm(m) for m in [best + d for d in legal] if np.linalg.norm(m) > 0.1]
    return np.array(sorted(legal, key=lambda d: (-round(float(d @ best), 9), rank(d)))).reshape(-1, 3)


def finite_quality(kind: str, clearance: float) -> float:
    """A on the scale of equilibrium mode."""
    if kind in ("free", "plane"):
        return 1.0
    if kind in ("wedge", "corner"):
        return 0.1 + 0.9 * clearance
    if kind in ("slot", "slot + bottom"):
        return 0.1
    if kind == "slot + bottom + wall":
        return 0.1 * clearance
    return 0.05 if kind in ("peg through", "peg blind") else 0.0


def straight_ways(
    contacts: Sequence[Contact],
    axes: Array,
    blockers: Blockers,
    scale: Scale = "finite",
    rank: Rank | None = None,
) -> Iterator[Assemblability]:
    """Straight ways in for a piece, those with the largest clearance first; of equal ones straight down, then
    what is nearest to the widest direction. Where none is free, one without direction that says what is in
    the way.

    Args:
        contacts: patches with the placed set and the support, normals into the piece.
        axes: directions (k, 3) that are tried where the contacts leave a choice: the piece's own, not those
            of the frame, so that the way in turns with everything.
        blockers: indices of the bodies that are in the way of leaving along a unit direction (3,).
        scale: `finite` or `ordinal` values.
        rank: orders directions that the contacts leave equally free.
    """
    normals = np.array([c.normal for c in contacts]).reshape(-1, 3)
    freedom = analyse_freedom(normals, axes, rank)
    if freedom.best is None:
        yield Assemblability("locked", 0.0, None, tuple(sorted({c.body_a for c in contacts})))
        return
    others = [(removal, _clearance_along(removal, normals, freedom)) for removal in freedom.alternatives]
    others.sort(key=lambda way: (-round(way[1], 6), way[0] @ UP < IN_SPAN))
    ways = [(freedom.best, freedom.clearance), *others]
    if others and others[0][0] @ UP > IN_SPAN and others[0][1] > freedom.clearance - 1e-6:
        ways[:2] = ways[1::-1]
    found, first_blockers = False, None
    for removal, clearance in ways:
        met = blockers(removal)
        first_blockers = met if first_blockers is None else first_blockers
        if not met:
            quality = ORDINAL[freedom.type] if scale == "ordinal" else finite_quality(freedom.type, clearance)
            found = True
            yield Assemblability(freedom.type, quality, -removal)
    if not found:
        yield Assemblability(freedom.type, 0.0, None, first_blockers or ())


def _clearance_along(removal: Array, normals: Array, freedom: Freedom) -> float:
    """min n_i . d over the contacts that limit d inside the legal span, 1 where none does."""
    flat = normals @ freedom.span.T
    limiting = normals[np.linalg.norm(flat, axis=1) > SMALLEST_CLEARANCE]
    return float(np.clip((limiting @ removal).min(), 0, 1)) if len(limiting) else 1.0
