"""Which packing of a figure is built, on which side: the first ones with a plan that needs no excuse.

Side after side, as drawn first. The packings of a side are ordered by how promising they look; in that order
they are taken apart with hands and equilibrium, and each that comes apart cleanly is planned in full; what
comes apart with holds after them. The rest is planned where nothing else has a plan on any side."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from soma_bullet.errors import NoSolutionError
from soma_bullet.figure.examine import STANDS, Examination, examine
from soma_bullet.figure.model import packed
from soma_bullet.figure.options import FigureOptions
from soma_bullet.figure.packing import Packing
from soma_bullet.figure.rank import apart_price
from soma_bullet.figure.sides import Standing
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.grasp.sampling import GraspSet
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.plan import NoPlanError, make_plan
from soma_bullet.planner.qualities import Qualities

Progress = Callable[[str, float], None]  # what is going on, and the fraction that is done
RANKED = 1000  # packings of a side whose promise is looked at; of more, the first ones
SHARE = 0.5  # of what is left of looks and tries that a side may spend while others come after it
ENOUGH = 3  # packings of a side that need holds, or may: then these are planned
ROBUST = "robust"


@dataclass(frozen=True)
class SideSurvey:
    """What became of the packings of one side.

    Attributes:
        side: which side of the drawing is down.
        packings: there, up to rotations about the vertical.
        examined: taken apart with hands and equilibrium.
        planned: how many were planned.
        excused: how many of these plans have warnings, or states that depend on clearances.
        obstacles: why packings cannot be built -> how many.
        unplanned: planned in full, and without a plan.
        note: why no packing was looked at; else empty.
    """

    side: str
    packings: int = 0
    examined: int = 0
    planned: int = 0
    excused: int = 0
    obstacles: dict[str, int] = field(default_factory=dict)
    unplanned: int = 0
    note: str = ""

    @property
    def left(self) -> int:
        """Packings that nobody looked at, or of which nobody knows whether they can be built."""
        return self.packings - sum(self.obstacles.values()) - self.unplanned - self.planned

    def text(self) -> str:
        """One line for people."""
        if self.note:
            return f"{self.side}: {self.note}"
        parts = [f"{self.packings} packings", f"{self.examined} examined"]
        parts += [f"{count} {obstacle}" for obstacle, count in self.obstacles.items()]
        parts += [f"{self.unplanned} without a plan"] if self.unplanned else []
        excused = f" ({self.excused} with warnings or states that depend on clearances)"
        parts += [f"{self.planned} planned{excused if self.excused else ''}"] if self.planned else []
        parts += [f"{self.left} left aside"] if self.left else []
        return f"{self.side}: {', '.join(parts)}"


@dataclass(frozen=True)
class Candidate:
    """A packing with its plan.

    Attributes:
        side: which side of the drawing is down.
        packing: so turned.
        plan: of the assembly that `packed` makes of it.
    """

    side: str
    packing: Packing
    plan: AssemblyPlan

    @property
    def clean(self) -> bool:
        """The plan has no warning, and no state of it depends on clearances."""
        return self.excuses == 0

    @property
    def excuses(self) -> int:
        """Warnings, and states that depend on clearances."""
        return len(self.plan.warnings) + sum(step.verdict != ROBUST for step in self.plan.steps)


class NoFigurePlanError(NoSolutionError):
    """No packing that was looked at can be built. Carries what was looked at, and the reasons."""

    def __init__(self, name: str, surveys: tuple[SideSurvey, ...], reasons: Counter[str]):
        self.surveys = surveys
        looked = sum(survey.packings - survey.left for survey in surveys)
        left = sum(survey.left for survey in surveys)
        self.proven = left == 0
        said = f"no packing of the {looked} looked at can be built"
        if (
            self.proven
            and all(set(survey.obstacles) <= {STANDS} for survey in surveys)
            and not any(survey.unplanned for survey in surveys)
        ):
            said = f"stands on no side: all {looked} packings and sides fall"
        rest = "" if self.proven else f"; {left} more were left aside: --looks and --tries go further"
        super().__init__("figure", f"{name}: {said}{rest}", reasons, [survey.text() for survey in surveys])


class Chooser:
    """Looks at packings until there are enough good plans, or no looks left.

    Args:
        refused: packings that a later stage found impossible.

    Attributes:
        reasons: why packings cannot be built -> how many.
        plans: that were made.
    """

    def __init__(
        self,
        name: str,
        hands: HandSet,
        options: FigureOptions,
        planner: PlannerOptions,
        progress: Progress,
        refused: frozenset[Packing] = frozenset(),
    ):
        self.name, self.hands, self.options, self.planner = name, hands, options, planner
        self.progress, self.refused = progress, refused
        self._surveys: dict[str, SideSurvey] = {}
        self._reserve: list[tuple[str, Packing]] = []
        self.reasons = Counter[str]()
        self.plans: list[Candidate] = []
        self.looks, self.tries = options.looks, options.tries
        self._grasps: dict[str, GraspSet] = {}

    @property
    def surveys(self) -> tuple[SideSurvey, ...]:
        """What became of each side that was looked at."""
        return tuple(self._surveys.values())

    @property
    def satisfied(self) -> bool:
        """There are as many good plans as were asked for."""
        return sum(plan.clean for plan in self.plans) >= self.options.plans

    def best(self) -> Candidate | None:
        """The plan with the fewest excuses, then the best score; of equal ones the first."""
        return min(self.plans, key=lambda plan: (plan.excuses, -plan.plan.score), default=None)

    def pass_over(self, standing: Standing) -> None:
        """Note a side on which the figure falls."""
        self._surveys[standing.side] = SideSurvey(standing.side, note=f"cannot stand: {standing.falls}")

    def look_at(self, standing: Standing, found: tuple[Packing, ...], more: bool) -> None:
        """Examine packings of one side, and plan those that come apart; `more`: other sides come after it."""
        side, held = standing.side, list[Packing]()
        spare_looks = self.looks - math.ceil(self.looks * SHARE) if more else 0
        spare_tries = self.tries - math.ceil(self.tries * SHARE) if more else 0
        known = sum(packing in self.refused for packing in found)
        unbuilt = {"without a schedule": known} if known else {}
        self._surveys[side] = SideSurvey(side, len(found), obstacles=unbuilt)
        found = tuple(packing for packing in found if packing not in self.refused)
        self.progress(f"{side}: ordering {len(found)} packings", 0.0)
        # packings that look equally good are mixed: neighbours in the search have most pieces in common
        mixed = np.random.default_rng(0).permutation(len(found[:RANKED])).tolist()
        priced = sorted((apart_price(found[k])[0], tie, k) for tie, k in enumerate(mixed))
        for number, (_, _, k) in enumerate(priced):
            packing, hint = found[k], apart_price(found[k])[1]
            spent = self.looks <= spare_looks or self.tries <= spare_tries
            if self.satisfied or spent or len(held) == ENOUGH:
                break
            self.progress(f"{side}: taking packing {number + 1} of {len(found)} apart", 0.0)
            qualities = self.qualities(packing)
            result = examine(qualities, hint)
            self.looks -= result.looks
            self._note(side, examined=self._surveys[side].examined + 1)
            if result.outlook == "impossible":
                self._rule_out(side, result)
            elif result.outlook == "clean":
                self._plan(side, packing, qualities)
            elif result.outlook in ("held", "open"):
                held.append(packing)
            else:
                self._reserve.append((side, packing))
        for packing in held:
            if not self.satisfied and self.tries > spare_tries:
                self._plan(side, packing, self.qualities(packing))

    def look_at_the_rest(self) -> None:
        """Plan what came apart neither cleanly nor with holds, until there is any plan."""
        for side, packing in self._reserve:
            if not self.plans and self.tries:
                self._plan(side, packing, self.qualities(packing))

    def qualities(self, packing: Packing) -> Qualities:
        """Those of a packing; grasps of a piece alone are sampled once."""
        assembly, letters = packed(self.name, packing), [letter for letter, _ in packing]
        known = {k: self._grasps[letter] for k, letter in enumerate(letters) if letter in self._grasps}
        qualities = Qualities(assembly, self.hands, self.planner, known)
        for k, letter in enumerate(letters):
            self._grasps.setdefault(letter, qualities.grasps(k))
        return qualities

    def _note(self, side: str, **changes: Any) -> None:
        self._surveys[side] = replace(self._surveys[side], **changes)

    def _rule_out(self, side: str, result: Examination) -> None:
        obstacles = dict(self._surveys[side].obstacles)
        obstacles[result.obstacle] = obstacles.get(result.obstacle, 0) + 1
        self._note(side, obstacles=obstacles)
        self.reasons[result.reason] += 1

    def _plan(self, side: str, packing: Packing, qualities: Qualities) -> None:
        self.tries -= 1
        self.progress(f"{side}: planning a packing", 0.0)
        survey = self._surveys[side]
        try:
            plan = make_plan(qualities.assembly, self.hands, self.planner, qualities=qualities)
        except NoPlanError as error:
            self._note(side, unplanned=survey.unplanned + 1)
            for reason, count in error.reasons.most_common(1):
                self.reasons[reason] += count
            return
        candidate = Candidate(side, packing, plan)
        self._note(side, planned=survey.planned + 1, excused=survey.excused + (not candidate.clean))
        self.plans.append(candidate)
