"""Timings of each stage over seeds: prints the medians and 95th percentiles, and writes them as JSON."""

from __future__ import annotations

import json
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro


@dataclass(frozen=True)
class Arguments:
    """Times the stages of an episode over seeds. Wall times of this machine: compare ratios within one run."""

    assembly: tyro.conf.Positional[str] = "soma3"
    """An assembly file, or the name of one that comes with the package."""
    cell: str = "ur5e_pair"
    """A cell, as for run_episode.py."""
    seeds: int = 5
    """How many seeds, from 0 on."""
    stages: Literal["planning", "all"] = "all"
    """planning leaves out the simulation and the judgement."""
    out: Path = Path("runs/benchmark.json")
    """Where the figures are written."""


class Stopwatch:
    """Collects seconds by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, list[float]] = defaultdict(list)

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name].append(time.perf_counter() - start)


def main(arguments: Arguments) -> int:
    """Run the benchmark. Returns the exit status."""
    from soma_bullet.errors import SomaBulletError

    try:
        figures = run(arguments, lambda text: sys.stderr.write(text + "\n"))
    except SomaBulletError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_status
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    width = max(map(len, figures["stages"]))
    sys.stdout.write(f"{'stage':<{width}}  {'median':>10}  {'p95':>10}  runs\n")
    for name, row in figures["stages"].items():
        sys.stdout.write(f"{name:<{width}}  {row['median_s']:>8.3f} s  {row['p95_s']:>8.3f} s  {row['runs']:>4}\n")
    return 0


def run(arguments: Arguments, say: Callable[[str], object]) -> dict:
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
    stages = {
        name: {"median_s": float(np.median(s)), "p95_s": float(np.percentile(s, 95)), "runs": len(s)}
        for name, s in watch.seconds.items()
    }
    return {
        "assembly": assembly.name,
        "cell": cell.name,
        "seeds": arguments.seeds,
        "stages": stages,
        "versions": package_versions(),
    }


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Arguments)))
