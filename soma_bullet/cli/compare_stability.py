"""The command line that compares verdicts on stability: scripts/compare_stability.py.

Not installed: the judge that it compares with comes with the packages for tests."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from soma_bullet.cli.common import run_command
from soma_bullet.cli.flags import parse
from soma_bullet.option import SEED, Options, Range


@dataclass(frozen=True)
class StabilityArguments(Options):
    """Compares the planner's verdicts on stability with contact physics and with compas-cra, on random Soma
    subassemblies.

    Writes the table as Markdown on stdout, each disagreement on stderr, and all states to states.json.
    """

    states: Annotated[int, Range(1)] = 300
    """How many subassemblies."""
    seed: Annotated[int, SEED] = 0
    """Of the subassemblies."""
    jobs: Annotated[int, Range(1)] = os.cpu_count() or 1
    """Worker processes; the result does not depend on it."""
    out: Path = Path("runs/stability")
    """Where the states are written."""
    draw: Annotated[int | None, Range(0)] = None
    """Examine this draw of the seed alone, and print it as JSON."""


def compare_stability(arguments: list[str] | None = None) -> int:
    """Entry point of scripts/compare_stability.py. Returns the exit status."""
    # many small matrices: threads of the linear algebra would only get in each other's way
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    return run_command(_run, parse(StabilityArguments, arguments, "compare_stability.py"))


def _run(options: StabilityArguments) -> int:
    options.check()
    import json

    from rich.console import Console
    from rich.progress import Progress

    from soma_bullet.records import to_tree
    from soma_bullet.validation.comparison import compare, disagreements, examine, table

    if options.draw is not None:
        sys.stdout.write(json.dumps(to_tree(examine(options.seed, options.draw)), indent=1) + "\n")
        return 0
    with Progress(console=Console(stderr=True)) as bar:
        task = bar.add_task("states", total=options.states)
        comparison = compare(
            options.states, options.seed, options.jobs, options.out, lambda: bar.advance(task)
        )
    for line in disagreements(comparison):
        sys.stderr.write(line + "\n")
    sys.stdout.write(table(comparison))
    return 0
