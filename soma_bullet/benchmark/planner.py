"""Times of the planner against their targets, and where they go."""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from soma_bullet.assembly.file import load_assembly
from soma_bullet.benchmark.options import CELL
from soma_bullet.benchmark.stopwatch import Stopwatch, met
from soma_bullet.grasp.clearance import clear_of_scene, sweep_hand
from soma_bullet.planner import plan
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.qualities import Qualities
from soma_bullet.robot.cell import load_cell

GRASPS = 1000
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
        lines.append(f"| {job} | < {values} | {met(wall, cpu, target)} |")
    peak = _peak_memory()
    lines.append(
        f"| peak memory of the cube's plan | < {MEMORY:.0f} MB | {peak:.0f} MB | | "
        f"{met(peak, peak, MEMORY)} |"
    )
    lines += [
        "",
        "| share of the CPU time | " + " | ".join(f"{name}, {mode}" for name, mode in PLANNED) + " |",
    ]
    lines.append("|-" * (len(PLANNED) + 1) + "|")
    for label in (*_timed(), "search and rows"):
        lines.append(
            f"| {label} | " + " | ".join(f"{_share(shares[key], label):.0%}" for key in PLANNED) + " |"
        )
    lines.append("| all | " + " | ".join(f"{sum(shares[key].values()):.2f} s" for key in PLANNED) + " |")
    sys.stdout.write("\n".join(lines) + "\n")


def _share(seconds: dict[str, float], label: str) -> float:
    return seconds.get(label, 0.0) / sum(seconds.values())


def _timed() -> dict[str, list[tuple[Any, str]]]:
    """Functions of the planner by the analyzer that they belong to: what they call counts for it unless it is
    listed too."""

    return {
        "stability programs": [(Qualities, "stability")],
        "hulls of paper mode": [(Qualities, "paper_stability")],
        "sampling of grasps": [(Qualities, "grasps")],
        "grasps clear of pieces": [
            (Qualities, name) for name in ("accessible", "candidates", "_clear_of_way")
        ],
        "hand against hand": [(Qualities, name) for name in ("assisting", "can_assist", "together")],
        "ways in": [(Qualities, "assemblability")],
        "certificates of holds": [(plan, "certify_hold")],
    }


@contextmanager
def _clocks() -> Iterator[dict[str, float]]:
    """Seconds of CPU by label while the block runs; what no label claims is `search and rows`."""
    seconds: dict[str, float] = defaultdict(float)
    running = ["search and rows"]
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

    originals = [
        (owner, name, getattr(owner, name), label)
        for label, group in _timed().items()
        for owner, name in group
    ]
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

    assembly, hands = load_assembly(name), load_cell(CELL).hands  # to load it is to look at its contacts
    with watch.measure(f"{name}, all 5,040 orders, {mode}" if name == "cube" else f"{name}, {mode}"):
        plan.make_plan(assembly, hands, PlannerOptions(stability=mode))


def _bench_parts(watch: Stopwatch) -> None:
    """The cube's contacts, the stability of its subsets, and 1,000 grasps against its pieces."""

    loaded = load_assembly("cube")
    # loading has looked at the contacts already: bodies and assembly without what they remember
    cube = replace(loaded, pieces=tuple(replace(piece) for piece in loaded.pieces))
    with watch.measure("contacts of 7 meshes"):
        _ = cube.contacts
    qualities, every = Qualities(cube, load_cell(CELL).hands, PlannerOptions()), range(len(cube.pieces))
    for size in range(1, len(cube.pieces) + 1):
        for placed in map(frozenset, combinations(every, size)):
            with watch.measure("equilibrium of one of the cube's 127 subsets"):
                qualities.stability(placed)
    grasps = [qualities.grasps(k) for k in every]
    poses = np.vstack([cube.goals[k] @ grasps[k].Ts_piece_tcp for k in every])[:GRASPS]
    widths = np.concatenate([grasps[k].widths for k in every])[:GRASPS]
    assert len(poses) == GRASPS
    hand = load_cell(CELL).arms[0].hand
    with watch.measure("1,000 grasps against 7 pieces"):
        sweep = sweep_hand(hand, poses, widths)
        for parts in cube.goal_parts:
            clear_of_scene(sweep, parts, None)


def _peak_memory() -> float:
    """Largest resident size [MB] of a process of its own that plans the cube."""
    code = (
        "import resource; from soma_bullet.assembly.file import load_assembly; from "
        "soma_bullet.planner.plan import make_plan; "
        f"from soma_bullet.robot.cell import load_cell; make_plan(load_assembly('cube'), "
        f"load_cell('{CELL}').hands); "
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    return float(done.stdout) * 1024 / 1e6
