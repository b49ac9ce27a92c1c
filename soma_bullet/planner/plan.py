"""The plan: the best order with its directions, grasps and assisting grasps, the matrices behind it, and warnings."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from soma_bullet.assembly.model import Assembly
from soma_bullet.errors import InputError, NoSolutionError
from soma_bullet.frames import Array, to_quat_xyzw
from soma_bullet.grasp.hand import Hand
from soma_bullet.planner.equilibrium import TIE
from soma_bullet.planner.orders import OrderRow, Orders, score_of
from soma_bullet.planner.qualities import Placed, PlannerOptions, Qualities, way_length
from soma_bullet.records import package_versions

TURNS = 12  # rotations of the friction pyramid over which paper mode's sensitivity is taken


@dataclass(frozen=True, eq=False)
class GraspTable:
    """Grasps of one piece, alone in the air.

    Attributes:
        piece: its name.
        poses: T_piece_tcp as position [m] and quat_xyzw (n, 7).
        widths: (n,) [m].
        contact: fraction of the pad on the piece (n,).
    """

    piece: str
    poses: Array
    widths: Array
    contact: Array


@dataclass(frozen=True)
class Hold:
    """A piece that a hand holds after a step.

    Attributes:
        piece: its name.
        grasps: indices of the assisting grasps in the piece's table: clear of the placed set, the support and the way of the
            next piece.
    """

    piece: str
    grasps: tuple[int, ...]


@dataclass(frozen=True)
class PlanStep:
    """One insertion.

    Attributes:
        piece: what is inserted.
        direction: unit assembly direction in the assembly frame.
        way: length of the straight way in [m].
        type: contact type.
        grasps: indices of the accessible grasps in the piece's table.
        holds: what equilibrium asks to hold afterwards.
        verdict, margin, margin_sides: equilibrium of the state with the holds [g].
    """

    piece: str
    direction: tuple[float, float, float]
    way: float
    type: str
    grasps: tuple[int, ...]
    holds: tuple[Hold, ...]
    verdict: str
    margin: float
    margin_sides: float


@dataclass(frozen=True)
class Sensitivity:
    """Paper mode: how an s of the chosen order depends on the frame of the friction pyramid.

    Attributes:
        state: names of the placed pieces, in order.
        piece: the one just placed, or the one whose s is the recomputed one of the step.
        s: as pinned.
        low, high: extremes over rotations of the pyramid.
    """

    state: tuple[str, ...]
    piece: str
    s: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class AssemblyPlan:
    """Output of the planner.

    Attributes:
        assembly, digest: name and content hash of the input.
        hand: name of the hand.
        options: how it was judged.
        order: names of the pieces, first to last.
        steps: one for each piece of the order.
        grasps: one table a piece.
        orders: the row of every order, best first.
        ties: orders whose score equals the best one's.
        warnings: sentences.
        sensitivity: paper mode only.
        versions: packages that the numbers depend on.
    """

    assembly: str
    digest: str
    hand: str
    options: PlannerOptions
    order: tuple[str, ...]
    steps: tuple[PlanStep, ...]
    grasps: tuple[GraspTable, ...]
    orders: tuple[OrderRow, ...]
    ties: tuple[tuple[str, ...], ...]
    warnings: tuple[str, ...]
    sensitivity: tuple[Sensitivity, ...]
    versions: dict[str, str]


def make_plan(
    assembly: Assembly, hand: Hand, options: PlannerOptions | None = None, excluded: frozenset[tuple[str, ...]] = frozenset()
) -> AssemblyPlan:
    """Evaluate every order and return the best, with all that a dual-arm task needs.

    Args:
        excluded: orders that a later stage found impossible.

    Raises:
        InputError: the finished assembly cannot stand.
        NoSolutionError: no order is feasible; carries what blocked, most frequent first.
    """
    options = options or PlannerOptions()
    qualities = Qualities(assembly, hand, options)
    _check_final(assembly, qualities)
    orders = Orders(qualities)
    rows = orders.all_rows()
    if options.stability == "paper":
        rows = _paper_scores(rows)
    ranked = sorted(rows, key=lambda row: (not row.feasible, -row.score))
    candidates = [row for row in ranked if row.feasible and row.score > 0 and row.order not in excluded]
    if not candidates:
        reasons = Counter(row.reason or "score 0" for row in rows if row.order not in excluded)
        raise NoSolutionError("plan", f"none of the {len(rows)} orders of {assembly.name} can be built", reasons)
    best = candidates[0]
    ties = [row for row in candidates if math.isclose(row.score, best.score, rel_tol=1e-9)]
    first = ties[int(np.random.default_rng(options.seed).integers(len(ties)))]
    chosen, steps, passed_over = _first_buildable(orders, [first, *(row for row in candidates if row is not first)])
    paper = options.stability == "paper"
    return AssemblyPlan(
        assembly=assembly.name,
        digest=assembly.digest,
        hand=hand.name,
        options=options,
        order=chosen.order,
        steps=steps,
        grasps=tuple(_table(qualities, k) for k in range(len(assembly.pieces))),
        orders=tuple(ranked),
        ties=tuple(row.order for row in ties) if len(ties) > 1 else (),
        warnings=(*passed_over, *(_false_stable(qualities, rows) if paper else ())),
        sensitivity=tuple(_sensitivity(qualities, chosen)) if paper else (),
        versions=package_versions(),
    )


def _paper_scores(rows: list[OrderRow]) -> list[OrderRow]:
    """Where an order is stable throughout, the assisting hand stays away and raw s counts (paper Sec. III and IV-G)."""
    if not any(row.feasible and row.stable_throughout for row in rows):
        return rows
    return [replace(row, score=score_of(row.s, row.g, row.a) if row.feasible else 0.0) for row in rows]


def _check_final(assembly: Assembly, qualities: Qualities) -> None:
    everything = frozenset(range(len(assembly.pieces)))
    final = qualities.stability(everything)
    if final.verdict != "unstable":
        return
    saved = [assembly.names[k] for k in everything if qualities.stability(everything, frozenset({k})).verdict != "unstable"]
    hint = f"holding {' or '.join(saved)} would keep it up" if saved else "no single hold would keep it up"
    raise InputError(
        assembly.name,
        f"the finished assembly is not stable: it resists {final.margin:.3f} g without and {final.margin_sides:.3f} g with "
        f"side contacts, and must resist more than {TIE:g} g; {hint}",
    )


def _first_buildable(orders: Orders, candidates: list[OrderRow]) -> tuple[OrderRow, tuple[PlanStep, ...], list[str]]:
    """The first order that stands in equilibrium with the hands there are, its steps, and a sentence for each passed over.

    Only paper mode passes any over: it may count on states that fall.
    """
    reasons: list[str] = []
    for row in candidates:
        order = tuple(orders.names.index(name) for name in row.order)
        _, _, held, reason = orders.equilibrium_support(order)
        if not reason:
            named = " <- ".join(row.order)
            return row, _steps(orders.q, order, held), [f"passed over for {named}: {text}" for text in reasons]
        reasons.append(f"{' <- '.join(row.order)} (score {row.score:.4g}): {reason}")
    raise NoSolutionError("plan", "no order stands with the hands there are", Counter(reasons))


def _steps(qualities: Qualities, order: tuple[int, ...], held: list[Placed]) -> tuple[PlanStep, ...]:
    """Steps of an order, with the holds that equilibrium asks for in either mode."""
    assembly = qualities.assembly
    steps = []
    for k, piece in enumerate(order):
        before, placed = frozenset(order[:k]), frozenset(order[: k + 1])
        upcoming = order[k + 1] if k + 1 < len(order) else None
        next_direction = None if upcoming is None else qualities.assemblability(upcoming, placed).direction
        way = qualities.assemblability(piece, before)
        assert way.direction is not None
        state = qualities.stability(placed, held[k])
        steps.append(
            PlanStep(
                piece=assembly.names[piece],
                direction=tuple((np.round(way.direction, 12) + 0.0).tolist()),
                way=way_length(assembly, piece, way.direction),
                type=way.type,
                grasps=tuple(int(i) for i in qualities.accessible(piece, before)),
                holds=tuple(
                    Hold(assembly.names[j], tuple(int(i) for i in qualities.assisting(j, placed, upcoming, next_direction)))
                    for j in sorted(held[k])
                ),
                verdict=state.verdict,
                margin=state.margin,
                margin_sides=state.margin_sides,
            )
        )
    return tuple(steps)


def _table(qualities: Qualities, piece: int) -> GraspTable:
    grasps = qualities.grasps(piece)
    poses = np.hstack(to_quat_xyzw(grasps.Ts_piece_tcp))
    return GraspTable(qualities.assembly.names[piece], np.round(poses, 9) + 0.0, np.round(grasps.widths, 9), grasps.contact)


def _states(rows: list[OrderRow]) -> list[tuple[str, ...]]:
    return sorted({tuple(sorted(row.order[: k + 1])) for row in rows for k in range(len(row.order))}, key=lambda s: (len(s), s))


def _false_stable(qualities: Qualities, rows: list[OrderRow]) -> list[str]:
    """States that the paper's measure calls stable and that fall all the same: pieces that lean on each other."""
    warnings = []
    for state in _states(rows):
        placed: Placed = frozenset(qualities.assembly.index(name) for name in state)
        values = [qualities.paper_stability(j, placed) for j in sorted(placed)]
        if min(values) > 0 and qualities.stability(placed).verdict == "unstable":
            listed = ", ".join(f"{qualities.assembly.names[j]} {v:.3f}" for j, v in zip(sorted(placed), values, strict=True))
            warnings.append(
                f"paper mode calls {{{', '.join(qualities.assembly.names[j] for j in sorted(placed))}}} stable ({listed}), "
                "but it falls: its pieces cannot all be in equilibrium at once"
            )
    return warnings


def _sensitivity(qualities: Qualities, row: OrderRow) -> list[Sensitivity]:
    """Of the values in the row: the s of the piece just placed, and the smallest s that needs no hand."""
    found = []
    for k, name in enumerate(row.order):
        placed = frozenset(qualities.assembly.index(n) for n in row.order[: k + 1])
        values = {j: qualities.paper_stability(j, placed) for j in sorted(placed)}
        reported = {qualities.assembly.index(name)}
        reported |= set(sorted((j for j in values if values[j] > 0), key=values.__getitem__)[:1])
        for piece in sorted(reported):
            turned = [qualities.paper_stability(piece, placed, i * np.pi / 3 / TURNS) for i in range(TURNS)]
            found.append(Sensitivity(row.order[: k + 1], qualities.assembly.names[piece], turned[0], min(turned), max(turned)))
    return found
