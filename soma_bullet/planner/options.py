"""How the planner judges, and what a hold must resist."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

from soma_bullet.assembly.advice import Advice
from soma_bullet.grasp.options import SamplingOptions
from soma_bullet.option import NOT_NEGATIVE, SEED, Options, Range

# that a search over orders may make: about a minute and 0.3 GB for twelve to sixteen blocks
LABELS = 40_000
PAPER = "paper"  # judges single pieces; its holds follow from their qualities (paper Sec. IV-F)
HANDS = 2  # where there is no cell whose arms could be counted


@dataclass(frozen=True)
class HoldLoad(Options):
    """What a hold must resist, beside gravity."""

    push: Annotated[float, NOT_NEGATIVE] = 2.0
    """A hold must resist this force of the next insertion along its direction [N]; a guarded insertion stops
    below it."""
    disturbance: Annotated[float, NOT_NEGATIVE] = 0.1
    """A hold must resist this horizontal acceleration of every placed piece [g]."""


@dataclass(frozen=True)
class PlannerOptions(Options):
    """How the planner judges."""

    names: ClassVar[Mapping[str, str]] = {"analyzers": "analyzer", "load": ""}

    stability: str = "equilibrium"
    """equilibrium: the whole placed set at once; paper: one piece against fixed neighbours (holds follow
    equilibrium anyway); or an analyzer of your own, as module:function."""
    hands: Annotated[int | None, Range(1)] = None
    """Hands of the robot, of which one inserts and the others may hold; by default one for each arm of the
    cell, and two where there is no cell. Of more arms, so many are used at once, of any of them; where there
    are fewer, the further hands are like theirs, in turn."""
    seed: Annotated[int, SEED] = 0
    """Picks among orders of equal score."""
    top: Annotated[int, Range(1)] = 1
    """How many of the best orders are worked out step by step."""
    analyzers: tuple[str, ...] = ()
    """A further analyzer of steps, whose smallest value is a factor of the score: grounded (no piece is put
    into the air), or your own as module:function; repeatable."""
    load: HoldLoad = HoldLoad()
    """What a hold must resist, beside gravity."""
    sampling: SamplingOptions = SamplingOptions()
    """How grasps are sampled."""
    labels: Annotated[int, Range(1)] = LABELS
    """Labels that the search over the orders of many pieces may make, after which it ends with the best that
    it has found."""

    @property
    def hand_count(self) -> int:
        """Hands of the robot."""
        return HANDS if self.hands is None else self.hands

    def advised(self, advice: Advice) -> PlannerOptions:
        """The same with what an assembly asks for, where these options have their defaults."""
        usual, load = PlannerOptions(), self.load
        if advice.push is not None and load.push == usual.load.push:
            load = replace(load, push=advice.push)
        if advice.disturbance is not None and load.disturbance == usual.load.disturbance:
            load = replace(load, disturbance=advice.disturbance)
        stability = advice.stability if self.stability == usual.stability else None
        return replace(
            self,
            load=load,
            stability=stability or self.stability,
            analyzers=self.analyzers or advice.analyzers,
        )

    def with_hands(self, count: int = HANDS) -> PlannerOptions:
        """The same with a number of hands: `count` where none is given."""
        return replace(self, hands=count) if self.hands is None else self
