"""Why the plan is what it is: the chosen order step by step, and the tree of what ruled the others out, most
frequent first."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence

from rich.markup import escape
from rich.tree import Tree

from soma_bullet.planner.assembly_plan import AssemblyPlan, Hold, PlannedOrder, PlanStep
from soma_bullet.planner.equilibrium import FIRM
from soma_bullet.planner.orders import OrderRow
from soma_bullet.planner.programs import LARGEST
from soma_bullet.report.table import number

MOST_REASONS = 8  # lines below one heading; what follows is counted
MOST_TIES = 6


def explain_plan(plan: AssemblyPlan) -> Tree:
    """The whole explanation of a plan."""
    tree = Tree(
        f"[bold]{escape(plan.assembly)}[/], {plan.options.stability} mode, {plan.named_hands}, "
        f"{plan.options.hands} hands"
    )
    tree.add(escape(plan.optimality))
    _add_order(tree, "chosen", PlannedOrder(plan.order, plan.score, plan.steps))
    for k, other in enumerate(plan.alternatives):
        _add_order(tree, f"{k + 2}.", other)
    if plan.ties:
        ties = tree.add(
            f"{len(plan.ties)} orders score the same; the seed ({plan.options.seed}) picks among the "
            f"fewest holds"
        )
        _add_lines(ties, [" <- ".join(order) for order in plan.ties], MOST_TIES)
    if plan.passed_over:
        _add_lines(tree.add("would score better, and cannot be built"), plan.passed_over, MOST_REASONS)
    explain_rows(plan.orders, tree)
    if plan.warnings:
        _add_lines(tree.add("[yellow]warnings[/]"), plan.warnings, len(plan.warnings))
    return tree


def explain_rows(rows: Sequence[OrderRow], tree: Tree) -> Tree:
    """Add what ruled orders out: by analyzer, then by reason, each with the number of orders that first
    failed there."""
    blocked = [row for row in rows if not row.feasible]
    if not blocked:
        tree.add(f"none of {len(rows)} orders is ruled out")
        return tree
    ruled = tree.add(
        f"{len(blocked)} of {len(rows)} orders are ruled out; the first that fails, and how often"
    )
    stages: dict[str, Counter[str]] = defaultdict(Counter)
    for row in blocked:
        stages[row.blocked_by][row.reason] += 1
    for stage, reasons in sorted(stages.items(), key=lambda item: (-item[1].total(), item[0])):
        branch = ruled.add(f"[bold]{escape(stage)}[/]: {_orders(reasons.total())}")
        ranked = sorted(reasons.items(), key=lambda item: (-item[1], item[0]))
        _add_lines(branch, [f"{_orders(count)}: {reason}" for reason, count in ranked], MOST_REASONS)
    return tree


def _orders(count: int) -> str:
    return "1 order" if count == 1 else f"{count} orders"


def _add_lines(branch: Tree, lines: Sequence[str], most: int) -> None:
    for line in lines[:most]:
        branch.add(escape(line))
    if len(lines) > most:
        branch.add(f"... and {len(lines) - most} more")


def _add_order(tree: Tree, label: str, planned: PlannedOrder) -> None:
    named = escape(" <- ".join(planned.order))
    branch = tree.add(f"{label} [bold]{named}[/], score {number(planned.score)}")
    for k, step in enumerate(planned.steps):
        leaf = branch.add(f"{k + 1}. [bold]{escape(step.piece)}[/] {_insertion(step)}")
        state = f"then the state is {step.verdict}" + ("" if step.holds else f": it resists {_margin(step)}")
        leaf.add(
            state
            if not step.holds
            else f"{state} with {' and '.join(escape(hold.piece) for hold in step.holds)} held"
        )
        for hold in step.holds:
            leaf.add(_hold(hold))


def _insertion(step: PlanStep) -> str:
    along = ", ".join(f"{value:.2f}" for value in step.direction)
    bears = f"; what is placed bears a push of {step.bears:.2f} N" if step.bears < LARGEST else ""
    return (
        f"along ({along}) over {step.way * 1e3:.0f} mm; contact type {step.type}; {len(step.grasps)} "
        f"candidate grasps{bears}"
    )


def _margin(step: PlanStep) -> str:
    if step.verdict in FIRM:
        return f"{step.margin:.3f} g sideways"
    return f"{step.margin:.3f} g sideways, and {step.margin_sides:.3f} g with the help of side contacts"


def _hold(hold: Hold) -> str:
    how = "a hand takes" if hold.taken else "a hand stays on"
    proof, (fx, fy, fz, *_) = hold.certificate, hold.certificate.wrench
    force = (fx**2 + fy**2 + fz**2) ** 0.5
    return (
        f"{how} {escape(hold.piece)}: {len(hold.grasps)} assisting grasps; number {hold.grasp} takes "
        f"{proof.margin:.1f} x the "
        f"load ({proof.load.push:g} N of the next insertion, {proof.load.disturbance:g} g sideways: "
        f"{force:.2f} N on it) "
        f"with {proof.grip_force:g} N of grip at friction {proof.friction:.2f}"
    )
