"""The schedule: which arm picks, inserts, holds and releases which piece, found together with the geometry that allows it.

A piece whose turn comes while a hand holds can be brought by one arm only, which the other is in the way of. Such pieces can be
laid down differently before the first step, when both arms are free: the search is tried without that first, or with it for
the pieces that no single grasp can bring.
"""

from __future__ import annotations

from collections import Counter

from soma_bullet.errors import NoSolutionError
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.task.assignments import Assignment, PutDown, Regrasp, Schedule, Square, Start
from soma_bullet.task.feed import Feed, serving_grasps
from soma_bullet.task.search import Search, key, whereabouts
from soma_bullet.task.squaring import square_key
from soma_bullet.task.tracing import Effort, TooManyLines
from soma_bullet.task.workcell import Workcell

# candidates a step and lines of hands in each round: broad and shallow before deep
ROUNDS = ((8, 1000), (12, 1500), (24, 4000), (72, 8000), (1_000_000, 16_000))
MOST_LINES = 24_000  # of hands made or checked in all rounds together, about 20 s; schedules were found with 20,300 at most


class Scheduler:
    """Searches schedules of one plan, feed and cell, from the beginning or from a state as found."""

    def __init__(self, workcell: Workcell, plan: AssemblyPlan, feed: Feed, start: Start | None = None):
        self.workcell, self.plan, self.feed, self.start = workcell, plan, feed, start
        self.rejections: Counter[str] = Counter()
        self.excluded: set[tuple[object, ...]] = set()
        self._effort = Effort()
        self._searches: dict[tuple[int, ...], Search | None] = {}

    def find(self) -> Schedule:
        """The first schedule. Raises NoSolutionError with what blocked, most frequent first."""
        self._effort.most = self._effort.lines + MOST_LINES
        try:
            found = self._find()
        except TooManyLines:
            found = None
        if found is None:
            raise NoSolutionError(
                "schedule", f"no arm and grasp serve every step of {' <- '.join(self.plan.order)}", self.rejections
            )
        return found

    def _find(self) -> Schedule | None:
        for width, lines in ROUNDS:
            tried: list[tuple[int, ...]] = []
            while (prepared := self._next(tried)) is not None:
                if self._effort.spent:
                    return None
                tried.append(prepared)
                search = self._search(prepared)
                found = search.find(width, lines) if search is not None else None
                if search is not None and found is not None:
                    rejections = dict((+self.rejections).most_common())
                    return Schedule(found, rejections, search.takes, search.releases)
        return None

    def rule_out(self, assignment: Assignment, regrasp: Regrasp | None) -> None:
        """Exclude what a later stage could not make: the way to regrasp where that is to blame, else the arm and grasp."""
        if isinstance(regrasp, Square):
            self.excluded.add(square_key(regrasp))
            self._searches = {k: s for k, s in self._searches.items() if s is None or all(regrasp is not r for r in s.prologue)}
            return
        for prepared, search in list(self._searches.items()):
            if search is not None and regrasp is not None and any(regrasp is r for r in search.prologue):
                self.excluded.add(_way(search.prologue))
                self._searches = {k: s for k, s in self._searches.items() if k[: len(prepared)] != prepared}
                return
        own = key(assignment)
        self.excluded.add(own if regrasp is not None else own[:3])

    @property
    def feed_search(self) -> Search:
        """The search with every piece where it lies."""
        search = self._search(())
        assert search is not None
        return search

    def _next(self, tried: list[tuple[int, ...]]) -> tuple[int, ...] | None:
        """The steps whose pieces are prepared in the next attempt of a round."""
        helpless = self._helpless()
        wanted = tuple(k for k in helpless if not self._served(k))
        deepest = max((s.deepest for s in self._searches.values() if s is not None), default=0)
        blocked = tuple(k for k in helpless if k in wanted or k == deepest)
        return next((steps for steps in (wanted, blocked, helpless, ()) if steps not in tried), None)

    def _helpless(self) -> tuple[int, ...]:
        """Steps whose piece is brought while another hand holds."""
        first = self.feed_search.first
        steps = self.plan.steps
        arms = len(self.workcell.cell.arms)
        return tuple(k for k in range(first + 1, len(steps)) if len(steps[k - 1].holds) >= arms - 1)

    def _served(self, k: int) -> bool:
        name = self.plan.steps[k].piece
        hand = self.workcell.cell.arms[0].hand
        return len(serving_grasps(self.workcell.assembly, self.plan, hand, name, self.feed.pose(name))) > 0

    def _search(self, prepared: tuple[int, ...]) -> Search | None:
        """The search with the pieces of some steps prepared; None where one of them cannot be."""
        if prepared not in self._searches:
            self._searches[prepared] = self._make(prepared)
        return self._searches[prepared]

    def _make(self, prepared: tuple[int, ...]) -> Search | None:
        if not prepared:
            poses = {name: self.feed.pose(name) for name in self.feed.names}
            return Search(
                self.workcell, self.plan, self.feed, poses, self.start, self.rejections, self.excluded, self._effort
            )  # fmt: skip
        before = self._search(prepared[:-1])
        if before is None or before.carried is not None:
            return None
        for regrasps in before.prepare(prepared[-1]):
            prologue, last = (*before.prologue, *regrasps), regrasps[-1]
            if _way(prologue) not in self.excluded and isinstance(last, PutDown):
                poses = {**before.poses, last.piece: last.pose_down}
                return Search(
                    self.workcell, self.plan, self.feed, poses, self.start, self.rejections, self.excluded, self._effort,
                    prologue,
                )  # fmt: skip
        return None


def _way(prologue: tuple[Regrasp, ...]) -> tuple[object, ...]:
    """What tells one prologue from the others."""
    return ("prologue", *((r.piece, r.arm, whereabouts(r)) for r in prologue))
