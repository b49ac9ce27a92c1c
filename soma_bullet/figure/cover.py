"""Exact cover with optional pieces: every way to fill cells with placements, each piece used as often as it
is there.

Depth first; the cell with the fewest placements is filled next (D. Knuth, "Dancing links", 2000). Sets of
placements are whole numbers, one bit a placement: to rule out what a placement meets is one operation. A
library was looked at (`exact-cover` 1.5): it knows neither pieces that may be left out nor a limit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Placement:
    """One way to put a piece.

    Attributes:
        piece: its kind.
        mask: the cells that it fills, one bit each.
    """

    piece: str
    mask: int


class NodesSpent(Exception):
    """The search came to its limit of nodes."""


class Cover:
    """A search for all exact covers of `count` cells.

    Args:
        supply: how often each kind of piece is there.
        most: nodes that the search may visit.

    Attributes:
        nodes: that it has visited.
    """

    def __init__(self, count: int, placements: Sequence[Placement], supply: Mapping[str, int], most: int):
        self.placements, self.most, self.nodes = placements, most, 0
        self.supply = dict(supply)
        self._by_cell = [0] * count
        self._by_piece = {piece: 0 for piece in supply}
        for number, placement in enumerate(placements):
            self._by_piece[placement.piece] |= 1 << number
            for cell in range(count):
                if placement.mask >> cell & 1:
                    self._by_cell[cell] |= 1 << number
        self._meets = [self._met(placement.mask) for placement in placements]

    def _met(self, mask: int) -> int:
        """All placements that share a cell with a mask."""
        met = 0
        for cell, row in enumerate(self._by_cell):
            if mask >> cell & 1:
                met |= row
        return met

    def solutions(self) -> Iterator[tuple[int, ...]]:
        """Every cover, as numbers of its placements; pieces of one kind are not told apart.

        Raises:
            NodesSpent: there may be more.
        """
        everything = (1 << len(self.placements)) - 1
        for piece, count in self.supply.items():
            if count < 1:
                everything &= ~self._by_piece[piece]
        yield from self._extend(everything, list(range(len(self._by_cell))), dict(self.supply), ())

    def _extend(
        self, alive: int, empty: list[int], left: dict[str, int], picked: tuple[int, ...]
    ) -> Iterator[tuple[int, ...]]:
        self.nodes += 1
        if self.nodes > self.most:
            raise NodesSpent
        if not empty:
            yield picked
            return
        fewest, options = -1, 0
        for cell in empty:
            here = alive & self._by_cell[cell]
            count = here.bit_count()
            if fewest < 0 or count < fewest:
                fewest, options = count, here
                if not count:
                    return
        while options:
            bit = options & -options
            options ^= bit
            number = bit.bit_length() - 1
            placement = self.placements[number]
            rest = alive & ~self._meets[number]
            left[placement.piece] -= 1
            if not left[placement.piece]:
                rest &= ~self._by_piece[placement.piece]
            still = [cell for cell in empty if not placement.mask >> cell & 1]
            yield from self._extend(rest, still, left, (*picked, number))
            left[placement.piece] += 1
