"""Which segments of different arms may run at the same time: the order of a program, loosened as far as is safe.

A segment waits for the last earlier segment of another arm with which it may not overlap: because the assembly asks for their
order, or because somewhere on the two paths the arms, with what they carry, would come too near to each other. No timing
enters: whatever the delays of a guarded motion, what may overlap is free in every combination of states of the two paths.
Bisection over both paths at once shows it: two shapes are free of each other in a cell where their distance at its middle
exceeds what their points can move within it (conservative advancement: B. Mirtich, 1996); those that are not are looked at
again in its halves. A path around obstacles that would have to wait is planned again, around everything that the other arm does
meanwhile; it is taken if it waits for less.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from soma_bullet.frames import Array, readonly
from soma_bullet.motion.timing import TimingError
from soma_bullet.motion.transfer import TransferError
from soma_bullet.robot.silhouette import Obstacle, Placed, Silhouette, Track, apart, distance
from soma_bullet.task.motions import plan_motion, widths_between
from soma_bullet.task.program import scene_of
from soma_bullet.task.segments import Context, Program, Segment, contexts, one_at_a_time
from soma_bullet.task.workcell import Workcell

CLEARANCE = 0.015  # [m] kept between two arms that move at the same time
GHOST_STEP = 0.05  # [m] between the places of the other arm around which a path is planned
CHECKS = 1000  # of collisions, after which the search for such a path gives up
SHORT = 0.2  # [s] a wait that is not worth another path
LONGER = 1.5  # [s] that such a path may take more
AROUND = ("transit", "transfer", "home")
SMALLEST = 0.004  # [m] of motion below which a cell is not divided again, but counts as too near
BATCH = 32  # cells that are looked at together

ASSEMBLING = ("insert", "place")
AT_PIECE = ("approach", "grasp", "settle", "release")


def overlapped(workcell: Workcell, program: Program) -> Program:
    """The same program, every segment waiting for no more than it must."""
    loosened = _Loosener(workcell, _patient(workcell, program)).run()
    return replace(loosened, alone=program.makespan)


def _patient(workcell: Workcell, program: Program) -> Program:
    """The same program with the ways home as late as nothing else asks for them.

    An arm that has let go stands near the assembly. It must leave before the other arm comes there, but not before the other
    arm has fetched what it will bring.
    """
    segments = list(program.segments)
    for k in range(len(segments) - 1, -1, -1):
        if segments[k].kind == "home":
            segments = _later(workcell, replace(program, segments=tuple(segments)), k)
    return replace(program, segments=tuple(segments), after=one_at_a_time(len(segments)))


def _later(workcell: Workcell, program: Program, k: int) -> list[Segment]:
    """The segments, the k-th moved behind those of other arms that are free of where its arm stands and leave it its way."""
    moments = list(contexts(workcell, program))
    before, segment, _ = moments[k]
    way = Sweep.of(workcell, before, segment)
    here, to = way.still(0), k
    for i in range(k + 1, len(moments)):
        context, other, after = moments[i]
        if other.arm == segment.arm or meet(here, Sweep.of(workcell, context, other)):
            break
        if not meet(way, Sweep.at_rest(workcell, after, other.arm)):
            to = i
    segments = list(program.segments)
    return [*segments[:k], *segments[k + 1 : to + 1], segment, *segments[to + 1 :]]


class _Loosener:
    """Goes through a program once, in order."""

    def __init__(self, workcell: Workcell, program: Program):
        self.workcell, self.program = workcell, program
        self.moments = [(before, segment) for before, segment, _ in contexts(workcell, program)]
        self.sweeps = [Sweep.of(workcell, before, segment) for before, segment in self.moments]
        self.assembling = [_assembles(before, segment) for before, segment in self.moments]
        self.known: list[dict[int, int]] = []  # for every segment, the last of each arm's that has ended when it starts

    def run(self) -> Program:
        segments, after, ends = [], [], list[float]()
        for j, (_, segment) in enumerate(self.moments):
            ended, avoidable = self._ended(j, self.sweeps[j])
            if avoidable and segment.kind in AROUND and self._waits(segment, ended, ends):
                segment, ended = self._around(j, ended)
            ends.append(max((ends[i] for i in ended.values() if i >= 0), default=0.0) + segment.seconds)
            self.known.append(ended)
            segments.append(segment)
            after.append(tuple(sorted(i for i in set(ended.values()) if i >= 0)))
        return replace(self.program, segments=tuple(segments), after=tuple(after))

    def _waits(self, segment: Segment, ended: dict[int, int], ends: list[float]) -> bool:
        """Whether an arm that has ended its last segment still waits for another."""
        own = ended[segment.arm]
        ready = ends[own] if own >= 0 else 0.0
        return any(ends[i] > ready + SHORT for i in ended.values() if i >= 0)

    def _ended(self, j: int, sweep: Sweep) -> tuple[dict[int, int], bool]:
        """The last segment of each arm that must have ended before a segment; whether another path could do with fewer."""
        arm, piece = self.moments[j][1].arm, self.moments[j][1].piece
        own = next((i for i in range(j - 1, -1, -1) if self.moments[i][1].arm == arm), -1)
        ended = dict(self.known[own]) if own >= 0 else dict.fromkeys(range(len(self.workcell.cell.arms)), -1)
        ended[arm] = own
        avoidable = False
        for i in range(j - 1, -1, -1):
            other = self.moments[i][1]
            if i <= ended[other.arm]:
                continue
            ordered = other.piece == piece or (self.assembling[i] and self.assembling[j])
            if ordered or meet(self.sweeps[i], sweep):
                avoidable |= not ordered
                ended = {a: max(last, self.known[i][a]) for a, last in ended.items()}
                ended[other.arm] = i
        return ended, avoidable

    def _around(self, j: int, ended: dict[int, int]) -> tuple[Segment, dict[int, int]]:
        """A path that keeps clear of what the other arms do meanwhile, if there is one that waits for less."""
        before, segment = self.moments[j]
        arm, own = segment.arm, ended[segment.arm]
        bound = self.known[own] if own >= 0 else dict.fromkeys(ended, -1)
        meanwhile = [i for i in range(j) if (its := self.moments[i][1].arm) != arm and i > bound[its]]
        start, goal = segment.path[0], segment.path[-1]
        now = float(before.hands.openings[arm])
        widths = widths_between(now, now if np.isnan(segment.opening) else segment.opening)
        margin = CLEARANCE + GHOST_STEP / 2
        silhouette = Silhouette(self.workcell.collision, arm, float(widths.max()), before.carried.get(arm))
        ends = silhouette.at(start), silhouette.at(goal)
        ghosts = [self.sweeps[i].at(k) for i in meanwhile for k in self.sweeps[i].marks()]
        # those that are near its ends cannot be gone around
        obstacle = Obstacle([g for g in ghosts if all(distance(end, g, margin) > margin for end in ends)], margin)
        if not len(obstacle):
            return segment, ended
        try:
            path = plan_motion(
                self.workcell, scene_of(self.workcell, before, arm), before.hands, arm, start, goal, widths,
                self.program.seed + 31 * j, CHECKS, lambda q: obstacle.near(silhouette.at(q)),
            )  # fmt: skip
        except (TransferError, TimingError):
            return segment, ended
        other = replace(segment, path=readonly(path))
        sweep = Sweep.of(self.workcell, before, other)
        sooner, _ = self._ended(j, sweep)
        if sum(sooner.values()) >= sum(ended.values()) or other.seconds > segment.seconds + LONGER:
            return segment, ended
        self.moments[j], self.sweeps[j] = (before, other), sweep
        return other, sooner


def _assembles(before: Context, segment: Segment) -> bool:
    """Whether a segment changes the assembly or what holds it: those keep their order."""
    return segment.kind in ASSEMBLING or (segment.kind in AT_PIECE and segment.piece in before.placed)


@dataclass(frozen=True, eq=False)
class Sweep:
    """One arm along one segment, with what it carries and its hand as wide as it gets: its joints (n, 6)."""

    silhouette: Silhouette
    path: Array
    change: float  # of a finger's place [m]

    @classmethod
    def of(cls, workcell: Workcell, before: Context, segment: Segment) -> Sweep:
        path = segment.path if len(segment.path) else before.hands.qs[segment.arm][None]
        first = float(before.hands.openings[segment.arm])
        last = first if np.isnan(segment.opening) else segment.opening
        silhouette = Silhouette(workcell.collision, segment.arm, max(first, last), before.carried.get(segment.arm))
        return cls(silhouette, path, abs(last - first) / 2)

    @classmethod
    def at_rest(cls, workcell: Workcell, context: Context, arm: int) -> Sweep:
        """An arm that stands where a context has it."""
        carried = context.carried.get(arm)
        silhouette = Silhouette(workcell.collision, arm, float(context.hands.openings[arm]), carried)
        return cls(silhouette, context.hands.qs[arm][None], 0.0)

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

    def marks(self) -> list[int]:
        """Samples along the path; between two of them no point moves by more than GHOST_STEP."""
        arc = self.track.arcs.max(axis=1)
        marks = np.searchsorted(arc, np.arange(0.0, arc[-1] + GHOST_STEP, GHOST_STEP))
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
        farthest = [np.where(doubted.any(axis=3 - side), r, 0.0).max(axis=1) for side, r in enumerate(reaches, 1)]
        halves, which = _halves(taken[left], middles[left], farthest[0][left] >= farthest[1][left])
        cells, pairs = np.vstack([cells, halves]), np.concatenate([pairs, doubted[left][which]])
    return False


def _reach(arcs: Array, ends: Array, middles: Array) -> Array:
    """How far (k, m) [m] any point of m shapes gets from where it is at the middles (k,) of stretches (k, 2) of a path."""
    reach: Array = np.maximum(arcs[middles] - arcs[ends[:, 0]], arcs[ends[:, 1]] - arcs[middles])
    return reach


def _halves(cells: Array, middles: Array, first: Array) -> tuple[Array, Array]:
    """Both halves of cells (k, 4), divided along the first path or along the second, and of which cell each is."""
    low, high = cells.copy(), cells.copy()
    at = np.where(first, 0, 2)
    rows = np.arange(len(cells))
    middle = np.where(first, middles[:, 0], middles[:, 1])
    low[rows, at + 1] = middle
    high[rows, at] = np.minimum(middle + 1, cells[rows, at + 1])
    return np.vstack([low, high]), np.concatenate([rows, rows])
