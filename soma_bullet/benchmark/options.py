"""What is measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from tyro.conf import Positional

from soma_bullet.option import SEED, Options, Range
from soma_bullet.options import EpisodeOptions
from soma_bullet.task.feed_options import FeedOptions

CELL = EpisodeOptions.cell
CUBES = Range(0, 240)
PREFERRED = FeedOptions(poses="preferred")


@dataclass(frozen=True)
class Stages(Options):
    """Times the stages of an episode over seeds. Wall times of this machine: compare ratios within one
    run."""

    assembly: Positional[str] = "soma3"
    """An assembly file, or the name of one that comes with the package."""
    cell: str = CELL
    """A folder or cell.toml, or the name of one under robots/."""
    seeds: Annotated[int, Range(1)] = 5
    """How many seeds, from 0 on."""
    stages: Literal["planning", "all"] = "all"
    """planning leaves out the simulation and the judgement."""
    out: Path = Path("runs/benchmark.json")
    """Where the figures are written."""


@dataclass(frozen=True)
class Planner(Options):
    """Times the planner against its targets, and says where the time goes: Markdown on stdout."""

    runs: Annotated[int, Range(1)] = 5
    """How often each job is done, afresh each time; the median is printed. Where the time goes is measured
    once more."""


@dataclass(frozen=True)
class Cube240(Options):
    """Plans the 240 Soma cubes, and looks for orders without any hold whichever side is down: Markdown on
    stdout."""

    plans: Annotated[int, CUBES] = 240
    """How many of them are planned in full, drawn by the seed."""
    turned: Annotated[int, CUBES] = 240
    """How many are turned, drawn by the seed."""
    orientations: Literal[6, 24] = 6
    """6: each side down; 24: and turned about the vertical, which should change nothing."""
    grasps: bool = True
    """Turned cubes are also asked for an order without holds whose pieces the hand can grip; --no-grasps:
    they are not."""
    seed: Annotated[int, SEED] = 0
    """Of the draws."""
    jobs: Annotated[int, Range(1)] = 1
    """Worker processes; all but the times is the same for any number."""
    out: Path = Path("runs/cube240.json")
    """Where the figures of every cube are written."""


@dataclass(frozen=True)
class Motion(Options):
    """Times the motions around obstacles of real programs, against targets and, on the very same queries,
    against the birrt of the package pybullet-planning with its collision function in PyBullet: Markdown on
    stdout."""

    assemblies: tuple[str, ...] = ("soma3", "soma4", "cube")
    """Assembly files, or names of ones that come with the package."""
    seeds: Annotated[int, Range(1)] = 3
    """How many feeds of each, from seed 0 on."""
    feed: FeedOptions = PREFERRED
    """How the pieces are fed."""
    birrt: bool = True
    """--no-birrt leaves out the comparison, which takes most of the time."""
    resolution: Annotated[float, Range(0, 1, above=True)] = 0.02
    """Joint step between checked states of birrt [rad]. Ours checks every 0.02; the default of that package
    is 0.05."""
    cell: str = CELL
    """A folder or cell.toml, or the name of one under robots/."""
    out: Path = Path("runs/benchmark_motion.json")
    """Where the figures of every query are written."""


@dataclass(frozen=True)
class Simulate(Options):
    """How fast physics runs: simulated seconds in a second, with pieces in the hands and without."""

    names: ClassVar[Mapping[str, str]] = {"episode": ""}
    unset: ClassVar[frozenset[str]] = frozenset({"episode.film"})

    assembly: Positional[str] = "soma3"
    """An assembly file, or the name of one that comes with the package."""
    episode: EpisodeOptions = EpisodeOptions(feed=PREFERRED)
    """Everything that decides it."""


@dataclass(frozen=True)
class Episode(Options):
    """Wall time of whole episodes by stage."""

    names: ClassVar[Mapping[str, str]] = {"episode": ""}
    unset: ClassVar[frozenset[str]] = frozenset({"episode.film", "episode.seed"})

    assembly: Positional[str] = "soma3"
    """An assembly file, or the name of one that comes with the package."""
    seeds: Annotated[int, Range(1)] = 3
    """How many episodes, from seed 0 on."""
    episode: EpisodeOptions = EpisodeOptions()
    """What all of them have in common."""
