"""A plan as a table: a row a step."""

from __future__ import annotations

import math

from rich.table import Table

from soma_bullet.planner.assembly_plan import AssemblyPlan


def number(value: float) -> str:
    """A quality as people read it."""
    return "∞" if math.isinf(value) else f"{value:.3g}"


def plan_table(plan: AssemblyPlan) -> Table:
    """Order, directions, contact types, grasps and holds of the chosen order."""
    table = Table(
        title=f"{plan.assembly}: {' <- '.join(plan.order)} ({plan.options.stability} mode)",
        title_justify="left",
    )
    for heading in ("step", "piece", "along", "type", "grasps", "held afterwards", "state"):
        table.add_column(heading)
    for k, step in enumerate(plan.steps):
        held = (
            ", ".join(f"{hold.piece} ({hold.certificate.margin:.1f} x the load)" for hold in step.holds)
            or "nothing"
        )
        along = ", ".join(f"{v:.2f}" for v in step.direction)
        table.add_row(
            str(k + 1), step.piece, f"({along})", step.type, str(len(step.grasps)), held, step.verdict
        )
    return table
