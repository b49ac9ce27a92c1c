"""Times of the stages of an episode."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from soma_bullet.assembly.file import load_assembly
from soma_bullet.benchmark.options import Stages
from soma_bullet.benchmark.stopwatch import Stopwatch
from soma_bullet.options import EpisodeOptions
from soma_bullet.pipeline import executed
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.plan import make_plan
from soma_bullet.planner.qualities import Qualities
from soma_bullet.records import package_versions
from soma_bullet.robot.cell import load_cell
from soma_bullet.task.feed import draw_feed
from soma_bullet.task.program.builder import ProgramBuilder
from soma_bullet.task.program.make import make_program
from soma_bullet.task.search.scheduler import Scheduler
from soma_bullet.task.workcell import Workcell
from soma_bullet.verdict.judge import judge


def stages(arguments: Stages, say: Callable[[str], object]) -> None:
    """Prints the figures of every stage, and writes them."""
    figures = run(arguments, say)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    width = max(map(len, figures["stages"]))
    sys.stdout.write(f"{'stage':<{width}}  {'median':>10}  {'p95':>10}  runs\n")
    for name, row in figures["stages"].items():
        sys.stdout.write(
            f"{name:<{width}}  {row['median_s']:>8.3f} s  {row['p95_s']:>8.3f} s  {row['runs']:>4}\n"
        )


def run(arguments: Stages, say: Callable[[str], object]) -> dict[str, Any]:
    """Figures of every stage: median and 95th percentile [s]."""
    watch = Stopwatch()
    for seed in range(arguments.seeds):
        say(f"seed {seed}")
        with watch.measure("load assembly and cell"):
            assembly, cell = load_assembly(arguments.assembly), load_cell(arguments.cell)
        hands = cell.hands
        with watch.measure("contacts"):
            _ = assembly.contacts
        with watch.measure("grasps of all pieces"):
            qualities = Qualities(assembly, hands, PlannerOptions())
            for k in range(len(assembly.pieces)):
                qualities.grasps(k)
        with watch.measure("plan, equilibrium mode"):
            plan = make_plan(assembly, hands, PlannerOptions(seed=seed))
        with watch.measure("plan, paper mode"):
            make_plan(assembly, hands, PlannerOptions(stability="paper", seed=seed))
        with watch.measure("robot and collision model"):
            workcell = Workcell(assembly, cell)
        with watch.measure("feed"):
            feed = draw_feed(assembly, plan, cell, seed)
        with watch.measure("schedule"):
            schedule = Scheduler(workcell, plan, feed).find()
        with watch.measure("motions of that schedule"):
            segments = [segment for _, segment, _ in ProgramBuilder(workcell, feed, schedule, seed).run()]
        motions = sum(segment.kind.moves for segment in segments)
        watch.seconds["one motion"].append(watch.seconds["motions of that schedule"][-1] / motions)
        with watch.measure("schedule and motions, with failures"):
            program = make_program(workcell, plan, feed, seed)
        if arguments.stages == "planning":
            continue
        with watch.measure("execution"):
            log = executed(workcell, plan, program, EpisodeOptions(seed=seed))
        watch.seconds["execution, a simulated second"].append(
            watch.seconds["execution"][-1] / float(log.times[-1])
        )
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
