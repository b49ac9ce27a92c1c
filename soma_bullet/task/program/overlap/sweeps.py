"""One arm along one segment, and whether two arms come too near to each other anywhere on their paths.

Bisection over both paths at once shows it: two shapes are free of each other in a cell where their distance
at its middle exceeds what their points can move within it (conservative advancement: B. Mirtich, 1996); those
that are not are looked at again in its halves."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from soma_bullet.frames import Array
from soma_bullet.robot.silhouette import Placed, Silhouette, Track, apart, room
from soma_bullet.task.segment import Segment
from soma_bullet.task.state import CellState
from soma_bullet.task.workcell import Workcell

CLEARANCE = 0.015  # [m] kept between two arms that move at the same time
GHOST_STEP = 0.05  # [m] between the places of the other arm around which a path is planned
SMALLEST = 0.004  # [m] of motion below which a cell is not divided again, but counts as too near
BATCH = 32  # cells that are looked at together
SAMPLED = 0.005  # [m] of motion between the places at which `gap` measures


@dataclass(frozen=True, eq=False)
class Sweep:
    """One arm along one segment, with what it carries and its hand as wide as it gets: its joints (n, 6)."""

    silhouette: Silhouette
    path: Array
    change: float  # of a finger's place [m]

    @classmethod
    def of(cls, workcell: Workcell, before: CellState, segment: Segment) -> Sweep:
        path = segment.path if len(segment.path) else before.qs[segment.arm][None]
        first = float(before.openings[segment.arm])
        last = first if segment.opening is None else segment.opening
        carried = workcell.carried(before, segment.arm)
        silhouette = Silhouette(workcell.collision, segment.arm, max(first, last), carried)
        return cls(silhouette, path, abs(last - first) / 2)

    @classmethod
    def at_rest(cls, workcell: Workcell, state: CellState, arm: int) -> Sweep:
        """An arm that stands where a state has it."""
        carried = workcell.carried(state, arm)
        silhouette = Silhouette(workcell.collision, arm, float(state.openings[arm]), carried)
        return cls(silhouette, state.qs[arm][None], 0.0)

    def along(self, path: Array) -> Sweep:
        """The same arm along another path (n, 6)."""
        return Sweep(self.silhouette, path, self.change)

    def part(self, first: int, last: int) -> Sweep:
        """The arm along some samples of its path."""
        return replace(self, path=self.path[first:last])

    def still(self, sample: int) -> Sweep:
        """The arm as it stands at a sample of its path."""
        return replace(self, path=self.path[sample : sample + 1])

    def at(self, sample: int) -> Placed:
        """The arm at a sample of its path."""
        return self.track.at(sample)

    @cached_property
    def track(self) -> Track:
        """The arm at all samples."""
        return self.silhouette.along(self.path)

    def marks(self, step: float = GHOST_STEP) -> list[int]:
        """Samples along the path; between two of them no point moves by much more than `step` [m]."""
        arc = self.track.arcs.max(axis=1)
        marks = np.searchsorted(arc, np.arange(0.0, arc[-1] + step, step))
        return sorted(set(np.minimum(marks, len(self.path) - 1).tolist()))


def meet(first: Sweep, second: Sweep) -> bool:
    """Whether two arms come nearer than CLEARANCE to each other anywhere on their paths."""
    one, two = first.track, second.track
    slack = CLEARANCE + first.change + second.change
    everything = np.ones((1, len(one.shapes), len(two.shapes)), bool)
    cells, pairs = np.array([[0, len(first.path) - 1, 0, len(second.path) - 1]]), everything
    while len(cells):
        taken, cells = cells[-BATCH:], cells[:-BATCH]
        doubted, pairs = pairs[-BATCH:], pairs[:-BATCH]
        middles = (taken[:, 0::2] + taken[:, 1::2]) // 2
        reaches = _reach(one.arcs, taken[:, :2], middles[:, 0]), _reach(two.arcs, taken[:, 2:], middles[:, 1])
        needed = slack + reaches[0][:, :, None] + reaches[1][:, None]
        gaps = np.linalg.norm(one.centres[middles[:, 0], :, None] - two.centres[middles[:, 1], None], axis=3)
        doubted &= gaps - (one.radii[:, None] + two.radii) <= needed
        for cell, i, j in np.argwhere(doubted).tolist():
            between = apart(one.at(int(middles[cell, 0])), two.at(int(middles[cell, 1])), i, j)
            if between > needed[cell, i, j]:
                doubted[cell, i, j] = False
            elif between <= slack or needed[cell, i, j] - slack < SMALLEST:
                return True
        left = doubted.any(axis=(1, 2))
        farthest = [
            np.where(doubted.any(axis=3 - side), r, 0.0).max(axis=1) for side, r in enumerate(reaches, 1)
        ]
        halves, which = _halves(taken[left], middles[left], farthest[0][left] >= farthest[1][left])
        cells, pairs = np.vstack([cells, halves]), np.concatenate([pairs, doubted[left][which]])
    return False


class Encounters:
    """Sweeps of segments, and which of them meet, each found once, in whatever order the segments come."""

    def __init__(self, workcell: Workcell):
        self.workcell = workcell
        self._sweeps: dict[Segment, Sweep] = {}
        self._met: dict[tuple[Sweep, Sweep], bool] = {}

    def sweep(self, before: CellState, segment: Segment) -> Sweep:
        """What `Sweep.of` gives: of the state only what belongs to the arm itself counts, which no order
        changes."""
        if segment not in self._sweeps:
            self._sweeps[segment] = Sweep.of(self.workcell, before, segment)
        return self._sweeps[segment]

    def meet(self, first: Sweep, second: Sweep) -> bool:
        """Whether two arms `meet`."""
        pair = first, second
        if pair not in self._met:
            self._met[pair] = meet(first, second)
        return self._met[pair]


def gap(first: Sweep, second: Sweep, enough: float) -> float:
    """Least room [m] between two arms, SAMPLED along their paths, whatever their timing; or a bound on it
    above `enough`.

    That is their distance, and that of an arm's link less what links keep more than hands.
    """
    ones, twos = ([sweep.at(k) for k in sweep.marks(SAMPLED)] for sweep in (first, second))
    return min(room(one, two, enough) for one in ones for two in twos)


def _reach(arcs: Array, ends: Array, middles: Array) -> Array:
    """How far (k, m) [m] any point of m shapes gets from where it is at the middles (k,) of stretches (k, 2)
    of a path."""
    reach: Array = np.maximum(arcs[middles] - arcs[ends[:, 0]], arcs[ends[:, 1]] - arcs[middles])
    return reach


def _halves(cells: Array, middles: Array, first: Array) -> tuple[Array, Array]:
    """Both halves of cells (k, 4), divided along the first path or along the second, and of which cell each
    is."""
    low, high = cells.copy(), cells.copy()
    at = np.where(first, 0, 2)
    rows = np.arange(len(cells))
    middle = np.where(first, middles[:, 0], middles[:, 1])
    low[rows, at + 1] = middle
    high[rows, at] = np.minimum(middle + 1, cells[rows, at + 1])
    return np.vstack([low, high]), np.concatenate([rows, rows])
