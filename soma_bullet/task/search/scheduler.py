"""The schedule: which arm picks, inserts, holds and releases which piece, found together with the geometry
that allows it.

A piece whose turn comes while a hand holds can be brought by one arm only, which the other is in the way of.
Such pieces can be laid down differently before the first step, when both arms are free: the search is tried
without that first, or with it for the pieces that no single grasp can bring; then best first over where they
are laid down.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from itertools import count, islice

import numpy as np

from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.holds import Holds
from soma_bullet.planner.qualities import Qualities
from soma_bullet.task.actions.action import Action, Identity
from soma_bullet.task.actions.put_down import PutDown
from soma_bullet.task.actions.square import Square
from soma_bullet.task.feed import Feed, serving_grasps
from soma_bullet.task.limits import Effort, TooManyLines
from soma_bullet.task.lines import Spot
from soma_bullet.task.refusal import Refusals
from soma_bullet.task.schedule import Assignment, Schedule
from soma_bullet.task.search.chains import Chain
from soma_bullet.task.search.placing import identities
from soma_bullet.task.search.planning import Excluded
from soma_bullet.task.search.search import Search
from soma_bullet.task.state import CellState
from soma_bullet.task.workcell import Workcell

# candidates a step and lines of hands in each round: broad and shallow before deep
ROUNDS = ((8, 1500), (12, 1500), (24, 4000), (72, 8000), (1_000_000, 16_000))
SHALLOW, BRANCHES = (
    (200, 600),
    12,
)  # lines after a piece is laid down elsewhere, and places where one is laid down
MOST_REARRANGED = 12_000  # lines of all of these


class Scheduler:
    """Searches schedules of one plan, feed and cell, from the beginning or from a state as found.

    Attributes:
        effort: what searches have done, of this order and of others.
        refusals: what was refused on the way.
        order_lines: of hands that may be made or checked for this order.
        cleared: steps whose pieces are laid down elsewhere before the first step, since they are in the way.
    """

    def __init__(
        self,
        workcell: Workcell,
        plan: AssemblyPlan,
        feed: Feed,
        start: CellState | None = None,
        effort: Effort | None = None,
        refusals: Refusals | None = None,
        cleared: tuple[int, ...] = (),
    ):
        self.workcell, self.plan, self.feed, self.start = workcell, plan, feed, start
        self.effort, self.refusals = effort or Effort(), refusals or Refusals()
        self.order_lines, self.cleared = self.effort.for_order, cleared
        self.excluded = Excluded()
        self._judged = Holds(Qualities(workcell.assembly, workcell.cell.hands, plan.options))
        self._searches: dict[tuple[int, ...], Search | None] = {}
        self._rearrangements: dict[tuple[Identity, ...], Search] = {}  # by what comes before the first step

    def find(self) -> Schedule:
        """The first schedule. Raises NoSolutionError with what decided and what blocked."""
        self.effort.allow(self.order_lines)
        self.refusals.order = self.plan.order
        try:
            found = self._find()
        except TooManyLines:
            found = None
        if found is None:
            order = " <- ".join(self.plan.order)
            most = self.effort.most
            ended = f" within {most} lines of hands (--search.lines)" if self.effort.exhausted else ""
            raise self.refusals.error("schedule", f"no arm and grasp serve every step of {order}{ended}")
        return found

    def forget(self) -> None:
        """Keep nothing but what has been ruled out."""
        self._searches, self._rearrangements = {}, {}

    def _find(self) -> Schedule | None:
        for width, lines in ROUNDS:
            tried: list[tuple[int, ...]] = []
            while (prepared := self._next(tried)) is not None:
                if self.effort.spent:
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
        return Schedule(found, dict(self.refusals.sentences()), search.start.changes)

    def _rearranged(self, width: int) -> Schedule | None:
        """The first schedule with pieces laid down elsewhere before the first step, for the steps that the
        search stops at.

        Best first: where laying down one piece lets the search come farther, the next piece is laid down from
        there on."""
        helpless, most = self._helpless(), self.effort.lines + MOST_REARRANGED
        begun = [search for search in self._searches.values() if search is not None]
        for lines in SHALLOW:
            queue: list[tuple[int, int, int, Search, Iterator[Chain]]] = []
            serial = count()

            def add(search: Search) -> None:
                moved = {action.piece for action in search.beginning}
                k = search.deepest
                if k in helpless and self.plan.steps[k].piece not in moved and search.start.carrying is None:
                    ways = islice(_distinct(search.prepare(k)), BRANCHES)
                    heapq.heappush(queue, (-k, _regrasps(search.beginning), next(serial), search, ways))  # noqa: B023

            for search in begun:
                add(search)
            while queue and self.effort.lines < most:
                search, ways = queue[0][3:]
                chain = next(ways, None)
                if chain is None:
                    heapq.heappop(queue)
                    continue
                following = self._after(search, chain)
                found = following.find(width, lines) if following is not None else None
                if following is not None and found is not None:
                    return self._made(following, found)
                if following is not None:
                    add(following)
        return None

    def rule_out(self, assignment: Assignment, action: Action) -> None:
        """Exclude what a later stage could not make: how the piece is brought where that is to blame, else
        the arm and grasp."""
        if isinstance(action, Square):
            self.excluded.actions.add(action.identity)
        begun = {key: s for key, s in self._rearrangements.items() if _has(s.beginning, action)}
        self._rearrangements = {key: s for key, s in self._rearrangements.items() if key not in begun}
        if isinstance(action, Square):
            kept = {k: s for k, s in self._searches.items() if s is None or not _has(s.beginning, action)}
            self._searches = kept
            return
        for prepared, search in self._searches.items():
            if search is not None and _has(search.beginning, action):
                self.excluded.beginnings.add(_until(search.beginning, action))
                kept = {k: s for k, s in self._searches.items() if k[: len(prepared)] != prepared}
                self._searches = kept
                return
        if begun:
            self.excluded.beginnings.add(min(begun, key=len))
            return
        brings = action is not assignment.pick and _has(assignment.bring, action)
        chain = identities(assignment) if brings else ()
        self.excluded.steps.add((assignment.step, assignment.insert.identity, chain))

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
        ways = (
            (*self.cleared, *(k for k in steps if k not in self.cleared))
            for steps in (wanted, blocked, helpless, ())
        )
        return next((steps for steps in ways if steps not in tried), None)

    def _helpless(self) -> tuple[int, ...]:
        """Steps whose piece is brought while another hand holds."""
        first = self.feed_search.first
        steps = self.plan.steps
        arms = len(self.workcell.cell.arms)
        return tuple(k for k in range(first + 1, len(steps)) if len(steps[k - 1].holds) >= arms - 1)

    def _served(self, k: int) -> bool:
        name = self.plan.steps[k].piece
        hands, pose = self.workcell.cell.hands, self.feed.pose(name)
        return len(serving_grasps(self.workcell.assembly, self.plan, hands, name, pose)) > 0

    def _search(self, prepared: tuple[int, ...]) -> Search | None:
        """The search with the pieces of some steps prepared; None where one of them cannot be."""
        if prepared not in self._searches:
            self._searches[prepared] = self._make(prepared)
        return self._searches[prepared]

    def _make(self, prepared: tuple[int, ...]) -> Search | None:
        if not prepared:
            body = self.workcell.body
            spots = {n: Spot(self.feed.pose(n), self.feed.off(body(n))) for n in self.feed.names}
            return self._searching(spots)
        before = self._search(prepared[:-1])
        if before is None or before.start.carrying is not None:
            return None
        made = (self._after(before, chain) for chain in before.prepare(prepared[-1]))
        return next((search for search in made if search is not None), None)

    def _after(self, before: Search, chain: Chain) -> Search | None:
        """The search after more actions before the first step; None where they end with no put-down, or are
        ruled out."""
        beginning, last = (*before.beginning, *chain), chain[-1]
        ways = [tuple(a.identity for a in beginning[:n]) for n in range(1, len(beginning) + 1)]
        if not self.excluded.beginnings.isdisjoint(ways) or not isinstance(last, PutDown):
            return None
        if ways[-1] not in self._rearrangements:
            spots = {**before.planning.spots, last.piece: Spot(last.pose_down, 0.0, last.place)}
            self._rearrangements[ways[-1]] = self._searching(spots, beginning)
        return self._rearrangements[ways[-1]]

    def _searching(self, spots: dict[str, Spot], beginning: Chain = ()) -> Search:
        return Search(
            self.workcell,
            self.plan,
            self.feed,
            spots,
            self.start,
            self._judged,
            self.refusals,
            self.excluded,
            self.effort,
            beginning,
        )


def _has(chain: Chain, action: Action) -> bool:
    return any(action is other for other in chain)


def _regrasps(chain: Chain) -> int:
    """How many of some actions leave a piece elsewhere."""
    return sum(action.regrasps for action in chain)


def _until(chain: Chain, action: Action) -> tuple[Identity, ...]:
    """What tells a chain from others up to an action, or up to the regrasp that a pick is for."""
    at = next(n for n, other in enumerate(chain) if other is action)
    end = next((n for n in range(at, len(chain)) if chain[n].regrasps), len(chain) - 1)
    return tuple(other.identity for other in chain[: end + 1])


def _distinct(ways: Iterator[Chain]) -> Iterator[Chain]:
    """Those that lay the piece down where none before did."""
    seen: set[tuple[float, ...]] = set()
    for chain in ways:
        last = chain[-1]
        place = tuple(np.round(last.pose_down, 2).ravel().tolist()) if isinstance(last, PutDown) else ()
        if place not in seen:
            seen.add(place)
            yield chain
