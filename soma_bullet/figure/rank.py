"""How promising a packing looks, by its cells alone: no proof, and a thousand of them take a second or two.

A packing is taken apart in thought. Taking out a piece is the dearer the less it goes straight up, stands by
itself on what is below it, and leaves two opposite sides free for a hand."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import numpy as np
import shapely

from soma_bullet.assembly.polycubes import Cell
from soma_bullet.figure.packing import Packing
from soma_bullet.figure.pieces import Cells

UP, ASIDE = (0, 0, 1), ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0))
SIDEWAYS, ENCLOSED = 1.0, 8.0  # price of a way out that is not straight up; of none along an axis
HANGS, LEANS = 4.0, 2.0  # of a piece with nothing below it; whose centre is not above what carries it
HIDDEN = 1.5  # of a piece without two opposite free sides
KEPT = 64  # sets of pieces of one size that are followed; of seven pieces there are at most 35
WIDEST = 2  # [cells] between the fingers


def apart_price(packing: Packing) -> tuple[float, tuple[int, ...]]:
    """The price of the cheapest way found to take a packing apart, and the order of the pieces in which it is
    built by that."""
    pieces = [cells for _, cells in packing]
    owner = {cell: k for k, cells in enumerate(pieces) for cell in cells}
    blocked = [[_blockers(cells, way, k, owner) for way in (UP, *ASIDE)] for k, cells in enumerate(pieces)]
    held = [_grips(cells, k, owner) for k, cells in enumerate(pieces)]
    below = [[owner.get((x, y, z - 1), -1) if z else -2 for x, y, z in cells] for cells in pieces]

    def price(piece: int, rest: int) -> float:
        ways = [not met & rest for met in blocked[piece]]
        total = 0.0 if ways[0] else SIDEWAYS if any(ways) else ENCLOSED
        carried = tuple(
            other == -2 or (other >= 0 and other != piece and bool(rest >> other & 1))
            for other in below[piece]
        )
        total += 0.0 if stands_on(pieces[piece], carried) else LEANS if any(carried) else HANGS
        return total + (0.0 if any(not met & rest for met in held[piece]) else HIDDEN)

    level: dict[int, tuple[float, tuple[int, ...]]] = {(1 << len(pieces)) - 1: (0.0, ())}
    for _ in pieces:
        after: dict[int, tuple[float, tuple[int, ...]]] = {}
        for placed, (spent, order) in level.items():
            for piece in range(len(pieces)):
                if placed >> piece & 1:
                    rest = placed & ~(1 << piece)
                    found = spent + price(piece, rest), (piece, *order)
                    if rest not in after or found < after[rest]:
                        after[rest] = found
        level = dict(sorted(after.items(), key=lambda item: item[1])[:KEPT])
    return level[0]


def _blockers(cells: Cells, way: Cell, piece: int, owner: dict[Cell, int]) -> int:
    """The pieces, one bit each, that a piece meets on its way out, as far as its own size."""
    axis = 0 if way[0] else 1 if way[1] else 2
    size = 1 + max(cell[axis] for cell in cells) - min(cell[axis] for cell in cells)
    met = 0
    for x, y, z in cells:
        for step in range(1, size + 1):
            other = owner.get((x + step * way[0], y + step * way[1], z + step * way[2]), piece)
            if other != piece:
                met |= 1 << other
    return met


def _grips(cells: Cells, piece: int, owner: dict[Cell, int]) -> list[int]:
    """For every way to close two fingers on a row of a piece's cells from above the pieces, one bit each,
    that are in their way."""
    inside, found = set(cells), set[int]()
    for axis in ((1, 0), (0, 1)):
        for x, y, z in cells:
            if (x - axis[0], y - axis[1], z) in inside:
                continue
            wide = 1
            while (x + wide * axis[0], y + wide * axis[1], z) in inside:
                wide += 1
            if wide > WIDEST:
                continue
            ends = ((x - axis[0], y - axis[1]), (x + wide * axis[0], y + wide * axis[1]))
            met = 0
            for i, j in ends:
                for other in (owner.get((i, j, z + lift)) for lift in (0, 1, 2)):
                    met |= 0 if other is None else 1 << other
            found.add(met)
    return sorted(found)


@lru_cache(maxsize=100_000)
def stands_on(cells: Cells, carried: tuple[bool, ...]) -> bool:
    """Whether a piece's centre of mass is above what its carried cells span."""
    if not any(carried):
        return False
    x, y, _ = np.mean(cells, axis=0)
    return bool(_span(cell for cell, is_so in zip(cells, carried, strict=True) if is_so).contains(
        shapely.Point(x, y)
    ))  # fmt: skip


def _span(cells: Iterable[Cell]) -> shapely.Geometry:
    """What some cells span in the plane."""
    return shapely.union_all(
        [shapely.box(x - 0.5, y - 0.5, x + 0.5, y + 0.5) for x, y, _ in cells]
    ).convex_hull
