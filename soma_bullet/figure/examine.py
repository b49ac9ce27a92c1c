"""Takes a packing apart with hands and equilibrium, piece by piece from the last one back: cheaper than a
plan.

What is asked is what every plan needs at the least: the finished packing stands; each piece has a way in and
a candidate grasp when its turn comes; and what it comes into stands, with as many pieces held as there are
hands to spare. A packing of which no order has that has no plan. Two looks before ask for more: that every
state stands firmly, carries the next piece and bears its push, by itself or with a piece held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

from soma_bullet.planner.analyzers import STEPS, step_analyzer
from soma_bullet.planner.holds import Holds
from soma_bullet.planner.options import PAPER
from soma_bullet.planner.qualities import NOTHING, Placed, Qualities

Outlook = Literal["clean", "held", "open", "possible", "unknown", "impossible"]
# steps that a look may judge; then the planner may find out
LOOKS = {"clean": 25, "held": 40, "possible": 60}
STANDS, LAST, STUCK = "does not stand", "no piece can be the last", "cannot be taken apart"


@dataclass(frozen=True)
class Examination:
    """What is known of a packing without planning it.

    Attributes:
        outlook: `clean`: an order was found of which every state stands by itself and bears the next piece;
            `held`: ... with one piece held at times; `open`: an order that has less, but the looks for a
            better one ended early; `possible`: there is no better one; `unknown`: the looks ended before any
            was found; `impossible`: there is none.
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
        self.steps = {name: step_analyzer(name) for name in (*STEPS, *qualities.options.analyzers)}
        self.grounded = step_analyzer("grounded")
        self.judged: dict[tuple[Placed, int], str] = {}
        self.looks = 0

    def examine(self) -> Examination:
        everything = frozenset(range(len(self.names)))
        final = self.holds.judge(everything)
        if not final.stands:
            return Examination("impossible", STANDS, f"the finished packing {final.reason}")
        failed = set[Placed]()
        outlook: Outlook
        early = False
        for outlook in ("clean", "held", "possible"):
            self.looks, failed = 0, set()
            if self._apart(everything, outlook, failed):
                return Examination("open" if outlook == "possible" and early else outlook)
            early = self.looks >= LOOKS[outlook]
        if self.looks >= LOOKS["possible"]:
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

    def _apart(self, placed: Placed, outlook: Outlook, failed: set[Placed]) -> bool:
        """Whether a set was taken apart within the steps of a look; `failed` gathers sets that cannot be."""
        most = LOOKS[outlook]
        if not placed:
            return True
        if placed in failed:
            return False
        for piece in sorted(placed, key=lambda k: -self.hint[k]):
            if self.looks >= most:
                return False
            self.looks += 1
            rest = placed - {piece}
            good = not self._fault(rest, piece) and self._is_good(rest, piece, outlook)
            if good and self._apart(rest, outlook, failed):
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
        for name, analyse in self.steps.items():
            judgement = analyse(self.q, rest, piece)
            if not judgement.stands:
                return judgement.reason or f"the only way in has quality 0 ({name})"
        if not rest or self.paper or self.holds.judge(rest).stands:
            return ""
        spare = min(self.holds.hands - 1, len(rest))
        if any(self.holds.judge(rest, frozenset(held)).stands for held in combinations(sorted(rest), spare)):
            return ""
        return f"{{{', '.join(self.names[k] for k in sorted(rest))}}} falls, whatever is held"

    def _is_good(self, rest: Placed, piece: int, outlook: Outlook) -> bool:
        """Whether a piece comes into what stands firmly, carries it and bears its push: by itself, or with
        one piece held."""
        if outlook == "possible":
            return True
        if not self.grounded(self.q, rest, piece).stands:
            return False
        if not rest or self.paper:
            return True
        held = [NOTHING]
        if outlook == "held" and self.holds.hands > 1:
            held += [frozenset({other}) for other in sorted(rest)]
        return any(self._is_firm(rest, piece, by) for by in held)

    def _is_firm(self, rest: Placed, piece: int, held: Placed) -> bool:
        """Whether a state with some pieces held is robust and bears the push of the next one."""
        robust = self.holds.judge(rest, held).verdict == "robust"
        return robust and self.q.bearing(rest, held, piece).margin >= 1.0
