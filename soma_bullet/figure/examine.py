"""Takes a packing apart with hands and equilibrium, piece by piece from the last one back: cheaper than a
plan.

What is asked is what every plan needs at the least: the finished packing stands; each piece has a way in and
a candidate grasp when its turn comes; and what it comes into stands, with as many pieces held as there are
hands to spare. A packing of which no order has that has no plan. A first look asks for more: that every state
stands by itself, carries the next piece and bears its push."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

from soma_bullet.planner.analyzers import STEPS, step_analyzer
from soma_bullet.planner.holds import Holds
from soma_bullet.planner.options import PAPER
from soma_bullet.planner.qualities import NOTHING, Placed, Qualities

Outlook = Literal["clean", "possible", "unknown", "impossible"]
FIRST_LOOK = 20  # steps that the first look may judge
SECOND_LOOK = 60  # ... and the second one, after which the planner may find out
STANDS, LAST, STUCK = "does not stand", "no piece can be the last", "cannot be taken apart"


@dataclass(frozen=True)
class Examination:
    """What is known of a packing without planning it.

    Attributes:
        outlook: `clean`: an order was found of which every state stands by itself and bears the next piece;
            `possible`: an order that may need holds; `unknown`: the look ended before one was found;
            `impossible`: there is none.
        obstacle: what makes it impossible, one of STANDS, LAST and STUCK; else empty.
        reason: the same with the pieces and the numbers.
        looks: states and insertions that were judged.
    """

    outlook: Outlook
    obstacle: str = ""
    reason: str = ""
    looks: int = 0


def examine(qualities: Qualities, hint: Sequence[int]) -> Examination:
    """Look at one packing.

    Args:
        hint: the pieces in an order that looks good; they are taken out from its end.
    """
    look = _Look(qualities, hint)
    return replace(look.examine(), looks=1 + len(look.judged))


class _Look:
    """Judges removals; each at most once."""

    def __init__(self, qualities: Qualities, hint: Sequence[int]):
        self.q, self.names = qualities, qualities.assembly.names
        self.hint = {piece: k for k, piece in enumerate(hint)}
        self.holds = Holds(qualities, frozenset())
        self.paper = qualities.options.stability == PAPER
        self.steps = [step_analyzer(name) for name in (*STEPS, *qualities.options.analyzers)]
        self.grounded = step_analyzer("grounded")
        self.judged: dict[tuple[Placed, int], str] = {}
        self.looks = 0

    def examine(self) -> Examination:
        everything = frozenset(range(len(self.names)))
        final = self.holds.judge(everything)
        if not final.stands:
            return Examination("impossible", STANDS, f"the finished packing {final.reason}")
        if self._apart(everything, True, FIRST_LOOK, set()):
            return Examination("clean")
        self.looks, failed = 0, set[Placed]()
        if self._apart(everything, False, SECOND_LOOK, failed):
            return Examination("possible")
        if self.looks >= SECOND_LOOK:
            return Examination("unknown")
        least = min(failed, key=lambda placed: (len(placed), sorted(placed)))
        why = "; ".join(
            f"not {self.names[piece]}: {self.judged[least - {piece}, piece]}" for piece in sorted(least)
            if self.judged.get((least - {piece}, piece))
        )  # fmt: skip
        if least == everything:
            return Examination("impossible", LAST, f"no piece can be the last; {why}")
        state = "{" + ", ".join(self.names[k] for k in sorted(least)) + "}"
        return Examination("impossible", STUCK, f"no piece can be the last of {state}; {why}")

    def _apart(self, placed: Placed, strict: bool, most: int, failed: set[Placed]) -> bool:
        """Whether a set was taken apart within a number of looks; `failed` gathers sets that cannot be."""
        if not placed:
            return True
        if placed in failed:
            return False
        for piece in sorted(placed, key=lambda k: -self.hint[k]):
            if self.looks >= most:
                return False
            self.looks += 1
            rest = placed - {piece}
            good = not self._fault(rest, piece) and (not strict or self._is_clean(rest, piece))
            if good and self._apart(rest, strict, most, failed):
                return True
        if self.looks < most:
            failed.add(placed)
        return False

    def _fault(self, rest: Placed, piece: int) -> str:
        """Why no order puts a piece into a set; empty where one may."""
        if (rest, piece) not in self.judged:
            self.judged[rest, piece] = self._find_fault(rest, piece)
        return self.judged[rest, piece]

    def _find_fault(self, rest: Placed, piece: int) -> str:
        for analyse in self.steps:
            judgement = analyse(self.q, rest, piece)
            if not judgement.stands:
                return judgement.reason
        if not rest or self.paper or self.holds.judge(rest).stands:
            return ""
        spare = min(self.holds.hands - 1, len(rest))
        if any(self.holds.judge(rest, frozenset(held)).stands for held in combinations(sorted(rest), spare)):
            return ""
        return f"{{{', '.join(self.names[k] for k in sorted(rest))}}} falls, whatever is held"

    def _is_clean(self, rest: Placed, piece: int) -> bool:
        """Whether a piece comes into what stands by itself, carries it and bears its push."""
        if not self.grounded(self.q, rest, piece).stands:
            return False
        if not rest or self.paper:
            return True
        robust = self.q.stability(rest).verdict == "robust"
        return robust and self.q.bearing(rest, NOTHING, piece).margin >= 1.0
