"""Random subassemblies of the Soma pieces, to try a judgement of stability on.

Pieces are put down one by one on a grid of cells. A place is any that is free, that has the support or a
placed piece under one of its cells, and that shares a face with what is there; all of them are equally
likely, also those that no hand could reach. Only places where the piece itself balances exactly on an edge of
what is under it are left out: cells of equal weight make them frequent, and what such a state does no
measurement decides."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np
import shapely

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.assembly.polycubes import Cell, cube_rotations
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.frames import make_transform, readonly

SOMA = "cube"  # the assembly whose pieces are used: all seven
SIDE = 0.0185  # [m] of a cell
FEWEST, MOST = 2, 6  # pieces
BALANCED = 1e-6  # [cells] a centre of mass this near to the outline of the feet is over it
STEPS = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))


@dataclass(frozen=True)
class Placement:
    """Where a piece is put.

    Attributes:
        piece: its name.
        rotation: index into `cube_rotations()`.
        shift: [cells] from the origin of the piece to that of the grid, whose cells k = 0 stand on the
            support.
    """

    piece: str
    rotation: int
    shift: Cell


def random_placements(seed: int, draw: int) -> tuple[Placement, ...]:
    """Two to six different pieces that touch each other and the support; the same for the same (seed,
    draw)."""
    rng = np.random.default_rng([seed, draw])
    names = sorted(_soma().names)
    count = int(rng.integers(FEWEST, MOST + 1))
    filled: set[Cell] = set()
    placements = []
    for name in rng.permutation(names)[:count]:
        places = list(_places(str(name), filled))
        while True:
            placement, cells = places[rng.integers(len(places))]
            if not _balances(cells, filled):
                break
        filled |= cells
        placements.append(placement)
    return tuple(placements)


def assembly_of(placements: Sequence[Placement], clearance: float, name: str = "random") -> Assembly:
    """The subassembly as an assembly on a support at height 0; clearance [m] of every piece."""
    pieces = tuple(replace(_piece(p.piece), clearance=clearance) for p in placements)
    rotations = cube_rotations()
    goals = [
        make_transform(rotations[p.rotation], (np.array(p.shift) + (0, 0, 0.5)) * SIDE) for p in placements
    ]
    return Assembly(name, pieces, readonly(goals), _soma().support)


@cache
def _soma() -> Assembly:
    return load_assembly(SOMA)


def _piece(name: str) -> Workpiece:
    return _soma().pieces[_soma().index(name)]


@cache
def _turned(name: str) -> tuple[tuple[int, frozenset[Cell]], ...]:
    """The different orientations of a piece: index of the rotation, and the cells about the piece's
    origin."""
    reach = range(-2, 3)
    inside = [
        cell
        for cell in product(reach, repeat=3)
        if any((part.normals @ (np.array(cell) * SIDE) < part.offsets).all() for part in _piece(name).parts)
    ]
    found, shapes = [], set()
    for k, rotation in enumerate(cube_rotations()):
        cells = np.rint(np.array(inside) @ rotation.T).astype(int)
        shape = frozenset(map(tuple, (cells - cells.min(axis=0)).tolist()))
        if shape not in shapes:
            shapes.add(shape)
            found.append((k, frozenset((int(x), int(y), int(z)) for x, y, z in cells)))
    return tuple(found)


def _places(name: str, filled: set[Cell]) -> Iterator[tuple[Placement, frozenset[Cell]]]:
    """All places where a piece may go, with the cells that it fills there; the first piece stands about the
    origin."""
    low, high = (
        np.array([bound(cell[k] for cell in filled or {(0, 0, 0)}) for k in range(3)]) for bound in (min, max)
    )
    for rotation, turned in _turned(name):
        cells = np.array(sorted(turned))
        least, most = cells.min(axis=0), cells.max(axis=0)
        first, last = low - most - 1, high - least + 1
        first[2] = -least[2]
        if not filled:
            first, last = first * (0, 0, 1), first * (0, 0, 1)
        for shift in product(*(range(a, b + 1) for a, b in zip(first.tolist(), last.tolist(), strict=True))):
            there = frozenset((x + shift[0], y + shift[1], z + shift[2]) for x, y, z in turned)
            if not there & filled and _feet(there, filled) and (not filled or _touches(there, filled)):
                yield Placement(name, rotation, (shift[0], shift[1], shift[2])), there


def _feet(cells: frozenset[Cell], filled: set[Cell]) -> list[tuple[int, int]]:
    """Columns in which a piece has something under it."""
    return sorted({(x, y) for x, y, z in cells if z == 0 or (x, y, z - 1) in filled})


def _touches(cells: frozenset[Cell], filled: set[Cell]) -> bool:
    return any((x + a, y + b, z + c) in filled for x, y, z in cells for a, b, c in STEPS)


def _balances(cells: frozenset[Cell], filled: set[Cell]) -> bool:
    """Whether the piece's centre of mass lies exactly over the outline of its feet."""
    squares = [shapely.box(x - 0.5, y - 0.5, x + 0.5, y + 0.5) for x, y in _feet(cells, filled)]
    outline = shapely.union_all(squares).convex_hull.exterior
    centre = np.mean(sorted(cells), axis=0)
    return bool(outline.distance(shapely.Point(centre[:2])) < BALANCED)
