"""The command line of the planner: `soma-plan`, scripts/plan.py. Neither robot nor simulator is needed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from soma_bullet.cli.common import run_command


@dataclass(frozen=True)
class PlanArguments:
    """Plans an assembly: order, assembly directions, grasps, and what has to be held meanwhile. No robot, no
    simulator.

    Exit status: 0 a plan was found; 2 bad input; 3 no plan exists (with what blocked it).
    """

    assembly: tyro.conf.Positional[str]
    """An assembly file, or the name of one that comes with the package (soma3, soma4, cube, dowel, arch,
    ...)."""
    stability: str = "equilibrium"
    """equilibrium: the whole placed set at once; paper: one piece against fixed neighbours; or your own, as
    module:function."""
    hand: str = "ur5e_pair"
    """A hand.toml, a folder that has one, or the name of a cell whose hand it is."""
    hands: int = 2
    """Hands of the robot: one inserts, the others may hold."""
    top: int = 1
    """How many of the best orders to work out step by step."""
    seed: int = 0
    """Picks among orders of equal score."""
    analyzer: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """A further analyzer of steps: grounded (no piece is put into the air), or your own as module:function;
    repeatable."""
    push: float = 2.0
    """A hold must resist this force of the next insertion [N] ..."""
    disturbance: float = 0.1
    """... and this horizontal acceleration of every placed piece [g]."""
    explain: bool = False
    """Print why: every step of the order, and the tree of what ruled the others out, most frequent first."""
    figure: Path | None = None
    """Draw the orders, a row each, as in the paper: .png, .svg or .pdf."""
    rows: int = 6
    """Orders in the figure."""
    exploded: Path | None = None
    """Draw the pieces moved apart along their assembly directions: .png, .svg or .pdf."""
    out: Path | None = None
    """Write the whole plan, with the matrices of all orders, as JSON."""


def plan(arguments: list[str] | None = None) -> int:
    """Entry point of `soma-plan` and of scripts/plan.py. Returns the exit status."""
    return run_command(_run, tyro.cli(PlanArguments, args=arguments, prog="soma-plan"))


def _run(options: PlanArguments) -> int:
    from rich.console import Console
    from rich.tree import Tree

    _check(options)
    from soma_bullet.assembly.file import load_assembly
    from soma_bullet.grasp.hand_set import HandSet
    from soma_bullet.planner.assist import HoldLoad
    from soma_bullet.planner.plan import NoPlanError, make_plan
    from soma_bullet.planner.qualities import PlannerOptions, Qualities
    from soma_bullet.records import write_json
    from soma_bullet.report.explain import explain_plan, explain_rows
    from soma_bullet.report.table import plan_table
    from soma_bullet.robot.cell import find_hand

    console = Console(stderr=True)
    console.width = max(console.width, 110)
    assembly, hands = load_assembly(options.assembly), HandSet.alike(find_hand(options.hand))
    settings = PlannerOptions(
        options.stability, options.hands, options.seed, options.top, options.analyzer,
        HoldLoad(options.push, options.disturbance),
    )  # fmt: skip
    qualities = Qualities(assembly, hands, settings)
    with console.status(f"planning {assembly.name}") as status:
        try:
            found = make_plan(assembly, hands, settings, qualities=qualities)
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


def _check(options: PlanArguments) -> None:
    """Refuse what no plan could use, all at once, before any work."""
    import math

    from soma_bullet.errors import InputError

    faults = []
    for name, least in (("hands", 1), ("top", 1), ("rows", 1), ("seed", 0)):
        value: int = getattr(options, name)
        if value < least:
            faults.append(f"--{name} {value}: must be at least {least}")
    for name, amount in (("push", options.push), ("disturbance", options.disturbance)):
        if not (math.isfinite(amount) and amount >= 0):
            faults.append(f"--{name} {amount:g}: must not be negative")
    endings = {"figure": (".png", ".svg", ".pdf"), "exploded": (".png", ".svg", ".pdf"), "out": (".json",)}
    for name, allowed in endings.items():
        path: Path | None = getattr(options, name)
        if path is None:
            continue
        if path.suffix.lower() not in allowed:
            faults.append(f"--{name} {path}: must end in {' or '.join(allowed)}")
        elif path.is_dir() or not path.absolute().parent.is_dir():
            what = "is a folder" if path.is_dir() else f"there is no folder {path.absolute().parent}"
            faults.append(f"--{name} {path}: {what}")
    if faults:
        raise InputError("arguments", faults)
