"""Everything that decides an episode, gathered from the options of its stages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from soma_bullet.control.options import ExecutionOptions
from soma_bullet.option import SEED, Options
from soma_bullet.pictures.options import FilmOptions
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.task.feed_options import FeedOptions
from soma_bullet.task.search_options import SearchOptions
from soma_bullet.verdict.options import Tolerance
from soma_bullet.world.options import Physics


@dataclass(frozen=True)
class EpisodeOptions(Options):
    """Everything that decides an episode, beside the assembly."""

    names: ClassVar[Mapping[str, str]] = {"planner": "", "tolerance": ""}
    unset: ClassVar[frozenset[str]] = frozenset({"planner.seed"})

    cell: str = "ur5e_pair"
    """A folder or cell.toml that describes robot, hands, table and feed, or the name of one under robots/."""
    hand: str | None = None
    """A hand.toml that replaces the hands of the cell, or the name of a cell whose hand it is."""
    seed: Annotated[int, SEED] = 0
    """Of everything random: feed, ties, planners. The same seed gives the same plan and the same episode."""
    planner: PlannerOptions = PlannerOptions()
    """How orders are judged; its seed is the episode's."""
    search: SearchOptions = SearchOptions()
    """How long a schedule is searched for."""
    feed: FeedOptions = FeedOptions()
    """How the pieces are fed."""
    execution: ExecutionOptions = ExecutionOptions()
    """How the program is executed."""
    physics: Physics = Physics()
    """How the world is simulated."""
    tolerance: Tolerance = Tolerance()
    """What counts as in place."""
    ablate: Literal["none", "hold"] = "none"
    """hold: open the assisting hand where it should hold, all else equal."""
    film: FilmOptions | None = None
    """The video; None for none."""

    @property
    def ablation(self) -> str:
        """What is left out of the execution; empty for nothing."""
        return "" if self.ablate == "none" else self.ablate

    def faults(self, prefix: str = "--") -> list[str]:
        """As of all options; a seed of the planner's own is refused."""
        other = self.planner.seed not in (PlannerOptions().seed, self.seed)
        fault = f"planner.seed = {self.planner.seed}: must be left alone; the episode's is {self.seed}"
        return super().faults(prefix) + ([fault] if other else [])
