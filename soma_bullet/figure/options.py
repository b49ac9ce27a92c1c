"""Which packings of a figure are looked at, and how far."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from soma_bullet.option import Options, Range

Side = Literal["auto", "as-drawn", "top", "left", "right", "front", "back"]


@dataclass(frozen=True)
class FigureOptions(Options):
    """Which packings of a figure are looked at, and how far."""

    name: str | None = None
    """Of the figure: which one of a file of several; by default that of the file."""
    pieces: str = "VLTZABP"
    """Pieces that there are, a letter each; a letter that stands twice is a piece that there is twice."""
    packings: Annotated[int | None, Range(1)] = None
    """List the first so many packings, and look at no others; by default all are counted."""
    side: Side = "auto"
    """Which side of the drawing is down: as-drawn, or its top, left (-x), right, front (-y) or back; auto: as
    drawn, and where that cannot be built well, the others in turn."""
    plans: Annotated[int, Range(1)] = 1
    """Plans without a warning that are compared; the one with the best score wins."""
    tries: Annotated[int, Range(1)] = 4
    """Packings that are planned in full at most."""
    looks: Annotated[int, Range(1)] = 300
    """States and insertions that are judged at most while packings are taken apart, with grasps and
    equilibrium, to find out which can be planned; the most promising packings come first."""
    nodes: Annotated[int, Range(1)] = 1_000_000
    """Nodes of the search for packings of one side, after which it ends with what it has found."""
