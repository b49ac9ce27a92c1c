"""How near an arm comes to the others when it leaves its planned path: what may run beside one segment of a program."""

from __future__ import annotations

from collections.abc import Collection

from soma_bullet.frames import Array
from soma_bullet.robot.silhouette import Silhouette
from soma_bullet.task.segments import Program, contexts
from soma_bullet.task.sweeps import Sweep, gap
from soma_bullet.task.workcell import Workcell


def alongside(program: Program, k: int) -> set[int]:
    """Segments of other arms of which nothing says that they end before the k-th begins, or begin after it ends."""
    before: list[set[int]] = []  # of each segment, all that have ended when it begins
    last: dict[int, int] = {}  # an arm's segment before
    for i, (segment, waits) in enumerate(zip(program.segments, program.after, strict=True)):
        ends = {*waits, *([last[segment.arm]] if segment.arm in last else [])}
        before.append(ends.union(*(before[j] for j in ends)))
        last[segment.arm] = i
    arm = program.segments[k].arm
    return {i for i, s in enumerate(program.segments) if s.arm != arm and i not in before[k] and k not in before[i]}


class Beside:
    """The other arms while one segment runs: where they stand, and all that they may still do meanwhile.

    Args:
        program: of which the k-th segment is about to run.
        qs: measured joints (arms, 6) [rad].
        done: segments that have ended.
    """

    def __init__(self, workcell: Workcell, program: Program, k: int, qs: Array, done: Collection[int]):
        moments, segment = list(contexts(workcell, program)), program.segments[k]
        before, arm = moments[k][0], segment.arm
        silhouette = Silhouette(workcell.collision, arm, float(before.hands.openings[arm]))  # what it carries is to touch
        self.own = Sweep(silhouette, segment.path, 0.0)
        others = [other for other in range(len(workcell.cell.arms)) if other != arm]
        self.others = [Sweep.at_rest(workcell, before, other).along(qs[other][None]) for other in others]
        meanwhile = sorted(alongside(program, k).difference(done))
        self.others += [Sweep.of(workcell, *moments[i][:2]) for i in meanwhile if len(program.segments[i].path)]

    def gap(self, path: Array, enough: float) -> float:
        """Least distance [m] to the other arms along a path (n, 6), or a bound on it above `enough`."""
        own = self.own.along(path)
        return min(gap(own, other, enough) for other in self.others)
