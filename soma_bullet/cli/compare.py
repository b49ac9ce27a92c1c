"""The command line that compares two evaluations: `soma-compare`, scripts/compare_runs.py."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from soma_bullet.cli.common import WIDTH, run_command
from soma_bullet.cli.flags import parse
from soma_bullet.option import Options


@dataclass(frozen=True)
class CompareArguments(Options):
    """Pairs the episodes of two runs of soma-evaluate by seed, and their insertions by seed and piece: which
    is better, and may that be chance.

    Prints a table, and writes comparison.json and comparison.png. Exit status: 0 compared, whoever is better;
    2 bad input.
    """

    a: Path
    """The folder of one run (or its episodes.jsonl): the one to improve on."""
    b: Path
    """The folder of the other."""
    out: Path = Path("runs/comparison")
    """Where the comparison and its figure are written."""
    any_assembly: bool = False
    """Compare also where the assemblies differ, as long as their pieces have the same names."""


def compare(arguments: list[str] | None = None) -> int:
    """Entry point of `soma-compare` and of scripts/compare_runs.py. Returns the exit status."""
    return run_command(_run, parse(CompareArguments, arguments, "soma-compare"))


def _run(options: CompareArguments) -> int:
    from rich.console import Console

    from soma_bullet.errors import InputError
    from soma_bullet.evaluation import compare as comparing
    from soma_bullet.evaluation.compare_figure import draw
    from soma_bullet.evaluation.compare_table import table
    from soma_bullet.records import write_json

    out, errors = Console(), Console(stderr=True)
    for console in (out, errors):
        console.width = max(console.width, WIDTH)
    comparison = comparing.compare(options.a, options.b, options.any_assembly)
    picture = options.out / "comparison.png"
    try:
        write_json(comparison, options.out / comparing.COMPARISON)
        with errors.status("drawing"):
            draw(comparison, picture)
    except OSError as error:
        raise InputError("--out", f"{options.out} cannot be written: {error.strerror}") from None
    out.print(table(comparison))
    errors.print(f"written to {options.out}/: {comparing.COMPARISON}, {picture.name}", markup=False)
    return 0
