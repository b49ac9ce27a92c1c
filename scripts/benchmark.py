"""Timings: the stages of an episode, the planner against its targets, plans of all 240 Soma cubes."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

if TYPE_CHECKING:
    from soma_bullet.grasp.hand import Hand

CELL = "ur5e_pair"
GRASPS = 1000


@dataclass(frozen=True)
class Stages:
    """Times the stages of an episode over seeds. Wall times of this machine: compare ratios within one run."""

    assembly: tyro.conf.Positional[str] = "soma3"
    """An assembly file, or the name of one that comes with the package."""
    cell: str = CELL
    """A cell, as for run_episode.py."""
    seeds: int = 5
    """How many seeds, from 0 on."""
    stages: Literal["planning", "all"] = "all"
    """planning leaves out the simulation and the judgement."""
    out: Path = Path("runs/benchmark.json")
    """Where the figures are written."""


@dataclass(frozen=True)
class Planner:
    """Times the planner against its targets, and says where the time goes: Markdown on stdout."""

    runs: int = 5
    """How often each job is done, afresh each time; the median is printed. Where the time goes is measured once more."""


@dataclass(frozen=True)
class Cube240:
    """Plans the 240 Soma cubes, and looks for orders without any hold whichever side is down: Markdown on stdout."""

    plans: int = 240
    """How many of them are planned in full, drawn by the seed."""
    turned: int = 240
    """How many are turned, drawn by the seed."""
    orientations: Literal[6, 24] = 6
    """6: each side down; 24: and turned about the vertical, which should change nothing."""
    grasps: bool = True
    """Whether turned cubes are also asked for an order without holds whose pieces the hand can grip."""
    seed: int = 0
    """Of the draws."""
    jobs: int = 1
    """Worker processes; all but the times is the same for any number."""
    out: Path = Path("runs/cube240.json")
    """Where the figures of every cube are written."""


class Stopwatch:
    """Collects seconds by name: wall, and of this process alone."""

    def __init__(self) -> None:
        self.seconds: dict[str, list[float]] = defaultdict(list)
        self.cpu: dict[str, list[float]] = defaultdict(list)

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        start, cpu = time.perf_counter(), time.process_time()
        yield
        self.seconds[name].append(time.perf_counter() - start)
        self.cpu[name].append(time.process_time() - cpu)


def main(arguments: Stages | Planner | Cube240) -> int:
    """Run a benchmark. Returns the exit status."""
    from soma_bullet.errors import InputError, SomaBulletError

    try:
        if isinstance(arguments, Stages):
            stages(arguments, lambda text: sys.stderr.write(text + "\n"))
        elif isinstance(arguments, Planner):
            if arguments.runs < 1:
                raise InputError("arguments", f"--runs {arguments.runs}: must be at least 1")
            planner(arguments.runs)
        else:
            if not (0 <= arguments.plans <= 240 and 0 <= arguments.turned <= 240 and arguments.jobs >= 1):
                raise InputError("arguments", "--plans and --turned must be from 0 to 240, and --jobs at least 1")
            cube240(arguments)
    except SomaBulletError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_status
    return 0


# --- stages of an episode ----------------------------------------------------------------------------------------------


def stages(arguments: Stages, say: Callable[[str], object]) -> None:
    """Prints the figures of every stage, and writes them."""
    figures = run(arguments, say)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    width = max(map(len, figures["stages"]))
    sys.stdout.write(f"{'stage':<{width}}  {'median':>10}  {'p95':>10}  runs\n")
    for name, row in figures["stages"].items():
        sys.stdout.write(f"{name:<{width}}  {row['median_s']:>8.3f} s  {row['p95_s']:>8.3f} s  {row['runs']:>4}\n")


def run(arguments: Stages, say: Callable[[str], object]) -> dict[str, Any]:
    """Figures of every stage: median and 95th percentile [s]."""
    import numpy as np

    from soma_bullet.assembly.file import load_assembly
    from soma_bullet.episode import EpisodeOptions, execute
    from soma_bullet.planner.plan import make_plan
    from soma_bullet.planner.qualities import PlannerOptions, Qualities
    from soma_bullet.records import package_versions
    from soma_bullet.robot.cell import load_cell
    from soma_bullet.sim.judge import judge
    from soma_bullet.task.feed import draw_feed
    from soma_bullet.task.program import MOTIONS, ProgramBuilder, make_program
    from soma_bullet.task.schedule import Scheduler
    from soma_bullet.task.workcell import Workcell

    watch = Stopwatch()
    for seed in range(arguments.seeds):
        say(f"seed {seed}")
        with watch.measure("load assembly and cell"):
            assembly, cell = load_assembly(arguments.assembly), load_cell(arguments.cell)
        hand = cell.arms[0].hand
        with watch.measure("contacts"):
            _ = assembly.contacts
        with watch.measure("grasps of all pieces"):
            qualities = Qualities(assembly, hand, PlannerOptions())
            for k in range(len(assembly.pieces)):
                qualities.grasps(k)
        with watch.measure("plan, equilibrium mode"):
            plan = make_plan(assembly, hand, PlannerOptions(seed=seed))
        with watch.measure("plan, paper mode"):
            make_plan(assembly, hand, PlannerOptions(stability="paper", seed=seed))
        with watch.measure("robot and collision model"):
            workcell = Workcell(assembly, cell)
        with watch.measure("feed"):
            feed = draw_feed(assembly, plan, cell, seed)
        with watch.measure("schedule"):
            schedule = Scheduler(workcell, plan, feed).find()
        with watch.measure("motions of that schedule"):
            segments = list(ProgramBuilder(workcell, plan, feed, schedule, seed).segments())
        motions = sum(segment.kind in MOTIONS for segment in segments)
        watch.seconds["one motion"].append(watch.seconds["motions of that schedule"][-1] / motions)
        with watch.measure("schedule and motions, with failures"):
            program = make_program(workcell, plan, feed, seed)
        if arguments.stages == "planning":
            continue
        with watch.measure("execution"):
            log = execute(assembly, workcell, plan, program, EpisodeOptions(seed=seed), lambda what, fraction: None)
        watch.seconds["execution, a simulated second"].append(watch.seconds["execution"][-1] / float(log.times[-1]))
        with watch.measure("judgement"):
            judge(log, assembly, cell, EpisodeOptions().tolerance)
    figures = {
        name: {"median_s": float(np.median(s)), "p95_s": float(np.percentile(s, 95)), "runs": len(s)}
        for name, s in watch.seconds.items()
    }
    return {
        "assembly": assembly.name,
        "cell": cell.name,
        "seeds": arguments.seeds,
        "stages": figures,
        "versions": package_versions(),
    }


# --- the planner against its targets -----------------------------------------------------------------------------------

# name: target, factor and unit that it is printed in
TARGETS = {
    "soma3, equilibrium": (1.0, 1.0, "s"),
    "soma3, paper": (1.0, 1.0, "s"),
    "soma4, equilibrium": (2.0, 1.0, "s"),
    "soma4, paper": (2.0, 1.0, "s"),
    "cube, all 5,040 orders, equilibrium": (8.0, 1.0, "s"),
    "cube, all 5,040 orders, paper": (8.0, 1.0, "s"),
    "contacts of 7 meshes": (0.150, 1e3, "ms"),
    "equilibrium of one of the cube's 127 subsets": (0.010, 1e3, "ms"),
    "1,000 grasps against 7 pieces": (0.040, 1e3, "ms"),
}
MEMORY = 1000.0  # [MB]
PLANNED = tuple((name, mode) for name in ("soma3", "soma4", "cube") for mode in ("equilibrium", "paper"))


def planner(runs: int) -> None:
    """Prints times against targets, and where the time goes."""
    watch, shares = Stopwatch(), {}
    _bench_plan("soma3", "paper", Stopwatch())  # imports, and tables that are built once
    for _ in range(runs):
        for key in PLANNED:
            _bench_plan(*key, watch)
        _bench_parts(watch)
    for key in PLANNED:
        with _clocks() as shares[key]:
            _bench_plan(*key, Stopwatch())
    lines = ["| job | target | wall, median | CPU, median | met |", "|-|-|-|-|-|"]
    for job, (target, factor, unit) in TARGETS.items():
        wall, cpu = statistics.median(watch.seconds[job]), statistics.median(watch.cpu[job])
        values = " | ".join(f"{value * factor:.3g} {unit}" for value in (target, wall, cpu))
        lines.append(f"| {job} | < {values} | {_met(wall, cpu, target)} |")
    peak = _peak_memory()
    lines.append(f"| peak memory of the cube's plan | < {MEMORY:.0f} MB | {peak:.0f} MB | | {_met(peak, peak, MEMORY)} |")
    lines += ["", "| share of the CPU time | " + " | ".join(f"{name}, {mode}" for name, mode in PLANNED) + " |"]
    lines.append("|-" * (len(PLANNED) + 1) + "|")
    for label in (*_timed(), "search and rows"):
        lines.append(f"| {label} | " + " | ".join(f"{_share(shares[key], label):.0%}" for key in PLANNED) + " |")
    lines.append("| all | " + " | ".join(f"{sum(shares[key].values()):.2f} s" for key in PLANNED) + " |")
    sys.stdout.write("\n".join(lines) + "\n")


def _met(wall: float, cpu: float, target: float) -> str:
    return "yes" if wall < target else "by CPU time" if cpu < target else "no"


def _share(seconds: dict[str, float], label: str) -> float:
    return seconds.get(label, 0.0) / sum(seconds.values())


def _timed() -> dict[str, list[tuple[Any, str]]]:
    """Functions of the planner by the analyzer that they belong to: what they call counts for it unless it is listed too."""
    from soma_bullet.planner import plan
    from soma_bullet.planner.qualities import Qualities

    return {
        "stability programs": [(Qualities, "stability")],
        "hulls of paper mode": [(Qualities, "paper_stability")],
        "sampling of grasps": [(Qualities, "grasps")],
        "grasps clear of pieces": [(Qualities, name) for name in ("accessible", "candidates", "_clear_of_way")],
        "hand against hand": [(Qualities, name) for name in ("assisting", "can_assist", "together")],
        "ways in": [(Qualities, "assemblability")],
        "certificates of holds": [(plan, "certify_hold")],
    }


@contextmanager
def _clocks() -> Iterator[dict[str, float]]:
    """Seconds of CPU by label while the block runs; what no label claims is `search and rows`."""
    seconds, running = defaultdict(float), ["search and rows"]
    last = time.process_time()

    def switch() -> None:
        nonlocal last
        now = time.process_time()
        seconds[running[-1]] += now - last
        last = now

    def clocked(function: Callable[..., Any], label: str) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            switch()
            running.append(label)
            try:
                return function(*arguments, **options)
            finally:
                switch()
                running.pop()

        return call

    originals = [(owner, name, getattr(owner, name), label) for label, group in _timed().items() for owner, name in group]
    for owner, name, function, label in originals:
        setattr(owner, name, clocked(function, label))
    try:
        yield seconds
        switch()
    finally:
        for owner, name, function, _ in originals:
            setattr(owner, name, function)


def _bench_plan(name: str, mode: str, watch: Stopwatch) -> None:
    """Plans an assembly, loaded afresh."""
    from soma_bullet.assembly.file import load_assembly
    from soma_bullet.planner.plan import make_plan
    from soma_bullet.planner.qualities import PlannerOptions

    assembly, hand = load_assembly(name), _hand()  # to load it is to look at its contacts
    with watch.measure(f"{name}, all 5,040 orders, {mode}" if name == "cube" else f"{name}, {mode}"):
        make_plan(assembly, hand, PlannerOptions(stability=mode))


def _bench_parts(watch: Stopwatch) -> None:
    """The cube's contacts, the stability of its subsets, and 1,000 grasps against its pieces."""
    from itertools import combinations

    import numpy as np

    from soma_bullet.assembly.file import load_assembly
    from soma_bullet.grasp.clearance import clear_of_scene, sweep_hand
    from soma_bullet.planner.qualities import PlannerOptions, Qualities

    loaded = load_assembly("cube")
    # loading has looked at the contacts already: bodies and assembly without what they remember
    cube = replace(loaded, pieces=tuple(replace(piece) for piece in loaded.pieces))
    with watch.measure("contacts of 7 meshes"):
        _ = cube.contacts
    qualities, every = Qualities(cube, _hand(), PlannerOptions()), range(len(cube.pieces))
    for size in range(1, len(cube.pieces) + 1):
        for placed in map(frozenset, combinations(every, size)):
            with watch.measure("equilibrium of one of the cube's 127 subsets"):
                qualities.stability(placed)
    grasps = [qualities.grasps(k) for k in every]
    poses = np.vstack([cube.goals[k] @ grasps[k].Ts_piece_tcp for k in every])[:GRASPS]
    widths = np.concatenate([grasps[k].widths for k in every])[:GRASPS]
    assert len(poses) == GRASPS
    hand = _hand()
    with watch.measure("1,000 grasps against 7 pieces"):
        sweep = sweep_hand(hand, poses, widths)
        for parts in cube.goal_parts:
            clear_of_scene(sweep, parts, None)


@cache
def _hand() -> Hand:
    from soma_bullet.robot.cell import load_cell

    return load_cell(CELL).arms[0].hand


def _peak_memory() -> float:
    """Largest resident size [MB] of a process of its own that plans the cube."""
    code = (
        "import resource; from soma_bullet.assembly.file import load_assembly; from soma_bullet.planner.plan import make_plan; "
        f"from soma_bullet.robot.cell import load_cell; make_plan(load_assembly('cube'), load_cell('{CELL}').arms[0].hand); "
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    return float(done.stdout) * 1024 / 1e6


# --- all Soma cubes ----------------------------------------------------------------------------------------------------


def cube240(arguments: Cube240) -> None:
    """Prints the summary, and writes the figures of every cube."""
    from rich.console import Console
    from rich.progress import Progress

    from soma_bullet.records import package_versions, to_tree
    from soma_bullet.validation.cubes import cube_table, survey_cubes

    start = time.perf_counter()
    with Progress(console=Console(stderr=True)) as bar:
        task = bar.add_task("cubes", total=arguments.plans + arguments.turned)
        plans, turns = survey_cubes(
            arguments.plans, arguments.turned, arguments.orientations, arguments.grasps, arguments.seed, arguments.jobs,
            lambda: bar.advance(task),
        )  # fmt: skip
    figures = {"plans": to_tree(plans), "turns": to_tree(turns), "versions": package_versions()}
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    sys.stdout.write(cube_table(plans, turns))
    sys.stderr.write(f"{time.perf_counter() - start:.0f} s in {arguments.jobs} processes; written to {arguments.out}\n")


if __name__ == "__main__":
    # many small matrices: threads of the linear algebra would only get in each other's way
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    Command = (
        Annotated[Stages, tyro.conf.subcommand("stages")]
        | Annotated[Planner, tyro.conf.subcommand("planner")]
        | Annotated[Cube240, tyro.conf.subcommand("cube240")]
    )
    raise SystemExit(main(tyro.cli(Command, default=Stages(), description=__doc__)))  # type: ignore[arg-type]
