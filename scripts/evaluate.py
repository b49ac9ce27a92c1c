"""Run many seeded episodes and say how often they succeed, with the 95 % interval and the causes of failure."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro


@dataclass(frozen=True)
class Arguments:
    """Runs episodes in worker processes; can be interrupted and resumed. Writes episodes.jsonl and summary.json."""

    assembly: tyro.conf.Positional[str]
    """An assembly file, or the name of one that comes with the package."""
    episodes: int = 20
    """How many."""
    jobs: int = os.cpu_count() or 1
    """Worker processes; the result does not depend on it."""
    seed: int = 0
    """Of the first episode; the others follow on."""
    ablate: Literal["none", "hold"] = "none"
    """hold: open the assisting hand where it should hold, all else equal."""
    stability: Literal["equilibrium", "paper"] = "equilibrium"
    """Which stability measure chooses the order."""
    out: Path = Path("runs/evaluation")
    """Where the lines and the summary are written; an interrupted run goes on from there."""


def main(arguments: Arguments) -> int:
    """Run the evaluation. Returns the exit status."""
    from rich.console import Console
    from rich.progress import Progress

    from soma_bullet.errors import InputError, SomaBulletError
    from soma_bullet.evaluation import EvaluationOptions, evaluate

    ablate = "" if arguments.ablate == "none" else arguments.ablate
    options = EvaluationOptions(arguments.assembly, arguments.episodes, arguments.seed, ablate, arguments.stability)
    try:
        if arguments.episodes < 1 or arguments.jobs < 1:
            raise InputError("arguments", "--episodes and --jobs must be at least 1")
        with Progress(console=Console(stderr=True)) as bar:
            task = bar.add_task("episodes", total=arguments.episodes)

            def done(line: dict[str, Any]) -> None:
                bar.advance(task)
                if not line["success"]:
                    bar.console.print(f"seed {line['seed']}: {line['cause']}")

            summary = evaluate(options, arguments.jobs, arguments.out, done)
    except SomaBulletError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_status
    sys.stdout.write(json.dumps(summary, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Arguments)))
