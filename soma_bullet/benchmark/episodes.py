"""Wall times of whole episodes."""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from soma_bullet.benchmark.options import Episode
from soma_bullet.episode import run_episode
from soma_bullet.errors import NoSolutionError


def episode(arguments: Episode, say: Callable[[str], object]) -> None:
    """Prints the wall time of whole episodes by stage."""
    seconds: dict[str, list[float]] = defaultdict(list)
    verdicts, makespans = [], []
    for seed in range(arguments.seeds):
        options = replace(arguments.episode, seed=seed)
        start = time.perf_counter()
        try:
            report = run_episode(arguments.assembly, options)
        except NoSolutionError as error:
            say(f"seed {seed}: {error.stage}: {error.summary}")
            continue
        assert report is not None
        seconds["all"].append(time.perf_counter() - start)
        for stage, value in report.wall_s.items():
            seconds[stage].append(value)
        verdicts.append(report.success)
        makespans.append(report.makespan_s)
        say(
            f"seed {seed}: {seconds['all'][-1]:.1f} s, "
            f"{'success' if report.success else report.judgement.causes[0]}"
        )
    if not verdicts:
        raise NoSolutionError("schedule", "no episode had a program")
    seconds["all"] = seconds.pop("all")  # last
    lines = ["| stage | median | p95 |", "|-|-|-|"]
    lines += [f"| {s} | {np.median(v):.2f} s | {np.percentile(v, 95):.2f} s |" for s, v in seconds.items()]
    lines.append(
        f"| makespan, simulated | {np.median(makespans):.1f} s | {np.percentile(makespans, 95):.1f} s |"
    )
    sys.stdout.write("\n".join(lines) + f"\n\n{sum(verdicts)} of {len(verdicts)} succeeded\n")
