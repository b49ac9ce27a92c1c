"""All 240 Soma cubes."""

from __future__ import annotations

import json
import sys
import time

from rich.console import Console
from rich.progress import Progress

from soma_bullet.benchmark.options import Cube240
from soma_bullet.records import package_versions, to_tree
from soma_bullet.validation.cubes import cube_table, survey_cubes


def cube240(arguments: Cube240) -> None:
    """Prints the summary, and writes the figures of every cube."""
    start = time.perf_counter()
    with Progress(console=Console(stderr=True)) as bar:
        task = bar.add_task("cubes", total=arguments.plans + arguments.turned)
        plans, turns = survey_cubes(
            arguments.plans,
            arguments.turned,
            arguments.orientations,
            arguments.grasps,
            arguments.seed,
            arguments.jobs,
            lambda: bar.advance(task),
        )
    figures = {"plans": to_tree(plans), "turns": to_tree(turns), "versions": package_versions()}
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    sys.stdout.write(cube_table(plans, turns))
    sys.stderr.write(
        f"{time.perf_counter() - start:.0f} s in {arguments.jobs} processes; written to {arguments.out}\n"
    )
