"""Ways in of every (placed set, piece) of one assembly: looked for one after another, and kept."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from soma_bullet.assembly.contacts import SUPPORT
from soma_bullet.assembly.hulls import unique_directions
from soma_bullet.assembly.model import Assembly
from soma_bullet.assembly.separation import swept_separation
from soma_bullet.frames import Array
from soma_bullet.planner.assemblability import Assemblability, Rank, Scale, straight_ways
from soma_bullet.sizes import CLEAR

Placed = frozenset[int]
PENETRATION = 1e-4  # [m] a piece may touch on its way what it touches in the end, but not enter it


class Ways:
    """Straight ways in of the pieces of one assembly.

    Args:
        scale: `finite` or `ordinal` values.
        clear: that pieces keep from each other on the way which do not touch in the end [m].
        run_in: length of the way before a piece is within its own size of its goal [m]; by default as the
            sizes have it.
    """

    def __init__(self, assembly: Assembly, scale: Scale, clear: float = CLEAR, run_in: float | None = None):
        self.assembly, self.scale, self.clear = assembly, scale, clear
        self.run_in = assembly.sizes.run_in if run_in is None else run_in
        self._open: dict[tuple[int, Placed], Iterator[Assemblability]] = {}
        self._found: dict[tuple[int, Placed], list[Assemblability]] = {}
        self._met: dict[tuple[int, int, tuple[float, ...]], bool] = {}
        self._normals: dict[int, Array] = {}

    def into(self, piece: int, placed: Placed) -> Iterator[Assemblability]:
        """The free ways of a piece into a placed set, as `straight_ways` orders them."""
        key, k = (piece, placed), 0
        if key not in self._open:
            self._open[key], self._found[key] = self._ways(piece, placed), []
        while True:
            if k == len(self._found[key]):
                way = next(self._open[key], None)
                if way is None:
                    return
                self._found[key].append(way)
            yield self._found[key][k]
            k += 1

    def _ways(self, piece: int, placed: Placed) -> Iterator[Assemblability]:
        return straight_ways(
            self.assembly.contacts_of(piece, placed),
            self._axes(piece),
            lambda removal: self.blockers(piece, placed, removal),
            self.scale,
            self._rank(piece, placed),
        )

    def blockers(self, piece: int, placed: Placed, removal: Array) -> tuple[int, ...]:
        """Indices of the placed pieces, and of the support, that are in the way of a piece which leaves its
        goal along a unit direction (3,): as far as its own size, and the run-in beyond."""
        key = tuple(np.round(removal, 9).tolist())
        return tuple(k for k in (SUPPORT, *sorted(placed)) if self._meets(piece, k, removal, key))

    def _meets(self, piece: int, other: int, removal: Array, key: tuple[float, ...]) -> bool:
        """Whether one body is in the way."""
        if (piece, other, key) not in self._met:
            assembly = self.assembly
            sweep = removal * (way_length(assembly, piece, removal) + self.run_in)
            parts = assembly.goal_parts[piece]
            if other == SUPPORT:
                lowest = min(float(part.vertices[:, 2].min()) for part in parts)
                met = lowest + min(0.0, sweep[2]) < assembly.support.height - PENETRATION
            else:
                gap = self._gap(piece, other)
                met = swept_separation(parts, sweep, assembly.goal_parts[other], max(gap, 0.0)) < gap
            self._met[piece, other, key] = met
        return self._met[piece, other, key]

    def _gap(self, piece: int, other: int) -> float:
        """Least distance [m] that a piece keeps on its way to a placed one: what touches in the end may touch
        before, as exactly as its parts are; what does not keeps clear, also when it has settled."""
        first, second = self.assembly.pieces[piece], self.assembly.pieces[other]
        if frozenset((piece, other)) in self.assembly.meeting:
            return -PENETRATION - first.roughness - second.roughness
        settled = abs(float(self.assembly.drops[piece] - self.assembly.drops[other]))
        return self.clear + settled

    def _axes(self, piece: int) -> Array:
        """Face normals (k, 3) of a piece at its goal, one for each direction up to sign; cuts inside it have
        no say."""
        if piece not in self._normals:
            normals = np.array([facet.normal for facet in self.assembly.pieces[piece].facets])
            self._normals[piece] = unique_directions(normals @ self.assembly.goals[piece][:3, :3].T)
        return self._normals[piece]

    def _rank(self, piece: int, placed: Placed) -> Rank:
        """Orders removal directions that are equally free: away from the placed set first, then by the
        piece's own axes.

        It turns with the assembly, and does not depend on the order of the pieces.
        """
        centres, rotation = self.assembly.goal_centres, self.assembly.goals[piece][:3, :3]
        away = (
            centres[piece] - np.sort(centres[sorted(placed)], axis=0).mean(axis=0) if placed else np.zeros(3)
        )
        away = away / max(float(np.linalg.norm(away)), 1e-9)
        return lambda direction: (-round(float(direction @ away), 6), *(-np.round(direction @ rotation, 6)))


def way_length(assembly: Assembly, piece: int, direction: Array) -> float:
    """Length [m] of the straight way in: the piece's own size along the direction."""
    vertices = np.vstack([part.vertices for part in assembly.goal_parts[piece]])
    return float(np.ptp(vertices @ direction))
