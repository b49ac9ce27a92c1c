"""The plan: the best order with its directions, grasps and assisting grasps, the matrices behind it, and
warnings."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from soma_bullet.assembly.model import Assembly
from soma_bullet.errors import InputError, NoSolutionError
from soma_bullet.frames import to_quat_xyzw
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.planner.assembly_plan import (
    AssemblyPlan,
    GraspTable,
    Hold,
    PlannedOrder,
    PlanStep,
)
from soma_bullet.planner.assist import SMALLEST_MARGIN, HoldCertificate, certify_hold
from soma_bullet.planner.equilibrium import FIRM, TIE
from soma_bullet.planner.holds import AIR, PUSH, RULES
from soma_bullet.planner.options import PAPER, PlannerOptions
from soma_bullet.planner.orders import MOST_ENUMERATED, OrderRow, Orders, rounded
from soma_bullet.planner.programs import LARGEST
from soma_bullet.planner.qualities import NOTHING, Placed, Qualities
from soma_bullet.planner.remarks import approximations, false_stable, fragile, hanging, pressed, sensitivity
from soma_bullet.planner.search import follow
from soma_bullet.planner.ways import way_length
from soma_bullet.records import package_versions

TIES = 16  # orders that are looked for beyond MOST_ENUMERATED, so that ties show
SAMPLES = 200  # orders whose failure is reported there where none is possible
CERTIFIED = 4  # grasps of a hold, those with the most contact, that are certified before all of them


# what is asked of orders, one after another, until there is an order
TIERS = (RULES, frozenset({AIR}), frozenset({PUSH}), frozenset[str]())


class NoPlanError(NoSolutionError):
    """No order can be built. Carries the rows of the orders, which say why."""

    def __init__(self, summary: str, reasons: Counter[str], rows: tuple[OrderRow, ...]):
        super().__init__("plan", summary, reasons)
        self.rows = rows


def make_plan(
    assembly: Assembly,
    hands: HandSet,
    options: PlannerOptions | None = None,
    excluded: frozenset[tuple[str, ...]] = frozenset(),
    qualities: Qualities | None = None,
    placed: tuple[PlanStep, ...] = (),
) -> AssemblyPlan:
    """Find the best order, with all that a dual-arm task needs.

    Args:
        hands: those of the arms.
        excluded: orders that a later stage found impossible.
        qualities: of the same assembly, hands and options, to share what was evaluated.
        placed: the steps that are done: their pieces stand, and no hand holds anything.

    Raises:
        InputError: the finished assembly cannot stand, or an analyzer is not known.
        NoPlanError: no order is feasible; carries what blocked, most frequent first.
    """
    options = (options or PlannerOptions()).with_hands().advised(assembly.advice)
    options.check()
    qualities = qualities or Qualities(assembly, hands, options)
    _check_final(assembly, Orders(qualities))
    begun = tuple(assembly.index(step.piece) for step in placed)
    for rules in TIERS if options.stability != PAPER else TIERS[-1:]:
        orders, refusals = Orders(qualities, rules, begun), list[str]()
        while True:
            try:
                return _plan(orders, options, excluded, refusals, placed)
            except _RefusedHold as refused:  # the orders are ranked anew without it
                refusals.append(str(refused))
            except NoPlanError as error:
                failure = error
                break
    raise failure


class _RefusedHold(Exception):
    """A hold that the search counted on, and that no grasp can take."""


def _plan(
    orders: Orders,
    options: PlannerOptions,
    excluded: frozenset[tuple[str, ...]],
    refusals: list[str],
    placed: tuple[PlanStep, ...],
) -> AssemblyPlan:
    qualities, assembly = orders.q, orders.q.assembly
    ranking = _ranked(orders, options.top, excluded)
    ranked = ranking.rows
    candidates = [row for row in ranked if row.feasible and row.score > 0 and row.order not in excluded]
    if not candidates:
        reasons = Counter(row.reason or "score 0" for row in ranked if row.order not in excluded)
        raise NoPlanError(ranking.failure, reasons + Counter(refusals), tuple(ranked))
    ties = [row for row in candidates if math.isclose(row.score, candidates[0].score, rel_tol=1e-9)]
    easiest = _easiest(ties)
    first = easiest[picked(options.seed, len(easiest))]
    planned: list[PlannedOrder] = []
    passed_over: list[str] = []
    for row in [first, *(row for row in candidates if row is not first)]:
        order = tuple(orders.names.index(name) for name in row.order)
        followed = follow(orders.holds.supports, order, len(placed))
        if followed.complete:
            steps = _steps(orders, order, followed.holds[2], placed)
            planned.append(PlannedOrder(row.order, row.score, steps))
        else:  # paper mode alone: it may count on states that fall
            fault = orders.support_fault(order, len(followed.holds[2]))
            passed_over.append(f"{' <- '.join(row.order)} (score {row.score:.4g}): {fault.reason}")
        if len(planned) == options.top:
            break
    if not planned:
        raise NoPlanError("no order stands with the hands there are", Counter(passed_over), tuple(ranked))
    chosen = next(row for row in candidates if row.order == planned[0].order)
    return AssemblyPlan(
        assembly=assembly.name,
        digest=assembly.digest,
        hands=qualities.hands.names,
        hand_kinds=qualities.hands.arms,
        options=options,
        order=chosen.order,
        score=chosen.score,
        steps=planned[0].steps,
        alternatives=tuple(planned[1:]),
        grasps=tuple(_table(qualities, k) for k in range(len(assembly.pieces))),
        orders=tuple(ranked),
        optimality=ranking.optimality,
        ties=tuple(row.order for row in ties) if len(ties) > 1 else (),
        warnings=(
            *approximations(assembly),
            *hanging(orders, chosen),
            *pressed(planned[0].steps, orders.paper),
            *fragile(planned[0].steps, options.load.disturbance),
            *(false_stable(orders, ranked) if orders.paper else ()),
        ),
        passed_over=(*refusals, *passed_over),
        sensitivity=tuple(sensitivity(qualities, chosen)) if orders.paper else (),
        versions=package_versions(),
    )


def _easiest(ties: list[OrderRow]) -> list[OrderRow]:
    """Of equal scores those that need the hands least."""
    fewest = min(row.holds for row in ties)
    return [row for row in ties if row.holds == fewest]


def picked(seed: int, count: int) -> int:
    """Which of `count` equal orders a seed picks."""
    return int(np.random.default_rng(seed).integers(count))


def easiest_orders(plan: AssemblyPlan) -> list[tuple[str, ...]]:
    """The orders among which the seed picked."""
    rows = {row.order: row for row in plan.orders}
    return [row.order for row in _easiest([rows[order] for order in plan.ties or (plan.order,)])]


@dataclass(frozen=True)
class _Ranking:
    """Rows of orders, best first.

    Attributes:
        optimality: what is guaranteed.
        failure: what to say where none of them can be built.
    """

    rows: list[OrderRow]
    optimality: str
    failure: str


def _ranked(orders: Orders, top: int, excluded: frozenset[tuple[str, ...]]) -> _Ranking:
    name = orders.q.assembly.name
    if orders.count <= MOST_ENUMERATED:
        rows = sorted(orders.all_rows(), key=lambda row: (not row.feasible, -row.score))
        exact = f"exact: all {len(rows)} orders were compared"
        return _Ranking(rows, exact, f"none of the {len(rows)} orders of {name} can be built")
    rows, search = orders.best_rows(max(top, TIES) + len(excluded))
    limit = f"the search over subsets reached its limit of {orders.q.options.labels} labels"
    if rows:
        if search.ended:
            found = f"a search over subsets with {search.labels} labels"
            how = f"exact: {found}; no order scores better, and the best {len(rows)} are listed"
        elif search.proven:
            how = (
                f"exact for the best {search.proven}: no order scores better; others may be missing, {limit}"
            )
        else:
            how = f"not proven best: the best of {len(rows)} orders that were found; {limit}"
        return _Ranking(rows, how, f"none of the {len(rows)} best orders of {name} can be built")
    # every way ends somewhere: say where the ways of some orders do
    left = np.array([k for k in range(orders.count) if k not in orders.placed])
    samples = np.random.default_rng(0).permuted(np.tile(left, (SAMPLES, 1)), axis=1)
    ways = ((*orders.placed, *order) for order in np.unique(samples, axis=0).tolist())
    drawn = [orders.row(order) for order in ways]
    drawn.sort(key=lambda row: (not row.feasible, -row.score))
    why = f"what rules out {len(drawn)} orders drawn at random"
    if search.ended:
        return _Ranking(drawn, "", f"no order of {name} can be built; {why}")
    how = f"not proven best: the best of {len(drawn)} orders drawn at random; {limit}"
    return _Ranking(drawn, how, f"no order of {name} was found: {limit} (PlannerOptions.labels); {why}")


def _check_final(assembly: Assembly, orders: Orders) -> None:
    everything = frozenset(range(len(assembly.pieces)))
    final = orders.holds.judge(everything)
    if final.stands:
        return
    saved = [
        assembly.names[k] for k in sorted(everything) if orders.holds.judge(everything, frozenset({k})).stands
    ]
    hint = f"holding {' or '.join(saved)} would keep it up" if saved else "no single hold would keep it up"
    raise InputError(
        assembly.name,
        f"the finished assembly is not stable: it {final.reason}, and must resist more than {TIE:g} g; "
        f"{hint}",
    )


def _steps(
    orders: Orders, order: tuple[int, ...], held: tuple[Placed, ...], done: tuple[PlanStep, ...]
) -> tuple[PlanStep, ...]:
    """Steps of an order with its holds; those that are done stay, but for what is held after the last.

    Raises _RefusedHold."""
    qualities, assembly = orders.q, orders.q.assembly
    steps = list(done[:-1])
    for k, piece in list(enumerate(order))[len(steps) :]:
        before, placed = frozenset(order[:k]), frozenset(order[: k + 1])
        upcoming = order[k + 1] if k + 1 < len(order) else None
        state = qualities.stability(placed, held[k])
        in_hand = {piece} | (held[k - 1] if k else frozenset())
        if k < len(done):
            in_hand = set()
        holds = [_hold(orders, placed, j, upcoming, state.verdict, j not in in_hand) for j in sorted(held[k])]
        if k < len(done):
            after = replace(done[k], holds=tuple(holds), verdict=state.verdict, margin=state.margin)
            steps.append(replace(after, margin_sides=state.margin_sides))
            continue
        way = qualities.assemblability(piece, before)
        assert way.direction is not None
        bearing = qualities.bearing(before, held[k - 1] if k else NOTHING, piece)
        steps.append(
            PlanStep(
                piece=assembly.names[piece],
                direction=rounded(way.direction),
                way=way_length(assembly, piece, way.direction),
                type=way.type,
                bears=min(round(bearing.force, 6), LARGEST),
                borne=min(bearing.margin, 1.0),
                pressed=assembly.names[bearing.piece] if bearing.margin < 1.0 else "",
                grasps=tuple(int(i) for i in qualities.candidates(piece, before)),
                holds=tuple(holds),
                verdict=state.verdict,
                margin=state.margin,
                margin_sides=state.margin_sides,
            )
        )
    return tuple(steps)


def _hold(
    orders: Orders, placed: Placed, piece: int, upcoming: int | None, verdict: str, taken: bool
) -> Hold:
    """A hold with the certificate of the best of some of its grasps. Raises _RefusedHold where none can take
    the load."""
    qualities, assembly = orders.q, orders.q.assembly
    direction = None if upcoming is None else qualities.assemblability(upcoming, placed).direction
    indices, table = qualities.assisting(piece, placed, upcoming, direction), qualities.grasps(piece)
    load = qualities.options.load
    firmest = indices[np.argsort(-table.contact[indices], kind="stable")]
    best: tuple[HoldCertificate, int] | None = None
    for few in (firmest[:CERTIFIED], firmest[CERTIFIED:]):
        for index in few:
            certificate = certify_hold(
                assembly, qualities.hands.kinds[table.kinds[index]], placed, piece,
                assembly.goals[piece] @ table.Ts_piece_tcp[index],
                "dropped" if verdict in FIRM else "frictionless", upcoming, direction,
                load, float(table.contact[index]),
            )  # fmt: skip
            if best is None or certificate.margin > best[0].margin:
                best = certificate, int(index)
        if best is not None and best[0].margin >= SMALLEST_MARGIN:
            return Hold(assembly.names[piece], tuple(int(i) for i in indices), taken, best[1], best[0])
    orders.holds.refuse(placed, piece, upcoming)
    state = ", ".join(assembly.names[k] for k in sorted(placed))
    margin = 0.0 if best is None else best[0].margin
    raise _RefusedHold(
        f"holding {assembly.names[piece]} in {{{state}}}: the best of {len(indices)} grasps takes "
        f"{margin:.2f} x the load "
        f"({load.push:g} N of the next insertion, {load.disturbance:g} g sideways), and must take "
        f"{SMALLEST_MARGIN:g} x"
    )


def _table(qualities: Qualities, piece: int) -> GraspTable:
    grasps = qualities.grasps(piece)
    poses = np.hstack(to_quat_xyzw(grasps.Ts_piece_tcp))
    return GraspTable(
        qualities.assembly.names[piece],
        np.round(poses, 9) + 0.0,
        np.round(grasps.widths, 9),
        grasps.contact,
        grasps.kinds,
    )
