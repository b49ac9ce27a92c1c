"""Compare the planner's verdicts on stability with contact physics and with compas-cra, on random Soma
subassemblies."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass(frozen=True)
class Arguments:
    """Writes the table as Markdown on stdout, each disagreement on stderr, and all states to states.json."""

    states: int = 300
    """How many subassemblies."""
    seed: int = 0
    """Of the subassemblies."""
    jobs: int = os.cpu_count() or 1
    """Worker processes; the result does not depend on it."""
    out: Path = Path("runs/stability")
    """Where the states are written."""
    draw: int | None = None
    """Examine this draw of the seed alone, and print it as JSON."""


def main(arguments: Arguments) -> int:
    """Run the comparison. Returns the exit status."""
    import json

    from rich.console import Console
    from rich.progress import Progress

    from soma_bullet.errors import InputError, SomaBulletError
    from soma_bullet.records import to_tree
    from soma_bullet.validation.comparison import compare, disagreements, examine, table

    try:
        if arguments.states < 1 or arguments.jobs < 1 or arguments.seed < 0:
            raise InputError("arguments", "--states and --jobs must be at least 1, and --seed at least 0")
        if arguments.draw is not None:
            sys.stdout.write(json.dumps(to_tree(examine(arguments.seed, arguments.draw)), indent=1) + "\n")
            return 0
        with Progress(console=Console(stderr=True)) as bar:
            task = bar.add_task("states", total=arguments.states)
            comparison = compare(
                arguments.states, arguments.seed, arguments.jobs, arguments.out, lambda: bar.advance(task)
            )
    except SomaBulletError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_status
    for line in disagreements(comparison):
        sys.stderr.write(line + "\n")
    sys.stdout.write(table(comparison))
    return 0


if __name__ == "__main__":
    # many small matrices: threads of the linear algebra would only get in each other's way
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    raise SystemExit(main(tyro.cli(Arguments)))
