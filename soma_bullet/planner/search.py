"""Search over assembly orders: all of them where they are few, otherwise the best ones, exactly.

An order's score is the product of the minima of its qualities (paper Sec. IV-G). A minimum only falls as an
order grows, so that of two ways to the same situation the one that is nowhere worse makes the other needless:
labels on subsets, not on orders."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

from soma_bullet.planner.options import LABELS

Placed = frozenset[int]
NOTHING: Placed = frozenset()
Cost = tuple[
    int, int, int, int
]  # pieces gripped again, pieces held, states that depend on clearance, changes of hold
FREE: Cost = (0, 0, 0, 0)
DIVE = 0.1  # of them are kept to complete an order, where none is by then


@dataclass(frozen=True)
class Support:
    """One way to keep a state up while the next piece comes in.

    Attributes:
        held: what the hands hold.
        quality: the state's S with that.
        cost: what breaks ties, smaller is better.
    """

    held: Placed
    quality: float
    cost: Cost


class Steps(Protocol):
    """What a search asks: the insertion of a piece, and what may be held before the next one."""

    @property
    def count(self) -> int:
        """Number of pieces."""

    def insertion(self, placed: Placed, piece: int) -> tuple[float, ...]:
        """Qualities of inserting `piece`; a 0 rules it out."""

    def supports(self, before: Placed, piece: int, held: Placed, upcoming: int | None) -> tuple[Support, ...]:
        """What may be held after `piece` went into `before` with `held` held, until `upcoming` goes in (None:
        the end)."""


def score_of(minima: tuple[float, ...]) -> float:
    """Product of the minima; infinity times zero is zero."""
    return 0.0 if 0.0 in minima else math.prod(minima)


@dataclass(frozen=True)
class Found:
    """An order with its holds.

    Attributes:
        order: pieces, first to last.
        held: what is held after each step.
        s: S with the holds after each step.
        minima: smallest S, then the smallest of each quality of the insertions.
        cost: of the holds.
    """

    order: tuple[int, ...]
    held: tuple[Placed, ...]
    s: tuple[float, ...]
    minima: tuple[float, ...]
    cost: Cost

    @property
    def score(self) -> float:
        """min S * min G * min A ..."""
        return score_of(self.minima)


@dataclass(frozen=True)
class Search:
    """What a search over labels found.

    Attributes:
        found: orders, best first.
        proven: how many of them, from the first on, no other order can beat.
        labels: how many labels it made.
        ended: it found as many as were asked for, or all there are; otherwise the labels ran out.
    """

    found: tuple[Found, ...]
    proven: int
    labels: int
    ended: bool


def _added(first: Cost, second: Cost) -> Cost:
    return (first[0] + second[0], first[1] + second[1], first[2] + second[2], first[3] + second[3])


_Holds = tuple[float, Cost, tuple[Placed, ...], tuple[float, ...]]  # min S, cost, what was held, its S


Supports = Callable[[Placed, int, Placed, int | None], tuple[Support, ...]]  # see Steps.supports
Bound = Callable[[Placed], tuple[float, ...]]  # of the minima that any completion of a placed set can reach


def pareto_holds(
    supports: Supports, order: tuple[int, ...], before: dict[Placed, list[_Holds]], upcoming: int | None
) -> dict[Placed, list[_Holds]]:
    """Best ways to each held set after the last piece of `order`, given those after the one before it."""
    placed, piece = frozenset(order[:-1]), order[-1]
    after: dict[Placed, list[_Holds]] = {}
    for held, labels in before.items():
        for support in supports(placed, piece, held, upcoming):
            for smallest, cost, path, values in labels:
                worst, total = min(smallest, support.quality), _added(cost, support.cost)
                _keep(
                    after.setdefault(support.held, []),
                    (worst, total, (*path, support.held), (*values, support.quality)),
                )
    return after


def _keep(labels: list[_Holds], new: _Holds) -> None:
    """Add a label unless one is at least as good in both S and cost; drop those that it beats."""
    if any(old[0] >= new[0] and old[1] <= new[1] for old in labels):
        return
    labels[:] = [old for old in labels if not (new[0] >= old[0] and new[1] <= old[1])]
    labels.append(new)


def best_holds(labels: dict[Placed, list[_Holds]]) -> _Holds:
    """Of all labels the one with the largest min S, then the smallest cost."""
    every = [label for group in labels.values() for label in group]
    return min(every, key=lambda label: (-label[0], label[1], [sorted(held) for held in label[2]]))


def started(placed: tuple[int, ...]) -> dict[Placed, list[_Holds]]:
    """The labels before anything is held: what is placed already stands, and its last piece is in the hand
    that placed it."""
    before = max(len(placed) - 1, 0)
    return {NOTHING: [(math.inf, FREE, (NOTHING,) * before, (math.inf,) * before)]}


@dataclass(frozen=True)
class Followed:
    """What became of one order: its holds as far as they go.

    Attributes:
        order: pieces.
        holds: the best ones of the longest part that can be held up.
        complete: that part is the whole order.
    """

    order: tuple[int, ...]
    holds: _Holds
    complete: bool


def follow(supports: Supports, order: tuple[int, ...], placed: int = 0) -> Followed:
    """One order with its best holds; the first `placed` pieces are there already."""
    labels = started(order[:placed])
    for k in range(max(placed - 1, 0), len(order)):
        after = pareto_holds(supports, order[: k + 1], labels, order[k + 1] if k + 1 < len(order) else None)
        if not after:
            return Followed(order, best_holds(labels), False)
        labels = after
    return Followed(order, best_holds(labels), True)


def follow_all(steps: Steps, placed: tuple[int, ...] = ()) -> Iterator[Followed]:
    """Every order that begins with what is placed already, in lexicographic order; parts that orders share
    are followed once."""

    def extend(
        order: tuple[int, ...], labels: dict[Placed, list[_Holds]], dead: _Holds | None
    ) -> Iterator[Followed]:
        left = [k for k in range(steps.count) if k not in order]
        for piece in left or [None]:  # type: ignore[list-item]
            after, end = labels, dead
            if order and dead is None:
                after = pareto_holds(steps.supports, order, labels, piece)
                end = None if after else best_holds(labels)
            if piece is None:
                yield Followed(order, end if end is not None else best_holds(after), end is None)
            else:
                yield from extend((*order, piece), after, end)

    yield from extend(placed, started(placed), None)


def best_orders(
    steps: Steps,
    count: int,
    bound: Bound | None = None,
    most: int = LABELS,
    placed: tuple[int, ...] = (),
) -> Search:
    """The `count` best orders that begin with what is placed already, fewer where fewer are possible.

    Exact: labels leave a queue in the order of their score, which no later step can raise; a label is dropped
    only where `count` others reach the same situation with no smaller minimum and no larger cost. Where the
    labels run low before any order is complete, those with the most pieces leave the queue first.

    Args:
        bound: upper bounds of the minima that any completion of a placed set can still reach.
        most: labels that the search may make.
    """
    frontier = _Frontier(steps, count, bound)
    if placed:
        _, _, before, s = started(placed)[NOTHING][0]
        free = (math.inf,) * (1 + len(steps.insertion(NOTHING, placed[0])))
        frontier.push(Found(placed, before, s, free, FREE), NOTHING)
    else:
        for piece in range(steps.count):
            minima = (math.inf, *steps.insertion(NOTHING, piece))
            frontier.push(Found((piece,), (), (), minima, FREE), NOTHING)
    found: dict[tuple[int, ...], Found] = {}
    while frontier.queue and len(found) < count and frontier.made < most:
        if not frontier.deepest_first and not frontier.complete and frontier.made > (1 - DIVE) * most:
            frontier.turn_deepest_first()
        label, held = frontier.pop()
        if frontier.whole(label):
            found.setdefault(label.order, label)
        else:
            frontier.grow(label, held)
    proven = 0 if frontier.deepest_first and frontier.queue else len(found)
    ended = not frontier.queue or (len(found) >= count and proven > 0)
    for label in frontier.waiting() if not ended else []:
        found.setdefault(label.order, label)
    ranked = sorted(found.values(), key=_rank)[:count]
    return Search(tuple(ranked), proven, frontier.made, ended)


def _rank(label: Found) -> tuple[float, Cost, tuple[int, ...], list[list[int]]]:
    """What comes first of orders that are whole."""
    return -label.score, label.cost, label.order, [sorted(held) for held in label.held]


class _Frontier:
    """The labels of a search that wait to grow, the most promising first.

    Attributes:
        queue: labels by their rank and number.
        made: labels that ever waited.
        complete: how many of them are whole orders.
        deepest_first: those with the most pieces come first.
    """

    def __init__(self, steps: Steps, count: int, bound: Bound | None):
        self.steps, self.count, self.bound = steps, count, bound
        self.queue: list[tuple[int, float, Cost, tuple[int, ...], list[list[int]], int]] = []
        self.made = self.complete = 0
        self.deepest_first = False
        self._labels: dict[int, tuple[Found, Placed]] = {}  # by their number
        self._kept: dict[
            tuple[Placed, int, Placed], list[tuple[tuple[float, ...], Cost, tuple[int, ...]]]
        ] = {}

    def whole(self, label: Found) -> bool:
        """Whether all pieces are placed, and the last one let go."""
        return len(label.held) == self.steps.count

    def push(self, label: Found, held: Placed) -> None:
        """A label waits, unless enough others are at least as good or nothing can become of it."""
        placed, minima = frozenset(label.order), label.minima
        if not self.whole(label):
            others = self._kept.setdefault((placed, label.order[-1], held), [])
            better = {
                order for minima, cost, order in others
                if cost <= label.cost and all(a >= b for a, b in zip(minima, label.minima, strict=True))
            }  # fmt: skip
            if len(better) >= self.count or label.order in better:
                return
            others.append((label.minima, label.cost, label.order))
            if self.bound is not None:
                minima = tuple(min(a, b) for a, b in zip(minima, self.bound(placed), strict=True))
        score = score_of(minima)
        if score > 0.0:
            self._labels[self.made] = label, held
            depth = -len(label.held) if self.deepest_first else 0
            way = [sorted(pieces) for pieces in label.held]
            heapq.heappush(self.queue, (depth, -score, label.cost, label.order, way, self.made))
            self.made += 1
            self.complete += self.whole(label)

    def pop(self) -> tuple[Found, Placed]:
        """The first label that waits, and what is held when its last piece comes."""
        *_, number = heapq.heappop(self.queue)
        return self._labels.pop(number)

    def waiting(self) -> list[Found]:
        """The whole orders that wait, in the order of their rank."""
        return sorted((label for label, _ in self._labels.values() if self.whole(label)), key=_rank)

    def turn_deepest_first(self) -> None:
        """From now on what has the most pieces grows first."""
        self.deepest_first = True
        self.queue = [(-len(self._labels[entry[-1]][0].held), *entry[1:]) for entry in self.queue]
        heapq.heapify(self.queue)

    def grow(self, label: Found, held: Placed) -> None:
        """All that can come next after a label."""
        steps, placed, piece = self.steps, frozenset(label.order[:-1]), label.order[-1]
        for upcoming in [k for k in range(steps.count) if k not in label.order] or [None]:  # type: ignore[list-item]
            inserted = () if upcoming is None else steps.insertion(placed | {piece}, upcoming)
            if 0.0 in inserted:
                continue
            for support in steps.supports(placed, piece, held, upcoming):
                smallest = (
                    min(label.minima[0], support.quality),
                    *map(min, label.minima[1:], inserted or label.minima[1:]),
                )
                order = label.order if upcoming is None else (*label.order, upcoming)
                cost = _added(label.cost, support.cost)
                grown = Found(order, (*label.held, support.held), (*label.s, support.quality), smallest, cost)
                self.push(grown, support.held)
