"""The command line of the planner: `soma-plan`, scripts/plan.py. Neither robot nor simulator is needed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from soma_bullet.cli.common import WIDTH, run_command
from soma_bullet.cli.flags import parse
from soma_bullet.option import Options, Range
from soma_bullet.options import EpisodeOptions
from soma_bullet.planner.options import PlannerOptions

PICTURES, JSON = (".png", ".svg", ".pdf"), (".json",)


@dataclass(frozen=True)
class PlanArguments(Options):
    """Plans an assembly: order, assembly directions, grasps, and what has to be held meanwhile. No robot, no
    simulator.

    Exit status: 0 a plan was found; 2 bad input; 3 no plan exists (with what blocked it).
    """

    names: ClassVar[Mapping[str, str]] = {"planner": ""}

    assembly: str
    """An assembly file, or the name of one that comes with the package (soma3, soma4, cube, dowel, arch,
    ...)."""
    cell: str = EpisodeOptions.cell
    """A folder or cell.toml whose arms' hands are to build it, or the name of one under robots/."""
    hand: str | None = None
    """A hand.toml that replaces the hands of the cell, or the name of a cell whose hand it is."""
    planner: PlannerOptions = PlannerOptions()
    """How orders are judged."""
    explain: bool = False
    """Print why: every step of the order, and the tree of what ruled the others out, most frequent first."""
    figure: Path | None = None
    """Draw the orders, a row each, as in the paper: .png, .svg or .pdf."""
    rows: Annotated[int, Range(1)] = 6
    """Orders in the figure."""
    exploded: Path | None = None
    """Draw the pieces moved apart along their assembly directions: .png, .svg or .pdf."""
    out: Path | None = None
    """Write the whole plan, with the matrices of all orders, as JSON; an episode can go on from it."""

    def faults(self, prefix: str = "--") -> list[str]:
        """As of all options; a file has an ending that can be written, and a folder."""
        faults = super().faults(prefix)
        files = (
            ("figure", self.figure, PICTURES),
            ("exploded", self.exploded, PICTURES),
            ("out", self.out, JSON),
        )
        for name, path, allowed in files:
            if path is None:
                continue
            if path.suffix.lower() not in allowed:
                faults.append(f"--{name} {path}: must end in {' or '.join(allowed)}")
            elif path.is_dir():
                faults.append(f"--{name} {path}: is a folder")
            elif not path.absolute().parent.is_dir():
                faults.append(f"--{name} {path}: there is no folder {path.absolute().parent}")
        if self.figure is None and self.rows != PlanArguments.rows:
            faults.append(f"--rows {self.rows}: there is no --figure whose rows these could be")
        return faults


def plan(arguments: list[str] | None = None) -> int:
    """Entry point of `soma-plan` and of scripts/plan.py. Returns the exit status."""
    return run_command(_run, parse(PlanArguments, arguments, "soma-plan"))


def _run(options: PlanArguments) -> int:
    options.check()
    from rich.console import Console
    from rich.tree import Tree

    from soma_bullet.assembly.file import load_assembly
    from soma_bullet.grasp.hand_set import HandSet
    from soma_bullet.planner.plan import NoPlanError, make_plan
    from soma_bullet.planner.qualities import Qualities
    from soma_bullet.records import write_json
    from soma_bullet.report.explain import explain_plan, explain_rows
    from soma_bullet.report.table import plan_table
    from soma_bullet.robot.cell import find_hand, load_cell

    console = Console(stderr=True)
    console.width = max(console.width, WIDTH)
    assembly, cell = load_assembly(options.assembly), load_cell(options.cell)
    hands = cell.hands if options.hand is None else HandSet.alike(find_hand(options.hand), len(cell.arms))
    planner = options.planner.with_hands(len(cell.arms)).advised(assembly.advice)
    qualities = Qualities(assembly, hands, planner)
    with console.status(f"planning {assembly.name}") as status:
        try:
            found = make_plan(assembly, hands, planner, qualities=qualities)
        except NoPlanError as error:
            if options.explain:
                console.print(explain_rows(error.rows, Tree(f"{assembly.name}: {error.summary}")))
            raise
        if options.figure is not None:
            from soma_bullet.pictures.figure import draw_orders

            status.update(f"drawing {options.figure}")
            draw_orders(assembly, hands, found, options.figure, options.rows, qualities)
        if options.exploded is not None:
            from soma_bullet.pictures.exploded import draw_exploded

            status.update(f"drawing {options.exploded}")
            draw_exploded(assembly, found, options.exploded)
    if options.out is not None:
        write_json(found, options.out)
    console.print(explain_plan(found) if options.explain else plan_table(found))
    if not options.explain:
        for warning in found.warnings:
            console.print(f"[yellow]warning[/]: {warning}")
    for path in (options.figure, options.exploded, options.out):
        if path is not None:
            console.print(f"written: {path}", markup=False)
    return 0
