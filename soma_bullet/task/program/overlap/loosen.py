"""Which segments of different arms may run at the same time: the order of a program, loosened as far as is
safe.

A segment waits for the last earlier segment of another arm with which it may not overlap: because the
assembly asks for their order, or because somewhere on the two paths the arms, with what they carry, would
come too near to each other. No timing enters: whatever the delays of a guarded motion, what may overlap is
free in every combination of states of the two paths.

An arm that has let go leaves as late as nothing else asks for it, and not for home, if it may as well wait
where it is to fetch next. A path around obstacles that would have to wait is planned again, around everything
that the other arm does meanwhile; it is taken if it waits for less. If it still waits, it is divided, with a
stop in between: what keeps clear of the other arm comes before the wait. So is the path that it waits for,
where the other arm is out of the way before its end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from soma_bullet.frames import readonly
from soma_bullet.motion.timing import TimingError, time_path
from soma_bullet.motion.transfer import TransferError
from soma_bullet.robot.silhouette import Obstacle, Silhouette, distance
from soma_bullet.seeds import derived
from soma_bullet.task.kinds import HOME, TRANSIT, as_planned
from soma_bullet.task.posture import CARRYING
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
from soma_bullet.task.program.overlap.prefetch import prefetched
from soma_bullet.task.program.overlap.sweeps import CLEARANCE, GHOST_STEP, Encounters, Sweep, meet
from soma_bullet.task.program.program import Program, moments, one_at_a_time
from soma_bullet.task.segment import DT, Segment
from soma_bullet.task.workcell import Workcell

SHORT = 0.2  # [s] a wait that nothing is done about
WORTH = 1.0  # [s] a wait that is worth another path
LONGER = 1.5  # [s] that such a path may take more
STOP = 0.3  # [s] that a stop on the way takes, about
PARTS = 16  # of a path, between which it may be divided
STRIDE = 8  # samples of a path from one to the next of those that its parts are timed along


def overlapped(workcell: Workcell, program: Program) -> Program:
    """The same program, every segment waiting for no more than it must, with what it takes one arm at a
    time."""
    encounters = Encounters(workcell)
    patient = _patient(encounters, program)
    together = _Loosener(encounters, prefetched(encounters, patient)).run()
    return replace(together, alone=min(program.makespan, patient.makespan), in_turn=program.makespan)


def _patient(encounters: Encounters, program: Program) -> Program:
    """The same program with the ways home as late as nothing else asks for them, or on to what the arm does
    next.

    An arm that has let go stands near the assembly. It must leave before the other arm comes there, but not
    before the other arm has fetched what it will bring."""
    segments = list(program.segments)
    for k in range(len(segments) - 1, -1, -1):
        if segments[k].kind is HOME:
            segments = _later(encounters, replace(program, segments=tuple(segments)), k)
    for k in range(len(segments) - 1, -1, -1):
        if segments[k].kind is HOME:
            segments = _onwards(encounters, replace(program, segments=tuple(segments)), k)
    return replace(program, segments=tuple(segments), after=one_at_a_time(len(segments)))


def _later(encounters: Encounters, program: Program, k: int) -> list[Segment]:
    """The segments, the k-th moved behind those of other arms that are free of where its arm stands and leave
    it its way."""
    workcell = encounters.workcell
    along = list(moments(workcell, program))
    before, segment, _ = along[k]
    way = encounters.sweep(before, segment)
    here, to = way.still(0), k
    for i in range(k + 1, len(along)):
        state, other, after = along[i]
        if other.arm == segment.arm or meet(here, encounters.sweep(state, other)):
            break
        if not meet(way, Sweep.at_rest(workcell, after, other.arm)):
            to = i
    segments = list(program.segments)
    return [*segments[:k], *segments[k + 1 : to + 1], segment, *segments[to + 1 :]]


def _onwards(encounters: Encounters, program: Program, k: int) -> list[Segment]:
    """The segments, a way home and the one from there replaced by one to what the arm does next, if it may
    wait there."""
    workcell, segments = encounters.workcell, list(program.segments)
    arm = segments[k].arm
    following = next((n for n in range(k + 1, len(segments)) if segments[n].arm == arm), None)
    if following is None or segments[following].kind is not TRANSIT:
        return segments
    along = list(moments(workcell, program))
    _, transit, after = along[following]
    there = Sweep.at_rest(workcell, after, arm)
    if any(meet(there, encounters.sweep(*moment[:2])) for moment in along[k + 1 : following]):
        return segments
    before = along[k][0]
    try:
        path = plan_motion(
            workcell,
            scene_for(workcell, before, transit),
            before,
            arm,
            segments[k].path[0],
            transit.path[-1],
            widths_along(before, transit),
            derived(program.seed, "onwards", k),
        )
    except (TransferError, TimingError):
        return segments
    onwards = replace(transit, path=readonly(path))
    return [*segments[:k], onwards, *segments[k + 1 : following], *segments[following + 1 :]]


class _Loosener:
    """Goes through a program once, in order."""

    def __init__(self, encounters: Encounters, program: Program):
        self.encounters, self.workcell, self.program = encounters, encounters.workcell, program
        self.moments = [(before, segment) for before, segment, _ in moments(self.workcell, program)]
        self.sweeps = [encounters.sweep(before, segment) for before, segment in self.moments]
        self.assembling = [assembles(before, segment) for before, segment in self.moments]
        self.known: list[
            dict[int, int]
        ] = []  # for every segment, the last of each arm's that has ended when it starts

    def run(self) -> Program:
        while (j := len(self.known)) < len(self.moments):
            ended, avoidable = self._ended(j, self.sweeps[j])
            if avoidable and self._waits(j, ended) > SHORT:
                if self.moments[j][1].kind.around:
                    ended = self._begun_early(
                        j, self._around(j, ended) if self._waits(j, ended) > WORTH else ended
                    )
                ended = self._left_early(j, ended)
            self.known.append(ended)
        after = tuple(tuple(sorted(i for i in set(ended.values()) if i >= 0)) for ended in self.known)
        return replace(self.program, segments=tuple(segment for _, segment in self.moments), after=after)

    def _ends(self) -> list[float]:
        """When the segments end whose waits are known [s]."""
        ends: list[float] = []
        for (_, segment), ended in zip(self.moments, self.known, strict=False):
            ends.append(max((ends[i] for i in ended.values() if i >= 0), default=0.0) + segment.seconds)
        return ends

    def _waits(self, j: int, ended: dict[int, int]) -> float:
        """How long [s] an arm that has ended its last segment still waits for others."""
        ends, own = self._ends(), ended[self.moments[j][1].arm]
        return max((ends[i] for i in ended.values() if i >= 0), default=0.0) - (
            ends[own] if own >= 0 else 0.0
        )

    def _begun_early(self, j: int, ended: dict[int, int]) -> dict[int, int]:
        """Divides a path whose beginning need not wait, so that it ends sooner; what the beginning waits
        for."""
        wait, segment, sweep = self._waits(j, ended), self.moments[j][1], self.sweeps[j]
        if wait < STOP + SHORT:
            return ended
        own = ended[segment.arm]
        bound = self.known[own] if own >= 0 else dict.fromkeys(ended, -1)
        awaited = [
            i
            for i in range(j - 1, -1, -1)
            if (a := self.moments[i][1].arm) != segment.arm and bound[a] < i <= ended[a]
        ]
        free = _longest(
            len(sweep.path), lambda m: not any(meet(self.sweeps[i], sweep.part(0, m + 1)) for i in awaited)
        )
        parts = self._divided(j, free)
        if parts is None or wait + segment.seconds - max(wait, parts[0].seconds) - parts[1].seconds < SHORT:
            return ended
        self._replace(j, parts)
        return self._ended(j, self.sweeps[j])[0]

    def _left_early(self, j: int, ended: dict[int, int]) -> dict[int, int]:
        """Divides the path for whose end a segment waits, where only its beginning is in the way; what that
        waits for then."""
        arm, ends = self.moments[j][1].arm, self._ends()
        last = max((i for a, i in ended.items() if a != arm and i >= 0), key=lambda i: ends[i], default=-1)
        if last < 0 or not self.moments[last][1].kind.around:
            return ended
        way, sweep, wait = self.sweeps[last], self.sweeps[j], self._waits(j, ended)
        count = len(way.path)
        left = count - 1 - _longest(count, lambda m: not meet(way.part(count - 1 - m, count), sweep))
        parts = self._divided(last, left)
        if parts is None or self.moments[last][1].seconds - parts[0].seconds < SHORT:
            return ended
        kept = self.moments.copy(), self.sweeps.copy(), self.assembling.copy(), self.known
        self._replace(last, parts)
        moved = [{a: i + (i >= last) for a, i in known.items()} for known in self.known]
        self.known = [
            *moved[: last + 1],
            {**moved[last], self.moments[last][1].arm: last},
            *moved[last + 1 :],
        ]
        sooner, _ = self._ended(j + 1, self.sweeps[j + 1])
        if self._waits(j + 1, sooner) <= wait - SHORT / 2:
            return sooner
        self.moments, self.sweeps, self.assembling, self.known = kept
        return ended

    def _divided(self, j: int, m: int) -> tuple[Segment, Segment] | None:
        """A path in two, with a stop at its m-th sample; None where one would be too short, or cannot be
        timed."""
        before, segment = self.moments[j]
        arm, path = segment.arm, segment.path
        if min(m, len(path) - 1 - m) < max(STRIDE, len(path) // PARTS):
            return None
        limits, gentle = self.workcell.robot.arm(arm), CARRYING if arm in before.carried else 1.0
        scene = scene_for(self.workcell, before, segment)
        collides = collisions(self.workcell, scene, before, arm, widths_along(before, segment))
        halves = []
        for part in (path[: m + 1], path[m:]):
            rows = np.union1d(np.arange(0, len(part), STRIDE), [len(part) - 1])
            try:
                samples = time_path(part[rows], gentle * limits.velocity, gentle * limits.acceleration, DT)
                check(thinned(samples), collides)
            except TimingError:
                return None
            halves.append(replace(segment, path=readonly(samples)))
        return halves[0], halves[1]

    def _replace(self, j: int, parts: tuple[Segment, Segment]) -> None:
        """Puts two segments in the place of one."""
        before, (first, second) = self.moments[j][0], parts
        state = as_planned(self.workcell, before, first)
        between = second.kind.before(state, second.arm, second.piece)
        self.moments[j : j + 1] = [(before, first), (between, second)]
        self.sweeps[j : j + 1] = [self.encounters.sweep(*moment) for moment in self.moments[j : j + 2]]
        self.assembling[j : j + 1] = [self.assembling[j]] * 2

    def _ended(self, j: int, sweep: Sweep) -> tuple[dict[int, int], bool]:
        """The last segment of each arm that must have ended before a segment; whether another path could do
        with fewer."""
        segments = [segment for _, segment in self.moments]
        arms = len(self.workcell.cell.arms)
        return awaited(
            j,
            segments,
            self.assembling,
            self.known,
            arms,
            lambda i, _: self.encounters.meet(self.sweeps[i], sweep),
        )

    def _around(self, j: int, ended: dict[int, int]) -> dict[int, int]:
        """A path that keeps clear of what the other arms do meanwhile, if there is one that waits for
        less."""
        before, segment = self.moments[j]
        arm, own = segment.arm, ended[segment.arm]
        bound = self.known[own] if own >= 0 else dict.fromkeys(ended, -1)
        meanwhile = [i for i in range(j) if (its := self.moments[i][1].arm) != arm and i > bound[its]]
        start, goal = segment.path[0], segment.path[-1]
        widths = widths_along(before, segment)
        margin = CLEARANCE + GHOST_STEP / 2
        silhouette = Silhouette(
            self.workcell.collision, arm, float(widths.max()), self.workcell.carried(before, arm)
        )
        ends = silhouette.at(start), silhouette.at(goal)
        ghosts = [self.sweeps[i].at(k) for i in meanwhile for k in self.sweeps[i].marks()]
        # those that are near its ends cannot be gone around
        obstacle = Obstacle(
            [g for g in ghosts if all(distance(end, g, margin) > margin for end in ends)], margin
        )
        if not len(obstacle):
            return ended
        try:
            path = plan_motion(
                self.workcell, scene_for(self.workcell, before, segment), before, arm, start, goal, widths,
                derived(self.program.seed, "around", j), BRIEFLY, lambda q: obstacle.near(silhouette.at(q)),
            )  # fmt: skip
        except (TransferError, TimingError):
            return ended
        other = replace(segment, path=readonly(path))
        sweep = self.encounters.sweep(before, other)
        sooner, _ = self._ended(j, sweep)
        if sum(sooner.values()) >= sum(ended.values()) or other.seconds > segment.seconds + LONGER:
            return ended
        self.moments[j], self.sweeps[j] = (before, other), sweep
        return sooner


def _longest(count: int, holds: Callable[[int], bool]) -> int:
    """The greatest of some samples below `count` for which something holds that holds for all before, if for
    any; else 0."""
    low, high = 0, PARTS
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if holds(middle * (count - 1) // PARTS) else (low, middle)
    return low * (count - 1) // PARTS
