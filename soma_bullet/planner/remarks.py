"""What is worth knowing of a plan beside the plan: warnings, and how firm paper mode's values are."""

from __future__ import annotations

import numpy as np

from soma_bullet.assembly.model import Assembly
from soma_bullet.planner.analyzers import grounded
from soma_bullet.planner.assembly_plan import PlanStep, Sensitivity
from soma_bullet.planner.orders import OrderRow, Orders
from soma_bullet.planner.qualities import Placed, Qualities

TURNS = 12  # rotations of the friction pyramid over which paper mode's sensitivity is taken


def hanging(orders: Orders, row: OrderRow) -> list[str]:
    """Pieces of the chosen order that nothing carries when they are placed."""
    order = [orders.names.index(name) for name in row.order]
    return [
        f"nothing carries {name} when it is placed: it hangs in a hand until something is put below it; "
        + (
            "no other order was found"
            if not orders.paper
            else "the analyzer `grounded` rules such orders out"
        )
        for k, name in enumerate(row.order)
        if not grounded(orders.q, frozenset(order[:k]), order[k]).stands
    ]


def pressed(steps: tuple[PlanStep, ...], paper: bool) -> list[str]:
    """Insertions that the pieces in place do not bear."""
    return [
        f"{step.piece} may move {step.pressed} as it comes in, which bears {step.borne:.2f} of that; "
        + ("paper mode does not ask" if paper else "no order was found in which every insertion is borne")
        for step in steps
        if step.borne < 1.0
    ]


def fragile(steps: tuple[PlanStep, ...], least: float) -> list[str]:
    """States that stand and resist less than is done to them."""
    return [
        f"after {step.piece} the state is fragile: it resists {step.margin:.3f} g sideways, and {least:g} g "
        "(--disturbance) is reckoned with"
        for step in steps
        if step.verdict == "fragile"
    ]


def approximations(assembly: Assembly) -> list[str]:
    """Pieces whose collision parts are not exact."""
    return [
        f"{piece.name} curves inwards: its collision parts have {piece.decomposition.volume_ratio:.3f} x "
        f"its volume and stand "
        f"out by up to {piece.decomposition.deviation * 1e3:.2f} mm"
        for piece in assembly.pieces
        if piece.decomposition.kind == "approximate"
    ]


def _states(rows: list[OrderRow]) -> list[tuple[str, ...]]:
    return sorted(
        {tuple(sorted(row.order[: k + 1])) for row in rows for k in range(len(row.order))},
        key=lambda s: (len(s), s),
    )


def false_stable(orders: Orders, rows: list[OrderRow]) -> list[str]:
    """States that the paper's measure calls stable and that fall all the same: pieces that lean on each
    other."""
    warnings = []
    for state in _states(rows):
        placed: Placed = frozenset(orders.names.index(name) for name in state)
        values, zeros = orders.paper_state(placed)
        if not zeros and not orders.holds.judge(placed).stands:
            listed = ", ".join(f"{orders.names[j]} {value:.3f}" for j, value in values.items())
            warnings.append(
                f"paper mode calls {{{', '.join(orders.names[j] for j in values)}}} stable ({listed}), "
                "but it falls: its pieces cannot all be in equilibrium at once"
            )
    return warnings


def sensitivity(qualities: Qualities, row: OrderRow) -> list[Sensitivity]:
    """Of the values in the row: the s of the piece just placed, and the smallest s that needs no hand."""
    found = []
    for k, name in enumerate(row.order):
        placed = frozenset(qualities.assembly.index(n) for n in row.order[: k + 1])
        values = {j: qualities.paper_stability(j, placed) for j in sorted(placed)}
        reported = {qualities.assembly.index(name)}
        reported |= set(sorted((j for j in values if values[j] > 0), key=values.__getitem__)[:1])
        for piece in sorted(reported):
            turned = [qualities.paper_stability(piece, placed, i * np.pi / 3 / TURNS) for i in range(TURNS)]
            found.append(
                Sensitivity(
                    row.order[: k + 1], qualities.assembly.names[piece], turned[0], min(turned), max(turned)
                )
            )
    return found
