"""The schedule: which arm picks, inserts, holds and releases which piece, found together with the geometry
that allows it.

A piece whose turn comes while a hand holds can be brought by one arm only, which the other is in the way of.
Such pieces can be laid down differently before the first step, when both arms are free: the search is tried
without that first, or with it for the pieces that no single grasp can bring; then best first over where they
are laid down."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterator
from itertools import count, islice

import numpy as np

from soma_bullet.errors import NoSolutionError
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.task.assignments import Assignment, PutDown, Regrasp, Schedule, Square, Start, key, way
from soma_bullet.task.feed import Feed, serving_grasps
from soma_bullet.task.search import Search
from soma_bullet.task.squaring import square_key
from soma_bullet.task.tracing import Effort, TooManyLines
from soma_bullet.task.workcell import Workcell

# candidates a step and lines of hands in each round: broad and shallow before deep
ROUNDS = ((8, 1500), (12, 1500), (24, 4000), (72, 8000), (1_000_000, 16_000))
SHALLOW, BRANCHES = (
    (200, 600),
    12,
)  # lines after a piece has been laid down elsewhere, and places where one is laid down
MOST_REARRANGED = 12_000  # lines of all of these
MOST_LINES = 36_000  # of hands made or checked in all rounds together, about 25 s


class Scheduler:
    """Searches schedules of one plan, feed and cell, from the beginning or from a state as found.

    Attributes:
        effort: how long a search may take, in units of MOST_LINES.
    """

    def __init__(self, workcell: Workcell, plan: AssemblyPlan, feed: Feed, start: Start | None = None):
        self.workcell, self.plan, self.feed, self.start, self.effort = workcell, plan, feed, start, 1.0
        self.rejections: Counter[str] = Counter()
        self.excluded: set[tuple[object, ...]] = set()
        self._effort = Effort()
        self._searches: dict[tuple[int, ...], Search | None] = {}
        self._rearrangements: dict[tuple[object, ...], Search] = {}  # by what comes before the first step

    def find(self) -> Schedule:
        """The first schedule. Raises NoSolutionError with what blocked, most frequent first."""
        self._effort.most = self._effort.lines + round(self.effort * MOST_LINES)
        try:
            found = self._find()
        except TooManyLines:
            found = None
        if found is None:
            raise NoSolutionError(
                "schedule",
                f"no arm and grasp serve every step of {' <- '.join(self.plan.order)}",
                self.rejections,
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
                    return self._made(search, found)
            if (width, lines) == ROUNDS[0] and (rearranged := self._rearranged(width)) is not None:
                return rearranged
        return None

    def _made(self, search: Search, found: tuple[Assignment, ...]) -> Schedule:
        return Schedule(
            found, dict((+self.rejections).most_common()), search.outset.takes, search.outset.releases
        )

    def _rearranged(self, width: int) -> Schedule | None:
        """The first schedule with pieces laid down elsewhere before the first step, for the steps that the
        search stops at.

        Best first: where laying down one piece lets the search come farther, the next piece is laid down from
        there on."""
        helpless, most = self._helpless(), self._effort.lines + MOST_REARRANGED
        begun = [search for search in self._searches.values() if search is not None]
        for lines in SHALLOW:
            queue: list[tuple[int, int, int, Search, Iterator[tuple[Regrasp, ...]]]] = []
            serial = count()

            def add(search: Search) -> None:
                moved = {regrasp.piece for regrasp in search.prologue}
                k = search.deepest
                if k in helpless and self.plan.steps[k].piece not in moved and search.outset.carried is None:
                    ways = islice(_distinct(search.prepare(k)), BRANCHES)
                    heapq.heappush(queue, (-k, len(search.prologue), next(serial), search, ways))  # noqa: B023

            for search in begun:
                add(search)
            while queue and self._effort.lines < most:
                search, ways = queue[0][3:]
                regrasps = next(ways, None)
                if regrasps is None:
                    heapq.heappop(queue)
                    continue
                following = self._after(search, regrasps)
                found = following.find(width, lines) if following is not None else None
                if following is not None and found is not None:
                    return self._made(following, found)
                if following is not None:
                    add(following)
        return None

    def rule_out(self, assignment: Assignment, regrasp: Regrasp | None) -> None:
        """Exclude what a later stage could not make: the way to regrasp where that is to blame, else the arm
        and grasp."""
        lost = {w: s for w, s in self._rearrangements.items() if any(regrasp is r for r in s.prologue)}
        self._rearrangements = {w: s for w, s in self._rearrangements.items() if w not in lost}
        if isinstance(regrasp, Square):
            self.excluded.add(square_key(regrasp))
            self._searches = {
                k: s
                for k, s in self._searches.items()
                if s is None or all(regrasp is not r for r in s.prologue)
            }
            return
        for prepared, search in list(self._searches.items()):
            if search is not None and regrasp is not None and any(regrasp is r for r in search.prologue):
                count = next(n for n, r in enumerate(search.prologue, 1) if r is regrasp)
                self.excluded.add(way(search.prologue[:count]))
                self._searches = {k: s for k, s in self._searches.items() if k[: len(prepared)] != prepared}
                return
        if lost:
            self.excluded.add(min(lost, key=len))
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
                self.workcell,
                self.plan,
                self.feed,
                poses,
                self.start,
                self.rejections,
                self.excluded,
                self._effort,
            )
        before = self._search(prepared[:-1])
        if before is None or before.outset.carried is not None:
            return None
        made = (self._after(before, regrasps) for regrasps in before.prepare(prepared[-1]))
        return next((search for search in made if search is not None), None)

    def _after(self, before: Search, regrasps: tuple[Regrasp, ...]) -> Search | None:
        """The search after more regrasps before the first step; None where they end with no put-down, or are
        ruled out."""
        prologue, last = (*before.prologue, *regrasps), regrasps[-1]
        ways = [way(prologue[:count]) for count in range(1, len(prologue) + 1)]
        if not self.excluded.isdisjoint(ways) or not isinstance(last, PutDown):
            return None
        if ways[-1] not in self._rearrangements:
            poses = {**before.poses, last.piece: last.pose_down}
            self._rearrangements[ways[-1]] = Search(
                self.workcell,
                self.plan,
                self.feed,
                poses,
                self.start,
                self.rejections,
                self.excluded,
                self._effort,
                prologue,
            )
        return self._rearrangements[ways[-1]]


def _distinct(ways: Iterator[tuple[Regrasp, ...]]) -> Iterator[tuple[Regrasp, ...]]:
    """Those that lay the piece down where none before did."""
    seen: set[bytes] = set()
    for regrasps in ways:
        last = regrasps[-1]
        place = np.round(last.pose_down, 2).tobytes() if isinstance(last, PutDown) else b""
        if place not in seen:
            seen.add(place)
            yield regrasps
