"""The sides on which a figure can stand: as drawn, and tipped over."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import shapely

from soma_bullet.assembly.polycubes import Cell
from soma_bullet.errors import NoSolutionError
from soma_bullet.figure.packing import UPRIGHT, Packing, first_image, turned_packing
from soma_bullet.figure.pieces import SIDE, Cells, Turn, at_origin, turned

TILT = 1e-3  # [g] a figure that resists no more falls, as the planner has it
AS_DRAWN = "as-drawn"
# which side of the drawing comes down
SIDES: dict[str, Turn] = {
    AS_DRAWN: ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "top": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "left": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "right": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "front": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "back": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
}


class NowhereStandsError(NoSolutionError):
    """The figure, were it one piece, would fall on every side that was asked for."""

    def __init__(self, name: str, falls: dict[str, str]):
        self.falls = falls
        on = "the side" if len(falls) == 1 else f"any of its {len(falls)} sides"
        super().__init__(
            "side",
            f"{name} cannot stand on {on} that was looked at, even if it were one piece",
            decided=[f"{side}: {why}" for side, why in falls.items()],
        )


@dataclass(frozen=True)
class Standing:
    """A figure on one of its sides.

    Attributes:
        side: which side of the drawing is down.
        turn: rotation from the drawing.
        cells: the figure so turned, at the origin.
        falls: why it cannot stand there, were it one piece; empty where it can.
        firmness: horizontal acceleration that it resists there, were it one piece [g].
    """

    side: str
    turn: Turn
    cells: Cells
    falls: str
    firmness: float


def sides_of(cells: Cells, wanted: str = "auto", packing: Packing | None = None) -> tuple[Standing, ...]:
    """The sides of a figure, as drawn first, then those on which it stands more firmly; of those that
    look the same from above the first.

    Args:
        wanted: the name of one side, or `auto` for all.
        packing: the only one that counts; sides are the same where it looks the same on them.
    """
    found: dict[Packing, Standing] = {}
    for side, turn in SIDES.items():
        if wanted in ("auto", side):
            here = at_origin(turned(cells, turn))
            parts: Packing = (("", here),) if packing is None else turned_packing(packing, turn)
            seen = first_image(parts, UPRIGHT)
            found.setdefault(seen, Standing(side, turn, here, *firmness_of(here)))
    first = next(iter(found.values()))
    return tuple(sorted(found.values(), key=lambda s: (s is not first, bool(s.falls), -round(s.firmness, 9))))


def firmness_of(cells: Cells) -> tuple[str, float]:
    """Why a figure at the origin falls, were each of its connected parts one piece, empty where it stands;
    and the horizontal acceleration that it resists [g].

    What falls as one piece falls in pieces all the more: forces inside a body do not move its centre of mass.
    """
    least = math.inf
    for part in connected_parts(cells):
        feet = [(x, y) for x, y, z in part if z == 0]
        if not feet:
            return f"{len(part)} of its cells hang in the air, connected to nothing below", 0.0
        centre = np.mean(part, axis=0)
        base = shapely.union_all([shapely.box(x - 0.5, y - 0.5, x + 0.5, y + 0.5) for x, y in feet])
        middle = shapely.Point(centre[:2])
        hull = base.convex_hull
        inside = hull.exterior.distance(middle) if hull.contains(middle) else -hull.distance(middle)
        if inside <= TILT * (centre[2] + 0.5):
            where = f"{-inside * SIDE:.1f} mm outside" if inside < -1e-9 else "on the rim of"
            return f"the centre of mass of {len(part)} cells is {where} what they stand on", 0.0
        least = min(least, inside / (float(centre[2]) + 0.5))
    return "", least


def connected_parts(cells: Iterable[Cell]) -> list[Cells]:
    """Parts of a figure whose cells are connected by faces, each sorted."""
    left, parts = set(cells), []
    while left:
        part, edge = set[Cell](), {min(left)}
        while edge:
            part |= edge
            edge = {
                (x + i, y + j, z + k)
                for x, y, z in edge
                for i, j, k in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
            } & (left - part)
        parts.append(tuple(sorted(part)))
        left -= part
    return parts
