"""Fetches earlier than the schedule has them, so that one arm fetches while the other builds.

A schedule is found step by step: a piece is fetched once the one before it is in place, and where two arms
would come near to each other, the one whose step is later waits. Where it is quicker the other way round, a
fetch goes before what the other arm does meanwhile, and the arm waits with the piece in its hand. What one
arm does keeps its order; so does what changes the assembly."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from soma_bullet.frames import readonly
from soma_bullet.motion.timing import TimingError
from soma_bullet.motion.transfer import TransferError
from soma_bullet.seeds import derived
from soma_bullet.task.kinds import TRANSIT, as_planned
from soma_bullet.task.program.motions import (
    BRIEFLY,
    check,
    collisions,
    plan_motion,
    scene_for,
    thinned,
    widths_along,
)
from soma_bullet.task.program.overlap.precedence import assembles, awaited
from soma_bullet.task.program.overlap.sweeps import Encounters, Sweep
from soma_bullet.task.program.program import Program, beginning, moments, one_at_a_time
from soma_bullet.task.segment import Segment
from soma_bullet.task.state import CellState

GAIN = 0.2  # [s] of the makespan that a change of the order is worth
CHANGES = 12  # of the order, at most


def prefetched(encounters: Encounters, program: Program) -> Program:
    """The same program, with those fetches earlier that make it end sooner once the arms move at the same
    time."""
    order = _Order(encounters, program)
    for _ in range(CHANGES):
        if not order.improve():
            break
    return replace(program, segments=tuple(order.segments), after=one_at_a_time(len(order.segments)))


class _Order:
    """Segments in one order, and when they end; what is known of one or two of them outlasts changes of the
    order."""

    def __init__(self, encounters: Encounters, program: Program):
        self.encounters, self.workcell, self.program = encounters, encounters.workcell, program
        self.arms = len(self.workcell.cell.arms)
        self._sweeps: dict[Segment, Sweep] = {}
        self._rests: dict[Segment, Sweep] = {}  # of its arm once a segment has ended
        self._assembling: dict[Segment, bool] = {}
        self._first = beginning(self.workcell, program.feed, program.start)
        self._take(list(program.segments))

    def _take(self, segments: list[Segment]) -> None:
        self.segments = segments
        self.moments = list(moments(self.workcell, replace(self.program, segments=tuple(segments))))
        for moment in self.moments:
            self._know(*moment)
        self.waits, self.makespan = self._timed(segments)

    def _know(self, before: CellState, segment: Segment, after: CellState) -> None:
        if segment not in self._rests:
            self._sweeps[segment] = self.encounters.sweep(before, segment)
            self._rests[segment] = Sweep.at_rest(self.workcell, after, segment.arm)
            self._assembling[segment] = assembles(before, segment)

    def _timed(self, segments: Sequence[Segment]) -> tuple[list[float], float]:
        """How long each segment waits for other arms, and when all have ended [s]."""
        known: list[dict[int, int]] = []
        ends: list[float] = []
        waits: list[float] = []
        assembling = [self._assembling[segment] for segment in segments]
        sweeps = [self._sweeps[segment] for segment in segments]

        def meets(i: int, j: int) -> bool:
            return self.encounters.meet(sweeps[i], sweeps[j])

        for j, segment in enumerate(segments):
            ended, _ = awaited(j, segments, assembling, known, self.arms, meets)
            known.append(ended)
            own = ended[segment.arm]
            start = max((ends[i] for i in ended.values() if i >= 0), default=0.0)
            waits.append(start - (ends[own] if own >= 0 else 0.0))
            ends.append(start + segment.seconds)
        return waits, max(ends, default=0.0)

    def improve(self) -> bool:
        """Bring one fetch forward, the one that waits the longest of those that help; whether there was
        one."""
        for fetch in sorted(self._fetches(), key=lambda fetch: -max(self.waits[k] for k in fetch)):
            best, chosen = self.makespan - GAIN, None
            for part in (fetch[:count] for count in range(len(fetch), 0, -1)):
                for place in self._places(part):
                    if self._timed(self._moved(part, place))[1] < best:
                        changed = self._mended(part, place)
                        if changed is not None and (makespan := self._timed(changed)[1]) < best:
                            best, chosen = makespan, changed
            if chosen is not None:
                self._take(chosen)
                return True
        return False

    def _fetches(self) -> Iterator[list[int]]:
        """Stretches of what one arm does with nothing but fetching in them, in which it waits for another
        arm."""
        for arm in range(self.arms):
            mine = [k for k, segment in enumerate(self.segments) if segment.arm == arm]
            n = 0
            while n < len(mine):
                count = 0
                while n + count < len(mine) and self._fetching(
                    mine[n + count], self.segments[mine[n]].piece, count == 0
                ):
                    count += 1
                if count and max(self.waits[k] for k in mine[n : n + count]) > GAIN:
                    yield mine[n : n + count]
                n += max(count, 1)

    def _fetching(self, k: int, piece: str, first: bool) -> bool:
        segment = self.segments[k]
        here = segment.kind is TRANSIT if first else segment.kind.fetches
        return here and segment.piece == piece and not self._assembling[segment]

    def _places(self, fetch: Sequence[int]) -> Iterator[int]:
        """Segments of other arms before which a fetch may come as far as the order of the work goes, latest
        first."""
        arm, piece = self.segments[fetch[0]].arm, self.segments[fetch[0]].piece
        empty = all(self.segments[k].kind.unladen for k in fetch)
        passed = [self.segments[k] for k in range(fetch[0], fetch[-1]) if k not in fetch]
        for place in range(fetch[0] - 1, -1, -1):
            other = self.segments[place]
            passed.append(other)
            if other.arm == arm or not empty and any(segment.piece == piece for segment in passed):
                return
            if other.kind.around:
                yield place

    def _moved(self, fetch: Sequence[int], place: int) -> list[Segment]:
        """The segments in their order but for a fetch that comes before another."""
        first = [*range(place), *fetch]
        return [self.segments[k] for k in [*first, *sorted(set(range(len(self.segments))) - set(first))]]

    def _mended(self, fetch: Sequence[int], place: int) -> list[Segment] | None:
        """The same with other paths where those that change places are not free any more; None where there
        are none."""
        changed = self._moved(fetch, place)
        state, last = self.moments[place - 1][2] if place else self._first, changed[place + len(fetch) - 1]
        for k in range(place, fetch[-1] + 1):
            segment = changed[k]
            before = segment.kind.before(state, segment.arm, segment.piece)
            if segment.arm == last.arm or self.encounters.meet(
                self._rests[last], self.encounters.sweep(before, segment)
            ):
                free = self._free(before, segment, k)
                if free is None:
                    return None
                changed[k] = free
            state = as_planned(self.workcell, before, changed[k])
            self._know(before, changed[k], state)
        return changed

    def _free(self, before: CellState, segment: Segment, number: int) -> Segment | None:
        """A segment where its path is free in a state, or with another path; None where there is none."""
        if len(segment.path) < 2:
            return segment
        arm, scene, widths = (
            segment.arm,
            scene_for(self.workcell, before, segment),
            widths_along(before, segment),
        )
        try:
            check(thinned(segment.path), collisions(self.workcell, scene, before, arm, widths))
            return segment
        except TimingError:
            pass
        if not segment.kind.around:
            return None
        try:
            path = plan_motion(
                self.workcell,
                scene,
                before,
                arm,
                segment.path[0],
                segment.path[-1],
                widths,
                derived(self.program.seed, "earlier", number),
                BRIEFLY,
            )
        except (TransferError, TimingError):
            return None
        return replace(segment, path=readonly(path))
