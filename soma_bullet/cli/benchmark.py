"""The command line of the benchmarks: `soma-benchmark`, scripts/benchmark.py."""

from __future__ import annotations

import os
import sys
from typing import Annotated, Any

import tyro

from soma_bullet.benchmark.options import Cube240, Episode, Motion, Planner, Simulate, Stages
from soma_bullet.cli.common import run_command
from soma_bullet.cli.flags import registry

KINDS = {
    "stages": Stages,
    "planner": Planner,
    "cube240": Cube240,
    "motion": Motion,
    "simulate": Simulate,
    "episode": Episode,
}
ABOUT = (
    "Timings: the stages of an episode, the planner and the motions against their targets, physics, whole "
    "episodes, and all 240 Soma cubes."
)


def benchmark(arguments: list[str] | None = None) -> int:
    """Entry point of `soma-benchmark` and of scripts/benchmark.py. Returns the exit status."""
    # many small matrices: threads of the linear algebra would only get in each other's way
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    given = sys.argv[1:] if arguments is None else arguments
    chosen = KINDS.get(given[0] if given else "", Stages)
    command: Any = Annotated[Stages, tyro.conf.subcommand("stages")]
    for name, kind in list(KINDS.items())[1:]:
        command = command | Annotated[kind, tyro.conf.subcommand(name)]
    options = tyro.cli(
        command,
        default=Stages(),
        args=given,
        prog="soma-benchmark",
        description=ABOUT,
        registry=registry(chosen),
    )
    return run_command(_run, options)


def _run(options: Stages | Planner | Cube240 | Motion | Simulate | Episode) -> int:
    options.check()
    if isinstance(options, Stages):
        from soma_bullet.benchmark.stages import stages

        stages(options, _say)
    elif isinstance(options, Planner):
        from soma_bullet.benchmark.planner import planner

        planner(options.runs)
    elif isinstance(options, Cube240):
        from soma_bullet.benchmark.cubes import cube240

        cube240(options)
    elif isinstance(options, Motion):
        from soma_bullet.benchmark.motion import motion

        motion(options, _say)
    elif isinstance(options, Simulate):
        from soma_bullet.benchmark.physics import simulate

        simulate(options)
    else:
        from soma_bullet.benchmark.episodes import episode

        episode(options, _say)
    return 0


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")
