"""Every assembly order with its qualities, its held sets and its score (paper Sec. IV-A, F and G)."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from soma_bullet.planner.qualities import Placed, Qualities

NOTHING: Placed = frozenset()
# (cost, held sets so far). Cost: pieces gripped again, held, states that depend on clearance, changes, minus min S. What adds
# up comes before what takes the least, so that the best way to a held set is part of the best way on from it.
_Label = tuple[tuple[int, int, int, int, float], list[Placed]]


@dataclass(frozen=True)
class OrderRow:
    """One row of the paper's matrices; every tuple has one entry a step, in assembly order.

    Attributes:
        order: names of the pieces.
        s: stability when the piece is placed, nothing held.
        s_recomputed: stability with the assisting hand.
        g: number of accessible grasps.
        a: assemblability.
        types: contact types of the assemblability.
        directions: unit assembly directions; None where there is no way in.
        held: names of the pieces that are held after the step.
        score: min S * min G * min A.
        feasible: every step can be done with the hands there are.
        reason: why not, else empty.
    """

    order: tuple[str, ...]
    s: tuple[float, ...]
    s_recomputed: tuple[float, ...]
    g: tuple[int, ...]
    a: tuple[float, ...]
    types: tuple[str, ...]
    directions: tuple[tuple[float, float, float] | None, ...]
    held: tuple[tuple[str, ...], ...]
    score: float
    feasible: bool
    reason: str

    @property
    def stable_throughout(self) -> bool:
        """No state of the order needs a hand."""
        return all(value > 0 for value in self.s)


def score_of(s: tuple[float, ...], g: tuple[int, ...], a: tuple[float, ...]) -> float:
    """min S * min G * min A (paper Sec. IV-G); infinity times zero is zero."""
    factors = (min(s), float(min(g)), min(a))
    return 0.0 if 0.0 in factors else math.prod(factors)


class Orders:
    """Rows of orders of one assembly; steps that orders share are evaluated once."""

    def __init__(self, qualities: Qualities):
        self.q = qualities
        self.names = qualities.assembly.names
        self.spare = qualities.options.hands - 1
        self._holds: dict[tuple[Placed, int | None, Placed], bool] = {}
        self._moves: dict[tuple[Placed, int, Placed, int | None], tuple[Placed, ...]] = {}

    def all_rows(self) -> list[OrderRow]:
        """Every order, in lexicographic order of the file's pieces."""
        return [self.row(order) for order in itertools.permutations(range(len(self.names)))]

    def row(self, order: tuple[int, ...]) -> OrderRow:
        """The row of one order (indices of the pieces)."""
        ways, g = [], []
        for k, piece in enumerate(order):
            before = frozenset(order[:k])
            ways.append(self.q.assemblability(piece, before))
            g.append(self.q.graspability(piece, before))
        paper = self.q.options.stability == "paper"
        s, recomputed, held, reason = self._paper_support(order) if paper else self.equilibrium_support(order)
        for piece, way, count in zip(order, ways, g, strict=True):
            if way.direction is None and not reason:
                by = " and ".join("the support" if k < 0 else self.names[k] for k in way.blockers)
                reason = f"{self.names[piece]} has no straight way in ({way.type}, blocked by {by})"
            if count == 0 and not reason:
                reason = f"{self.names[piece]} has no accessible grasp"
        a = tuple(way.quality for way in ways)
        return OrderRow(
            order=tuple(self.names[p] for p in order),
            s=tuple(s),
            s_recomputed=tuple(recomputed),
            g=tuple(g),
            a=a,
            types=tuple(way.type for way in ways),
            directions=tuple(None if w.direction is None else tuple((np.round(w.direction, 12) + 0.0).tolist()) for w in ways),
            held=tuple(tuple(self.names[p] for p in sorted(pieces)) for pieces in held),
            score=0.0 if reason else score_of(tuple(recomputed), tuple(g), a),
            feasible=not reason,
            reason=reason,
        )

    def _paper_support(self, order: tuple[int, ...]) -> tuple[list[float], list[float], list[Placed], str]:
        """Raw and recomputed s, the zero sets Z(S), and what fails (paper Sec. IV-F)."""
        raw: list[float] = []
        recomputed: list[float] = []
        held: list[Placed] = []
        reason = ""
        for k, piece in enumerate(order):
            placed = frozenset(order[: k + 1])
            values = {j: self.q.paper_stability(j, placed) for j in order[: k + 1]}
            zeros = frozenset(j for j, value in values.items() if value == 0.0)
            raw.append(values[piece])
            recomputed.append(min((v for v in values.values() if v > 0.0), default=math.inf))
            held.append(zeros)
            if len(zeros) > self.spare and not reason:
                lack = f"{len(zeros)} to hold, {self.spare} to spare"
                reason = f"{self._named(zeros)} would fall in {self._named(placed)}: {lack}"
            upcoming = order[k + 1] if k + 1 < len(order) else None
            if not reason and not self._can_hold(placed, upcoming, zeros):
                reason = f"{self._named(zeros)} cannot be gripped clear of {self._next(upcoming)}"
        return raw, recomputed, held, reason

    def equilibrium_support(self, order: tuple[int, ...]) -> tuple[list[float], list[float], list[Placed], str]:
        """S without holds, S with them, the set that is held after each step, and what fails (empty where nothing does).

        A piece is not gripped again where it can be avoided. Among such holds the smallest held sets win; then those with the
        fewest clearance-dependent states; then those with the fewest changes; then those of the best min S.
        """
        raw = [self.q.stability(frozenset(order[: k + 1])).quality for k in range(len(order))]
        labels: dict[Placed, _Label] = {NOTHING: ((0, 0, 0, 0, -math.inf), [])}
        for k, piece in enumerate(order):
            upcoming = order[k + 1] if k + 1 < len(order) else None
            after: dict[Placed, _Label] = {}
            for before, ((again, count, leaning, changes, worst), path) in labels.items():
                for held in self.held_after(frozenset(order[:k]), piece, before, upcoming):
                    state = self.q.stability(frozenset(order[: k + 1]), held)
                    cost = (
                        again + len(held - before - {piece}),
                        count + len(held),
                        leaning + (state.verdict == "clearance-dependent"),
                        changes + len(held - before),
                        max(worst, -state.quality),
                    )
                    if held not in after or cost < after[held][0]:
                        after[held] = (cost, [*path, held])
            if not after:
                placed = frozenset(order[: k + 1])
                path = self._best_path(labels)
                missing = len(order) - len(path)
                reason = f"{self._named(placed)} falls whatever {self.spare} hand(s) could hold before {self._next(upcoming)}"
                return raw, self._with_holds(order, path) + [0.0] * missing, path + [NOTHING] * missing, reason
            labels = after
        path = self._best_path(labels)
        return raw, self._with_holds(order, path), path, ""

    def _best_path(self, labels: dict[Placed, _Label]) -> list[Placed]:
        return min(labels.values(), key=lambda label: label[0])[1]

    def _with_holds(self, order: tuple[int, ...], path: list[Placed]) -> list[float]:
        return [self.q.stability(frozenset(order[: k + 1]), held).quality for k, held in enumerate(path)]

    def held_after(self, before: Placed, piece: int, held: Placed, upcoming: int | None) -> tuple[Placed, ...]:
        """Held sets that can be reached after `piece` went in, so that a hand is free for the next piece.

        A hand may let go, or take another piece, only while what remains held keeps the state from being unstable.
        """
        key = (before, piece, held, upcoming)
        if key in self._moves:
            return self._moves[key]
        placed = before | {piece}
        start = held | {piece}
        seen, stack = {start}, [start]
        while stack:
            current = stack.pop()
            options = [current - {j} for j in current]
            if len(current) <= self.spare:
                options += [current | {j} for j in placed - current]
            for option in options:
                if option not in seen and self.q.stability(placed, option).verdict != "unstable":
                    seen.add(option)
                    stack.append(option)
        limit = self.spare if upcoming is not None else 0
        reached = [h for h in seen if len(h) <= limit and self._can_hold(placed, upcoming, h)]
        reached = [h for h in reached if self.q.stability(placed, h).verdict != "unstable"]
        self._moves[key] = tuple(sorted(reached, key=lambda h: (len(h), sorted(h))))
        return self._moves[key]

    def _can_hold(self, placed: Placed, upcoming: int | None, held: Placed) -> bool:
        """Whether each piece of `held` has an assisting grasp clear of the next piece and its way in."""
        key = (placed, upcoming, held)
        if key not in self._holds:
            direction = None if upcoming is None else self.q.assemblability(upcoming, placed).direction
            self._holds[key] = all(len(self.q.assisting(piece, placed, upcoming, direction)) for piece in held)
        return self._holds[key]

    def _named(self, pieces: Placed) -> str:
        return "{" + ", ".join(self.names[p] for p in sorted(pieces)) + "}"

    def _next(self, upcoming: int | None) -> str:
        return "the end" if upcoming is None else self.names[upcoming]
