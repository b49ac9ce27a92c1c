"""How near an arm comes to the others when it leaves its planned path: what may run beside one segment of a
program."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from soma_bullet.frames import Array
from soma_bullet.robot.silhouette import Silhouette
from soma_bullet.task.program.overlap.sweeps import Sweep, gap
from soma_bullet.task.program.program import Program, moments
from soma_bullet.task.workcell import Workcell


def alongside(program: Program, k: int, until: int | None = None) -> set[int]:
    """Segments of other arms of which nothing says that they end before the k-th begins, or begin after it
    ends.

    With `until`, a later segment of the same arm: from when the k-th begins until that one ends.
    """
    before: list[set[int]] = []  # of each segment, all that have ended when it begins
    last: dict[int, int] = {}  # an arm's segment before
    for i, (segment, waits) in enumerate(zip(program.segments, program.after, strict=True)):
        ends = {*waits, *([last[segment.arm]] if segment.arm in last else [])}
        before.append(ends.union(*(before[j] for j in ends)))
        last[segment.arm] = i
    arm, end = program.segments[k].arm, k if until is None else until
    return {
        i
        for i, s in enumerate(program.segments)
        if s.arm != arm and i not in before[k] and end not in before[i]
    }


def leaves(program: Program, k: int) -> int:
    """The segment that takes the k-th's arm away from where that ends; the k-th itself if none does."""
    arm = program.segments[k].arm
    moves = (i for i, s in enumerate(program.segments) if i > k and s.arm == arm and len(s.path))
    return next(moves, k)


class Concurrent:
    """The other arms while one segment runs, and while the arm then stands where that ends: where they are,
    and all that they may still do meanwhile.

    Args:
        program: of which the k-th segment is about to run.
        qs: measured joints (n,) [rad] of each arm.
        done: segments that have ended.
    """

    def __init__(
        self, workcell: Workcell, program: Program, k: int, qs: Sequence[Array], done: Collection[int]
    ):
        along, segment = list(moments(workcell, program)), program.segments[k]
        before, arm = along[k][0], segment.arm
        silhouette = Silhouette(
            workcell.collision, arm, float(before.openings[arm])
        )  # what it carries is to touch
        self.own = Sweep(silhouette, segment.path, 0.0)
        others = [other for other in range(len(workcell.cell.arms)) if other != arm]
        self.others = [Sweep.at_rest(workcell, before, other).along(qs[other][None]) for other in others]
        meanwhile = alongside(program, k).difference(done)
        after = alongside(program, k, leaves(program, k)).difference(done, meanwhile)
        sweeps = {
            i: Sweep.of(workcell, *along[i][:2])
            for i in sorted(meanwhile | after)
            if len(program.segments[i].path)
        }
        self.others += [sweep for i, sweep in sweeps.items() if i in meanwhile]
        self.later = [sweep for i, sweep in sweeps.items() if i in after]

    def gap(self, path: Array, enough: float) -> float:
        """Least room [m] to the other arms along a path (n, 6) and at its end, or a bound on it above
        `enough`; see `gap`."""
        own = self.own.along(path)
        last = own.still(len(path) - 1)
        pairs = [*((own, other) for other in self.others), *((last, other) for other in self.later)]
        return min(gap(one, two, enough) for one, two in pairs)
