"""The command line of an episode: `soma-episode`, scripts/run_episode.py.

Imports of the pipeline wait until the arguments are known to be good, so that `--help` answers at once.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from soma_bullet.cli.common import run_command


@dataclass(frozen=True)
class FeedArguments:
    """How the pieces are fed."""

    layout: Literal["random", "rows"] = "random"
    """random: anywhere in the feed areas, at any yaw; rows: spread out evenly, without yaw."""
    poses: Literal["all", "preferred"] = "all"
    """all: in any pose in which a piece rests steadily; preferred: in that with the most grasps that serve at
    the goal too."""
    noise_mm: float = 0.0
    """One sigma of the error of the perceived places in x and y [mm]: pieces really lie elsewhere."""
    noise_deg: float = 0.0
    """One sigma of the error of the perceived yaw [deg]."""


@dataclass(frozen=True)
class PhysicsArguments:
    """How the world is simulated."""

    substeps: int = 1
    """Time steps for each sample of a trajectory; trajectories are fed at 480 Hz."""
    solver: Literal["pgs", "dantzig"] = "pgs"
    """pgs iterates, with a friction cone; dantzig solves contacts between pieces exactly, with a friction
    pyramid."""
    iterations: int = 60
    """Iterations of the solver a step; with fewer, gripped pieces slip."""
    grip_force: float | None = None
    """[N]; the hand's own by default."""
    friction: float = 1.0
    """Factor on every friction coefficient of the simulated world; the planner does not know."""
    mass: float = 1.0
    """Factor on every piece's mass; the planner does not know."""


@dataclass(frozen=True)
class ExecutionArguments:
    """How the program is executed."""

    together: bool = True
    """The arms move at the same time where it is safe; --execution.no-together: one at a time."""
    compliant: bool = True
    """The wrist's force guides insertions; --execution.no-compliant: they stop at the first touch."""
    recover: bool = True
    """What does not go as planned is tried again where possible; --execution.no-recover: it ends the
    episode."""
    longest: float = 900.0
    """Simulated time [s] after which an episode is ended."""


@dataclass(frozen=True)
class VideoArguments:
    """The video."""

    size: tuple[int, int] = (1280, 720)
    """Width and height in pixels, both even."""
    fps: int = 30
    """Frames a second of the video."""
    speed: float = 4.0
    """Simulated seconds in a second of video."""
    camera: str = "auto"
    """auto follows the hands; a name (front, three_quarter, close, top, left, right) stays."""
    renderer: Literal["auto", "egl", "tiny"] = "auto"
    """egl needs the Debian packages libegl1 libegl-mesa0 libgl1-mesa-dri; tiny is PyBullet's own and slow."""


@dataclass(frozen=True)
class RunArguments:
    """Plans an assembly, builds it with two arms in contact physics, judges it by where the pieces end up,
    and films it.

    Exit status: 0 success; 1 the judge says no; 2 bad input; 3 no plan or no motion found (with the reasons).
    """

    assembly: tyro.conf.Positional[str]
    """An assembly file, or the name of one that comes with the package (soma3, soma4, cube)."""
    cell: str = "ur5e_pair"
    """A folder or cell.toml that describes robot, hands, table and feed, or the name of one under robots/."""
    hand: str | None = None
    """A hand.toml that replaces the hands of the cell, or the name of a cell whose hand it is."""
    seed: int = 0
    """Of everything random: feed, ties, planners. The same seed gives the same plan and the same episode."""
    out: Path | None = None
    """Folder for plan.json, program.npz, log.npz, report.json, the video and a still [default: runs/<name of
    the assembly>]."""
    stability: Literal["equilibrium", "paper"] = "equilibrium"
    """equilibrium: the whole placed set at once; paper: one piece against fixed neighbours. Holds follow
    equilibrium anyway."""
    video: bool = True
    """--no-video saves the time."""
    plan_only: bool = False
    """Stop after plan.json."""
    resume: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    """plan.json, program.npz or log.npz of an earlier run: what comes before it is taken from there."""
    ablate: Literal["none", "hold"] = "none"
    """hold: open the assisting hand where it should hold, all else equal."""
    tolerance_mm: float = 2.0
    """A piece is in place when its centre of mass is this near to its goal [mm] ..."""
    tolerance_deg: float = 2.0
    """... and it is turned by no more than this [deg]."""
    feed: FeedArguments = field(default_factory=FeedArguments)
    execution: ExecutionArguments = field(default_factory=ExecutionArguments)
    physics: PhysicsArguments = field(default_factory=PhysicsArguments)
    film: VideoArguments = field(default_factory=VideoArguments)


def run_episode(arguments: list[str] | None = None) -> int:
    """Entry point of `soma-episode` and of scripts/run_episode.py. Returns the exit status."""
    return run_command(_run, tyro.cli(RunArguments, args=arguments, prog="soma-episode"))


def _run(options: RunArguments) -> int:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    _check(options)
    from soma_bullet.assembly.file import load_assembly
    from soma_bullet.bullet.stage import Physics
    from soma_bullet.control.executive import ExecutionOptions
    from soma_bullet.episode import EpisodeOptions
    from soma_bullet.episode import run_episode as run
    from soma_bullet.judge.judge import Tolerance
    from soma_bullet.pictures.film import FilmOptions
    from soma_bullet.planner.qualities import PlannerOptions
    from soma_bullet.report.report import print_report
    from soma_bullet.task.feed import FeedOptions

    console = Console(stderr=True)
    console.width = max(console.width, 110)  # a log file has no width of its own; the table needs this much
    video, physics = options.film, options.physics
    film = FilmOptions(
        size=video.size, fps=video.fps, speed=video.speed, camera=video.camera, renderer=video.renderer
    )
    out = options.out or Path("runs") / load_assembly(options.assembly).name
    episode = EpisodeOptions(
        cell=options.cell,
        hand=options.hand,
        seed=options.seed,
        planner=PlannerOptions(stability=options.stability),
        feed=FeedOptions(**vars(options.feed)),
        execution=ExecutionOptions(**vars(options.execution)),
        physics=Physics(
            physics.substeps,
            physics.solver,
            physics.iterations,
            grip_force=physics.grip_force,
            friction=physics.friction,
            mass=physics.mass,
        ),
        tolerance=Tolerance(options.tolerance_mm, options.tolerance_deg),
        ablate="" if options.ablate == "none" else options.ablate,
        film=film if options.video else None,
    )
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("starting", total=1.0)
        report = run(
            options.assembly, episode, out, options.resume, options.plan_only,
            lambda what, fraction: bar.update(task, description=what, completed=fraction),
        )  # fmt: skip
    if report is None:
        _print_plan(out, console)
        return 0
    print_report(report, console)
    if report.video["note"] and options.video:
        console.print(f"[yellow]video[/]: {report.video['note']}")
    console.print(f"written to {out}/", markup=False)
    return 0 if report.success else 1


def _check(options: RunArguments) -> None:
    """Refuse what no episode could use, all at once."""
    import math

    from soma_bullet.errors import InputError

    faults = []

    def demand(good: bool, fault: str) -> None:
        if not good:
            faults.append(fault)

    demand(0 <= options.seed < 2**31, f"--seed {options.seed}: must be from 0 to 2147483647")
    for name, value in (("tolerance-mm", options.tolerance_mm), ("tolerance-deg", options.tolerance_deg)):
        demand(math.isfinite(value) and value > 0, f"--{name} {value:g}: must be positive")
    for name, value in (("feed.noise-mm", options.feed.noise_mm), ("feed.noise-deg", options.feed.noise_deg)):
        demand(math.isfinite(value) and value >= 0, f"--{name} {value:g}: must not be negative")
    physics = options.physics
    demand(1 <= physics.substeps <= 20, f"--physics.substeps {physics.substeps}: must be from 1 to 20")
    demand(
        0 < options.execution.longest <= 1e5,
        f"--execution.longest {options.execution.longest:g}: must be above 0 s and at most 1e5",
    )
    demand(
        1 <= physics.iterations <= 10_000,
        f"--physics.iterations {physics.iterations}: must be from 1 to 10000",
    )
    force = physics.grip_force
    demand(
        force is None or (math.isfinite(force) and force > 0),
        f"--physics.grip-force {force}: must be positive",
    )
    for name, value in (("friction", physics.friction), ("mass", physics.mass)):
        demand(
            math.isfinite(value) and 0 < value <= 10,
            f"--physics.{name} {value:g}: must be above 0 and at most 10",
        )
    if faults:
        raise InputError("arguments", faults)


def _print_plan(out: Path, console: object) -> None:
    from rich.console import Console

    from soma_bullet.planner.assembly_plan import AssemblyPlan
    from soma_bullet.records import read_json
    from soma_bullet.report.table import plan_table

    assert isinstance(console, Console)
    plan = read_json(AssemblyPlan, out / "plan.json")
    console.print(plan_table(plan))
    for warning in plan.warnings:
        console.print(f"[yellow]warning[/]: {warning}")
    console.print(f"written to {out}/plan.json", markup=False)
