"""How fast physics runs."""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from dataclasses import replace

from soma_bullet.assembly.file import load_assembly
from soma_bullet.benchmark.options import Simulate
from soma_bullet.bullet.simulator import BulletSimulator
from soma_bullet.bullet.stage import substeps
from soma_bullet.pipeline import cell_of, executed, make_program
from soma_bullet.planner.store import kept_plan
from soma_bullet.task.segment import DT
from soma_bullet.task.workcell import Workcell


def simulate(arguments: Simulate) -> None:
    """Prints how fast one program runs in physics."""
    options = arguments.episode
    options.check()
    assembly, cell = load_assembly(arguments.assembly), cell_of(options)
    workcell = Workcell(assembly, cell)
    planner = replace(options.planner.with_hands(len(cell.arms)), seed=options.seed)
    plan = kept_plan(assembly, cell.hands, planner)
    program = make_program(assembly, cell, plan, options)
    taken: dict[int, list[float]] = defaultdict(list)  # hands that squeeze -> CPU time of steps
    step = BulletSimulator.step

    def timed(world: BulletSimulator) -> None:
        start = time.process_time()
        step(world)
        taken[sum(force > 0.0 for force in world._squeezing)].append(time.process_time() - start)

    BulletSimulator.step = timed  # type: ignore[method-assign, assignment]
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        log = executed(workcell, plan, program, options)
    finally:
        BulletSimulator.step = step  # type: ignore[method-assign]
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    dt = DT / substeps(options.physics, cell, assembly)
    simulated = float(log.times[-1])
    lines = ["| what runs | simulated | CPU | times real time |", "|-|-|-|-|"]
    names = {0: "steps, nothing gripped", 1: "steps, one hand grips", 2: "steps, both hands grip"}
    for hands, seconds in sorted(taken.items()):
        lines.append(
            f"| {names[hands]} | {len(seconds) * dt:.1f} s | {sum(seconds):.2f} s | "
            f"{len(seconds) * dt / sum(seconds):.1f} |"
        )
    rest = cpu - sum(map(sum, taken.values()))
    lines.append(
        f"| control, measuring and the log | {simulated:.1f} s | {rest:.2f} s | "
        f"{simulated / max(rest, 1e-9):.1f} |"
    )
    lines.append(
        f"| all | {simulated:.1f} s | {cpu:.2f} s | {simulated / cpu:.1f} ({simulated / wall:.1f} by wall "
        f"time) |"
    )
    sys.stdout.write("\n".join(lines) + f"\n\nended: {log.ended}\n")
