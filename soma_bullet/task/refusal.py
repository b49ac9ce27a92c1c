"""Why something cannot be done: typed, counted, and explained in one place.

What is told first is what decided: how far the search came, which bodies were in the way there, by how much.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from soma_bullet.errors import NoSolutionError

TOLD = 4  # reasons of the step at which a search ended
MEASURED = 8  # times that the distance of a pair is measured


@dataclass(frozen=True)
class Refusal:
    """One reason why a candidate was ruled out, whatever the arm and the grasp.

    Attributes:
        piece: of the step that it is about.
        action: what could not be done, as `insertion` or `approach to hold Z`; empty where the cause says it.
        cause: `collision`, `unreachable`, `branch` (a joint would jump), or a sentence.
        pair: the bodies that were too near to each other, of a collision.
    """

    piece: str
    action: str
    cause: str
    pair: tuple[str, str] | None = None

    def __str__(self) -> str:
        cause = " meets ".join(self.pair) if self.pair else self.cause
        return f"{self.piece}: {self.action}: {cause}" if self.action else f"{self.piece}: {cause}"


@dataclass(frozen=True)
class Evidence:
    """A refusal that was met at the step to which the search came.

    Attributes:
        count: how often there.
        arm, grasp: of the time when least was missing, among the first few; where they are known.
        distance: between the two bodies then, negative where they overlap, and what had to be kept [m]; None
            where nothing collided.
    """

    count: int
    arm: str = ""
    grasp: int | None = None
    distance: tuple[float, float] | None = None


@dataclass
class Refusals:
    """What has been refused in all searches of one episode.

    Attributes:
        counts: how often each was met.
        step: of the plan, at which the search is; order: of the plan that is searched.
        deepest: the step to which any search came; of which order; what was met there.
    """

    counts: Counter[Refusal] = field(default_factory=Counter)
    order: tuple[str, ...] = ()
    step: int = 0
    deepest: int = -1
    deepest_order: tuple[str, ...] = ()
    there: dict[Refusal, Evidence] = field(default_factory=dict)

    def at(self, step: int) -> None:
        """The search is at a step of the plan."""
        self.step = step
        if step > self.deepest:
            self.deepest, self.deepest_order, self.there = step, self.order, {}

    def add(
        self,
        refusal: Refusal,
        count: int = 1,
        arm: str = "",
        grasp: int | None = None,
        distance: Callable[[], tuple[float, float]] | None = None,
    ) -> Refusal:
        """Count one; `distance` is asked for once where it matters."""
        self.counts[refusal] += count
        if count and self.step == self.deepest and self.order == self.deepest_order:
            known = self.there.get(refusal, Evidence(0))
            found = Evidence(known.count, arm, grasp)
            if distance is not None and known.count < MEASURED:
                found = replace(found, distance=distance())
            nearest = max(known, found, key=_how_near) if known.count else found
            self.there[refusal] = replace(nearest, count=known.count + count)
        return refusal

    def sentences(self) -> Counter[str]:
        """How often each was met, as people read it, most frequent first."""
        return Counter({str(refusal): count for refusal, count in (+self.counts).most_common()})

    def decided(self) -> tuple[str, ...]:
        """What ended the search: the step to which it came, and what was met there, most frequent first."""
        if self.deepest < 0 or not self.there:
            return ()
        order = self.deepest_order
        piece = order[self.deepest] if self.deepest < len(order) else ""
        of = f" of {' <- '.join(order)}" if order else ""
        lines = [f"the search came to step {self.deepest + 1}{of}, {piece}, and no further:"]
        own = {r: e for r, e in self.there.items() if r.piece == piece} or self.there
        ranked = sorted(own.items(), key=lambda item: -item[1].count)[:TOLD]
        return (*lines, *(f"  {e.count} x {r}{_by_how_much(e)}" for r, e in ranked))

    def error(self, stage: str, summary: str) -> NoSolutionError:
        """The error that says all this."""
        return NoSolutionError(stage, summary, self.sentences(), self.decided())


def _how_near(evidence: Evidence) -> float:
    """How little was missing."""
    if evidence.distance is None:
        return float("-inf")
    apart, wanted = evidence.distance
    return apart - wanted


def _by_how_much(evidence: Evidence) -> str:
    if evidence.distance is None:
        return ""
    apart, wanted = (1e3 * value for value in evidence.distance)
    far = f"overlapping by {-apart:.1f} mm" if apart < 0 else f"{apart:.1f} mm apart"
    by = f", {evidence.arm} arm" if evidence.arm else ""
    grasp = f", grasp {evidence.grasp}" if evidence.grasp is not None else ""
    return f" ({far}, {wanted:.1f} mm wanted{by}{grasp})"
