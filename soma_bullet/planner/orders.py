"""Assembly orders with their qualities, their held sets and their score (paper Sec. IV-A, F and G)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from soma_bullet.planner.analyzers import STEPS, Judgement, grounded, step_analyzer
from soma_bullet.planner.holds import AIR, RULES, Holds
from soma_bullet.planner.options import PAPER
from soma_bullet.planner.qualities import Placed, Qualities
from soma_bullet.planner.search import (
    FREE,
    NOTHING,
    Followed,
    Search,
    Support,
    best_orders,
    follow,
    follow_all,
    score_of,
)

Direction = tuple[float, float, float]
MOST_ENUMERATED = 8  # pieces; beyond, only the best orders are looked for


@dataclass(frozen=True)
class OrderRow:
    """One row of the paper's matrices; every tuple has one entry a step, in assembly order.

    Attributes:
        order: names of the pieces.
        s: stability when the piece is placed, nothing held.
        s_recomputed: stability with the assisting hand.
        g: number of candidate grasps.
        a: assemblability.
        types: contact types of the assemblability.
        directions: unit assembly directions; None where there is no way in.
        held: names of the pieces that are held after the step.
        score: min S * min G * min A, and the minima of further analyzers.
        feasible: every step can be done with the hands there are.
        reason: why not, with numbers, else empty.
        blocked_by: the analyzer that says so, else empty.
        blocked_at: index of the step that fails; the number of steps where none does.
        extra: values of further analyzers, by name.
    """

    order: tuple[str, ...]
    s: tuple[float, ...]
    s_recomputed: tuple[float, ...]
    g: tuple[int, ...]
    a: tuple[float, ...]
    types: tuple[str, ...]
    directions: tuple[Direction | None, ...]
    held: tuple[tuple[str, ...], ...]
    score: float
    feasible: bool
    reason: str
    blocked_by: str = ""
    blocked_at: int = 0
    extra: dict[str, tuple[float, ...]] = field(default_factory=dict)

    @property
    def holds(self) -> int:
        """Number of holds, summed over the steps."""
        return sum(map(len, self.held))

    @property
    def stable_throughout(self) -> bool:
        """No state of the order needs a hand."""
        return all(value > 0 for value in self.s)


@dataclass(frozen=True)
class _Cell:
    """One insertion: values of the analyzers, contact type, direction, and the analyzer that rules it out,
    with its reason."""

    values: tuple[float, ...]
    type: str
    direction: Direction | None
    fault: str
    reason: str


@dataclass(frozen=True)
class Fault:
    """Why a step cannot be done."""

    step: int
    stage: str
    reason: str


class Orders:
    """Rows of orders of one assembly; steps that orders share are evaluated once.

    Args:
        rules: what is asked of an order.
        placed: pieces that are in place already; every order begins with them.
    """

    def __init__(self, qualities: Qualities, rules: frozenset[str] = RULES, placed: tuple[int, ...] = ()):
        self.q, self.rules, self.placed = qualities, rules, placed
        self.holds = Holds(qualities, rules)
        self.names = qualities.assembly.names
        self.count = len(self.names)
        self.paper = qualities.options.stability == PAPER
        # paper mode, where some order is stable throughout: the assisting hand stays away
        self.raw_only = False
        self.analyzers = {name: step_analyzer(name) for name in (*STEPS, *qualities.options.analyzers)}
        self._steps: dict[tuple[Placed, int], dict[str, Judgement]] = {}
        self._cells: dict[tuple[Placed, int], _Cell] = {}
        self._faults: dict[tuple[tuple[int, ...], int | None], Fault] = {}
        self._paper: dict[Placed, tuple[dict[int, float], Placed]] = {}

    # what the search asks

    def insertion(self, placed: Placed, piece: int) -> tuple[float, ...]:
        """G, A and the values of further analyzers of one insertion; zeros where it is ruled out."""
        cell = self._cell(placed, piece)
        return (0.0,) * len(cell.values) if cell.fault else cell.values

    def supports(self, before: Placed, piece: int, held: Placed, upcoming: int | None) -> tuple[Support, ...]:
        """What may be held after `piece` went in. Paper mode: exactly the pieces of zero s (paper Sec.
        IV-F)."""
        if not self.paper:
            return self.holds.supports(before, piece, held, upcoming)
        placed = before | {piece}
        values, zeros = self.paper_state(placed)
        if self._paper_fault(placed, upcoming):
            return ()
        if self.raw_only:
            return (Support(zeros, values[piece], FREE),) if values[piece] > 0.0 else ()
        return (Support(zeros, min((v for v in values.values() if v > 0.0), default=math.inf), FREE),)

    def bound(self, placed: Placed) -> tuple[float, ...]:
        """No completion of a placed set reaches larger minima: fewer grasps are left the more is placed."""
        left = [piece for piece in range(self.count) if piece not in placed]
        fewest = min((float(len(self.q.accessible(piece, placed))) for piece in left), default=math.inf)
        return (math.inf, fewest, *([math.inf] * (len(self.analyzers) - 1)))

    # rows

    def all_rows(self) -> list[OrderRow]:
        """Every order, in lexicographic order of the file's pieces."""
        followed = list(follow_all(self, self.placed))
        rows = [self._row(item) for item in followed]
        if not self.paper or not any(row.feasible and row.stable_throughout for row in rows):
            return rows
        # paper Sec. III and IV-G: the assisting hand stays away, and raw s counts
        return [self._row(item, raw=True) for item in followed]

    def best_rows(self, count: int) -> tuple[list[OrderRow], Search]:
        """The best orders, best first, without the others; and the search that found them."""
        most = self.q.options.labels
        if self.paper:
            self.raw_only = True
            search = best_orders(self, count, self.bound, most, self.placed)
            if search.found:
                raw = (Followed(f.order, (0.0, FREE, f.held, f.s), True) for f in search.found)
                return [self._row(item, raw=True) for item in raw], search
            self.raw_only = False
        search = best_orders(self, count, self.bound, most, self.placed)
        followed = (Followed(f.order, (f.minima[0], f.cost, f.held, f.s), True) for f in search.found)
        return [self._row(item) for item in followed], search

    def row(self, order: Sequence[int]) -> OrderRow:
        """The row of one order (indices of the pieces)."""
        return self._row(follow(self.supports, tuple(order), len(self.placed)))

    def _row(self, followed: Followed, raw: bool = False) -> OrderRow:
        order, (_, _, held, s_held) = followed.order, followed.holds
        sets = [frozenset(order[:k]) for k in range(len(order) + 1)]
        cells = [self._cell(sets[k], piece) for k, piece in enumerate(order)]
        missing = len(order) - len(held)
        if self.paper:
            states = [self.paper_state(placed) for placed in sets[1:]]
            s = tuple(values[piece] for piece, (values, _) in zip(order, states, strict=True))
            s_held = tuple(
                min((v for v in values.values() if v > 0.0), default=math.inf) for values, _ in states
            )
            held = tuple(zeros for _, zeros in states)
        else:
            s = tuple(self.holds.judge(placed).quality for placed in sets[1:])
            s_held, held = (*s_held, *[0.0] * missing), (*held, *[NOTHING] * missing)
        fault = self._fault(followed, cells)
        columns = list(zip(*(cell.values for cell in cells), strict=True))  # one for each analyzer
        first = len(self.placed)
        left = (min(column[first:], default=math.inf) for column in columns)
        score = 0.0 if fault else score_of((min((s if raw else s_held)[max(first - 1, 0) :]), *left))
        return OrderRow(
            order=tuple(self.names[p] for p in order),
            s=s,
            s_recomputed=s_held,
            g=tuple(map(int, columns[0])),
            a=columns[1],
            types=tuple(cell.type for cell in cells),
            directions=tuple(cell.direction for cell in cells),
            held=tuple(self._names_of(pieces) for pieces in held),
            score=score,
            feasible=fault is None,
            reason=fault.reason if fault else "",
            blocked_by=fault.stage if fault else "",
            blocked_at=fault.step if fault else len(order),
            extra=dict(zip(self.q.options.analyzers, columns[2:], strict=True)),
        )

    def _cell(self, placed: Placed, piece: int) -> _Cell:
        """What one insertion puts into its row."""
        if (placed, piece) not in self._cells:
            way, judged = self.q.assemblability(piece, placed), self._judged(placed, piece)
            values = tuple(judgement.quality for judgement in judged.values())
            if AIR in self.rules and not self.paper:
                judged = judged | {"grounded": grounded(self.q, placed, piece)}
            # that there is no way in comes before that no hand brings it
            ranked = sorted(judged, key=lambda name: name != "assemblability")
            fault = next((name for name in ranked if not judged[name].stands), "")
            self._cells[placed, piece] = _Cell(
                values=values,
                type=way.type,
                direction=None if way.direction is None else rounded(way.direction),
                fault=fault,
                reason=f"{self.names[piece]} into {self._named(placed)}: {judged[fault].reason}"
                if fault
                else "",
            )
        return self._cells[placed, piece]

    def _names_of(self, pieces: Placed) -> tuple[str, ...]:
        return tuple(self.names[p] for p in sorted(pieces)) if pieces else ()

    def _fault(self, followed: Followed, cells: list[_Cell]) -> Fault | None:
        """The first step that cannot be done."""
        order, k = followed.order, len(followed.holds[2])
        faults = (Fault(i, cell.fault, cell.reason) for i, cell in enumerate(cells) if cell.fault)
        first = next((fault for fault in faults if fault.step >= len(self.placed)), None)
        if followed.complete or (first is not None and first.step <= k):
            return first
        if (
            order[: k + 1],
            _next(order, k),
        ) not in self._faults:  # the reason is that of the state, whatever comes later
            fault = self._paper_fault(frozenset(order[: k + 1]), _next(order, k)) if self.paper else None
            found = Fault(k, *fault) if fault else self.support_fault(order, k)
            self._faults[order[: k + 1], _next(order, k)] = found
        return self._faults[order[: k + 1], _next(order, k)]

    def support_fault(self, order: tuple[int, ...], k: int) -> Fault:
        """Why the state after step k of an order cannot be kept up."""
        placed, upcoming = frozenset(order[: k + 1]), _next(order, k)
        before = "the end" if upcoming is None else self.names[upcoming]
        spare = self.holds.hands - 1 if upcoming is not None else 0
        sets = map(frozenset, itertools.combinations(sorted(placed), min(spare, k + 1)))
        some = any(self.holds.judge(placed, held).stands for held in sets)
        stage = "assisting grasp" if some and upcoming is not None else "stability"
        when = f" before {before}" if stage == "assisting grasp" or upcoming is None else ""
        does = "falls" if not self.holds.judge(placed).stands else "does not stay"
        return Fault(k, stage, f"{self._named(placed)} {does}{when}: {self.holds.why_not(placed, upcoming)}")

    def _judged(self, placed: Placed, piece: int) -> dict[str, Judgement]:
        key = (placed, piece)
        if key not in self._steps:
            self._steps[key] = {
                name: analyse(self.q, placed, piece) for name, analyse in self.analyzers.items()
            }
        return self._steps[key]

    def paper_state(self, placed: Placed) -> tuple[dict[int, float], Placed]:
        """s of every placed piece, and the zero set Z(S) (paper Sec. IV-F)."""
        if placed not in self._paper:
            values = {piece: self.q.paper_stability(piece, placed) for piece in sorted(placed)}
            self._paper[placed] = values, frozenset(piece for piece, value in values.items() if value == 0.0)
        return self._paper[placed]

    def _paper_fault(self, placed: Placed, upcoming: int | None) -> tuple[str, str] | None:
        """Stage and reason why the zero set cannot be held, or None. The paper's "less than" is read as "at
        most"."""
        _, zeros = self.paper_state(placed)
        spare = self.holds.hands - 1
        if len(zeros) > spare:
            lack = f"{len(zeros)} to hold, {spare} to spare"
            return "stability", f"{self._named(zeros)} would fall in {self._named(placed)}: {lack}"
        if self.holds.can_hold(placed, upcoming, zeros):
            return None
        before = "the end" if upcoming is None else self.names[upcoming]
        return (
            "assisting grasp",
            f"{self._named(zeros)} in {self._named(placed)} cannot be gripped clear of {before}",
        )

    def _named(self, pieces: Sequence[int] | Placed) -> str:
        return "{" + ", ".join(self.names[p] for p in sorted(pieces)) + "}"


def rounded(direction: np.ndarray) -> Direction:
    """A direction (3,) as plain numbers, without the last digits."""
    x, y, z = (float(v) for v in np.round(direction, 12) + 0.0)
    return x, y, z


def _next(order: tuple[int, ...], k: int) -> int | None:
    return order[k + 1] if k + 1 < len(order) else None
