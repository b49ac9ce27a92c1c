"""What is evaluated, and what differs from episode to episode."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from soma_bullet.bullet.stage import Physics
from soma_bullet.control.executive import ExecutionOptions
from soma_bullet.episode import EpisodeOptions
from soma_bullet.judge.judge import Tolerance
from soma_bullet.planner.qualities import PlannerOptions
from soma_bullet.records import to_tree
from soma_bullet.task.feed import FeedOptions

VARIED = ("friction", "mass", "perception", "feed")


@dataclass(frozen=True)
class Spread:
    """By how much what varies does.

    Attributes:
        friction, mass: largest relative deviation of the factor on all friction coefficients, and on all
            masses; uniform.
        mm, deg: one sigma of the error of the perceived places [mm] and yaws [deg]; of uniform errors the
            largest.
        errors: how these are spread; square: whether pieces are squared against them. See FeedOptions.
    """

    friction: float = 0.2
    mass: float = 0.2
    mm: float = 0.5
    deg: float = 0.5
    errors: Literal["normal", "uniform"] = "normal"
    square: bool = True


@dataclass(frozen=True)
class EvaluationOptions:
    """What is evaluated.

    Attributes:
        assembly: file or name.
        episodes: how many; their seeds follow on from `seed`.
        seed: of the first episode.
        vary: what differs from episode to episode, of VARIED; without `feed` pieces lie in their preferred
            resting poses.
        spread: by how much.
        cell, hand, stability, tolerance, execution, ablate: see EpisodeOptions.
    """

    assembly: str
    episodes: int = 20
    seed: int = 0
    vary: tuple[str, ...] = ("feed",)
    spread: Spread = Spread()
    cell: str = "ur5e_pair"
    hand: str | None = None
    stability: str = "equilibrium"
    tolerance: Tolerance = Tolerance()
    execution: ExecutionOptions = ExecutionOptions()
    ablate: str = ""

    @property
    def seeds(self) -> range:
        """Of the episodes."""
        return range(self.seed, self.seed + self.episodes)

    def conditions(self) -> dict[str, Any]:
        """All that a line depends on beside assembly, seed and versions, by the names of the command line."""
        vary = [name for name in VARIED if name in self.vary]
        spread = {
            f"--spread.{name}": getattr(self.spread, name) for name in ("friction", "mass") if name in vary
        }
        if "perception" in vary:
            spread |= {
                f"--spread.{name}": getattr(self.spread, name) for name in ("mm", "deg", "errors", "square")
            }
        return {
            "--vary": ",".join(vary) or "none",
            **spread,
            "--cell": self.cell,
            "--hand": self.hand,
            "--stability": self.stability,
            "--tolerance-mm": self.tolerance.mm,
            "--tolerance-deg": self.tolerance.deg,
            **{f"--{name}": value for name, value in to_tree(self.execution).items()},
            "--ablate": self.ablate or "none",
        }


def draw(seed: int, options: EvaluationOptions) -> dict[str, float]:
    """The factors of one episode; each depends on the seed alone, whatever else varies."""
    drawn = {}
    for key, name in enumerate(("friction", "mass"), 1):
        if name in options.vary:
            spread = getattr(options.spread, name)
            rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(key,)))
            drawn[name] = round(float(rng.uniform(1.0 - spread, 1.0 + spread)), 6)
    return drawn


def episode_options(seed: int, options: EvaluationOptions) -> EpisodeOptions:
    """Everything that decides one episode."""
    drawn, spread = draw(seed, options), options.spread
    feed = FeedOptions(poses="all" if "feed" in options.vary else "preferred")
    if "perception" in options.vary:
        feed = replace(
            feed, noise_mm=spread.mm, noise_deg=spread.deg, errors=spread.errors, square=spread.square
        )
    return EpisodeOptions(
        cell=options.cell,
        hand=options.hand,
        seed=seed,
        planner=PlannerOptions(stability=options.stability),
        feed=feed,
        execution=options.execution,
        physics=Physics(friction=drawn.get("friction", 1.0), mass=drawn.get("mass", 1.0)),
        tolerance=options.tolerance,
        ablate=options.ablate,
    )
