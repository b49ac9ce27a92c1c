"""Two arms with different hands: a grasp is that of its own hand, and two at once are those of two arms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from blocks import assembly, box
from manifold3d import Manifold

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import Array
from soma_bullet.grasp.clearance import MARGIN, hand_hulls, hands_clear, sweep_hand
from soma_bullet.grasp.hand import Hand
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.grasp.options import SamplingOptions
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.options import HoldLoad, PlannerOptions
from soma_bullet.planner.plan import NoPlanError, make_plan
from soma_bullet.planner.qualities import Qualities
from soma_bullet.planner.ways import way_length
from soma_bullet.records import to_tree
from soma_bullet.robot.cell import load_cell

ROOT = Path(__file__).resolve().parents[2]
SLIM, SMALL = 0, 1
DOWN = np.array((0.0, 0.0, -1.0))
CORNERS = np.sqrt(3)  # a gap along the best axis is at most this much smaller than the distance


@pytest.fixture(scope="module")
def hands() -> HandSet:
    return load_cell(ROOT / "tests/data/mixed_pair").hands


@pytest.fixture(scope="module")
def soma4() -> Assembly:
    return load_assembly("soma4")


@pytest.fixture(scope="module")
def mixed(soma4: Assembly, hands: HandSet) -> AssemblyPlan:
    return make_plan(soma4, hands)


def pillars(width: float, hold: float = 0.018) -> tuple[Assembly, int, int]:
    """A pillar of width `hold` [m] beside which one of `width` [m] goes in, both from above; their indices.

    They are too deep to be gripped any other way than across their width."""
    first, second = box((hold, 0.08, 0.05), "first"), box((width, 0.08, 0.05), "second")
    return assembly([first, second], [(0, 0, 0.025), (0.16, 0, 0.025)]), 0, 1


def test_the_plan_tells_whose_hand_is_whose(mixed: AssemblyPlan, hands: HandSet) -> None:
    assert (mixed.hands, mixed.hand_kinds) == (("slim_hand", "small_hand"), (SLIM, SMALL))
    assert mixed.named_hands == "slim_hand and small_hand"
    assert all(set(table.kinds.tolist()) == {SLIM, SMALL} for table in mixed.grasps)


def test_every_grasp_is_within_its_own_hand(mixed: AssemblyPlan, hands: HandSet) -> None:
    room = 2 * SamplingOptions().opening_margin
    for table in mixed.grasps:
        for kind, hand in enumerate(hands.kinds):
            assert table.widths[table.kinds == kind].max() <= hand.opening - room
    widest = [
        max(table.widths[table.kinds == kind].max() for table in mixed.grasps) for kind in (SLIM, SMALL)
    ]
    assert widest[SLIM] > hands.kinds[SMALL].opening  # else nothing was shown
    assert 0 < widest[SMALL]


def test_a_table_holds_the_tables_of_the_kinds_one_after_the_other(
    soma4: Assembly, mixed: AssemblyPlan, hands: HandSet
) -> None:
    alone = [Qualities(soma4, HandSet.alike(hand), PlannerOptions()) for hand in hands.kinds]
    both = Qualities(soma4, hands, PlannerOptions())
    for piece in range(4):
        grasps = [judge.grasps(piece) for judge in alone]
        table = both.grasps(piece)
        assert table.kinds.tolist() == [SLIM] * len(grasps[SLIM]) + [SMALL] * len(grasps[SMALL])
        for name in ("Ts_piece_tcp", "widths", "contact"):
            parts = [getattr(one, name) for one in grasps]
            np.testing.assert_array_equal(getattr(table, name), np.concatenate(parts))


def test_g_counts_the_grasps_of_all_hands(soma4: Assembly, mixed: AssemblyPlan, hands: HandSet) -> None:
    """Also in the plan's matrices."""
    alone = [Qualities(soma4, HandSet.alike(hand), PlannerOptions()) for hand in hands.kinds]
    both = Qualities(soma4, hands, PlannerOptions())
    for order in permutations(range(4), 3):
        placed, piece = frozenset(order[1:]), order[0]
        first, second = (judge.candidates(piece, placed) for judge in alone)
        expected = [*first, *(second + len(alone[SLIM].grasps(piece)))]
        assert both.candidates(piece, placed).tolist() == expected
    for row in mixed.orders:
        sets = [frozenset(soma4.index(name) for name in row.order[:k]) for k in range(4)]
        assert row.g == tuple(
            sum(judge.graspability(soma4.index(name), placed) for judge in alone)
            for name, placed in zip(row.order, sets, strict=True)
        )


@pytest.mark.parametrize("name", ["soma3", pytest.param("leaning_bridge", marks=pytest.mark.slow)])
def test_hands_that_are_alike_are_one(name: str, hand: Hand) -> None:
    whole = load_assembly(name)
    twice = HandSet.of([hand, replace(hand)])
    assert to_tree(make_plan(whole, twice)) == to_tree(make_plan(whole, HandSet.alike(hand)))


def test_a_hold_leaves_room_for_the_hand_of_another_arm(
    soma4: Assembly, mixed: AssemblyPlan, hands: HandSet
) -> None:
    """Grasp by grasp: a holding hand of one kind takes an inserting one of the other that is clear of it."""
    judge = Qualities(soma4, hands, PlannerOptions())
    seen = 0
    for k, step in enumerate(mixed.steps[:-1]):
        placed = frozenset(soma4.index(other.piece) for other in mixed.steps[: k + 1])
        upcoming, direction = soma4.index(mixed.steps[k + 1].piece), np.array(mixed.steps[k + 1].direction)
        way = direction * way_length(soma4, upcoming, direction)
        arriving = [
            swept(soma4, hands.kinds[kind], judge, upcoming, [i for i in mixed.steps[k + 1].grasps
                  if judge.grasps(upcoming).kinds[i] == kind], sweep=-way)
            for kind in (SLIM, SMALL)
        ]  # fmt: skip
        for hold in step.holds:
            piece = soma4.index(hold.piece)
            kinds = judge.grasps(piece).kinds
            left = judge._clear_of_way(piece, placed, upcoming, way)
            for index in left:
                holding = swept(soma4, hands.kinds[kinds[index]], judge, piece, [int(index)], way_out=0.0)
                clear = hands_clear(holding, arriving[1 - kinds[index]]).any()
                assert clear == (index in hold.grasps)
                seen += 1
    assert seen > 50


def swept(whole: Assembly, hand: Hand, judge: Qualities, piece: int, indices: list[int], **how: Any) -> Any:
    chosen = judge.grasps(piece).take(np.array(indices, int))
    return sweep_hand(hand, whole.goals[piece] @ chosen.Ts_piece_tcp, chosen.widths, **how)


def test_two_pieces_for_the_same_hand_cannot_be_handled_at_once(hands: HandSet) -> None:
    """Pieces that only the slim hand can grip: one such hand holds the one or brings the other."""
    slim, small = hands.kinds
    wide, first, second = pillars(width=0.04, hold=0.04)
    narrow, _, _ = pillars(width=0.018, hold=0.04)
    placed = frozenset({first})
    for whole, pair, expected in (
        (wide, HandSet.alike(slim), True),
        (wide, hands, False),
        (wide, HandSet.of([slim, small, slim]), True),
        (narrow, hands, True),
        (narrow, HandSet.alike(small), False),
    ):
        judge = Qualities(whole, pair, PlannerOptions())
        assert judge.can_assist(first, placed, second, DOWN) == expected
        assert bool(len(judge.assisting(first, placed, second, DOWN))) == expected
    # narrow beside wide: what holds is slim, and what inserts small
    judge = Qualities(narrow, hands, PlannerOptions())
    assert set(judge.grasps(first).kinds) == {SLIM} and set(judge.grasps(second).kinds) == {SLIM, SMALL}


@pytest.mark.slow
def test_hands_beyond_the_arms_are_like_theirs_in_turn(hands: HandSet) -> None:
    wide, first, second = pillars(width=0.04, hold=0.04)
    for count, expected in ((1, False), (2, False), (3, True)):
        judge = Qualities(wide, hands, PlannerOptions(hands=count))
        assert judge.can_assist(first, frozenset({first}), second, DOWN) == expected


def test_several_holding_hands_are_those_of_several_arms(hands: HandSet) -> None:
    """Two wide pieces held while a third comes: two slim hands, and any for the third."""
    slim, small = hands.kinds
    wide = [box((0.04, 0.08, 0.05), name) for name in ("first", "second")]
    whole = assembly([*wide, box((0.018, 0.08, 0.05), "third")], [(x, 0, 0.025) for x in (0.0, 0.2, 0.4)])
    held, options = frozenset({0, 1}), PlannerOptions(hands=3)
    for given, expected in (
        ([slim, slim, slim], True),
        ([slim, small, slim], True),
        ([slim, small, small], False),
    ):
        judge = Qualities(whole, HandSet.of(given), options)
        assert judge.together(held, held, 2, DOWN) == expected
        assert all(len(judge.assisting(piece, held, 2, DOWN)) for piece in held)  # each alone can be held


def test_a_certificate_is_that_of_the_grasps_own_hand(
    mixed: AssemblyPlan, hands: HandSet, soma4: Assembly
) -> None:
    tables = {table.piece: table for table in mixed.grasps}
    holds = [hold for step in mixed.steps for hold in step.holds]
    assert holds
    for hold in holds:
        hand = hands.kinds[tables[hold.piece].kinds[hold.grasp]]
        friction = np.sqrt(soma4.pieces[soma4.index(hold.piece)].friction * hand.pad_friction)
        assert hold.certificate.grip_force == hand.grip_force
        assert hold.certificate.friction == pytest.approx(friction)


@pytest.mark.parametrize("names", [("slim", "weak"), ("weak", "slim")])
def test_of_two_hands_that_differ_in_force_each_counts_with_its_own(
    names: tuple[str, str], soma4: Assembly, hand: Hand
) -> None:
    """The same geometry at half the force: a grasp's margin is that of the same grasp by that hand alone."""
    given = {"slim": hand, "weak": replace(hand, name="weak_hand", grip_force=hand.grip_force / 2)}
    alone = {name: margins(soma4, HandSet.alike(one)) for name, one in given.items()}
    ratios = [weak / slim for weak, slim in zip(alone["weak"], alone["slim"], strict=True)]
    assert all(0.4 < ratio < 0.52 for ratio in ratios)
    # the grasps of the first kind are certified first, and take the load
    assert margins(soma4, HandSet.of([given[name] for name in names])) == alone[names[0]]


def margins(whole: Assembly, hands: HandSet) -> list[float]:
    plan = make_plan(whole, hands, PlannerOptions(load=HoldLoad(push=2.0, disturbance=0.0)))
    return [hold.certificate.margin for step in plan.steps for hold in step.holds]


@pytest.mark.slow
def test_what_the_weak_hand_cannot_hold_the_strong_one_does(soma4: Assembly, hand: Hand) -> None:
    """A push between what the two can take: the hold falls to the strong hand, though it is the second."""
    weak = replace(hand, name="weak_hand", grip_force=hand.grip_force / 10)
    options = PlannerOptions(load=HoldLoad(push=6.0))
    plan = make_plan(soma4, HandSet.of([weak, hand]), options)
    tables = {table.piece: table for table in plan.grasps}
    holds = [hold for step in plan.steps for hold in step.holds]
    assert holds and all(tables[hold.piece].kinds[hold.grasp] == 1 for hold in holds)
    assert all(hold.certificate.margin >= 1.0 for hold in holds)
    with pytest.raises(NoPlanError, match="holding Z"):
        make_plan(soma4, HandSet.alike(weak), options)


def test_holding_hands_are_as_wide_as_they_are_open(soma4: Assembly, hands: HandSet) -> None:
    """Against the distance of bodies: a holding hand at its own width, and the other hand along its way in.

    A hand that counted as wider or narrower would lose or win grasps."""
    judge = Qualities(soma4, hands, PlannerOptions())
    piece, placed, upcoming = (
        soma4.index("Z"),
        frozenset({soma4.index("V"), soma4.index("Z")}),
        soma4.index("A"),
    )
    direction = judge.assemblability(upcoming, placed).direction
    assert direction is not None
    way = direction * way_length(soma4, upcoming, direction)
    holding, inserting = judge._clear_of_way(piece, placed, upcoming, way), judge.candidates(upcoming, placed)
    some, few = holding[:: max(1, len(holding) // 12)], inserting[:: max(1, len(inserting) // 12)]
    clear = judge._beside(piece, some, upcoming, few, way)
    tables = judge.grasps(piece), judge.grasps(upcoming)
    gaps = np.empty(clear.shape)
    for row, i in enumerate(some):
        hold = bodies(soma4, hands, judge, piece, int(i), lambda T, back: [T])
        for column, j in enumerate(few):
            comes = bodies(
                soma4, hands, judge, upcoming, int(j),
                lambda T, back: [shifted(T, by) for by in (0 * way, -way, -0.06 * back, -way - 0.06 * back)],
            )  # fmt: skip
            gaps[row, column] = min(one.min_gap(other, 10.0) for one in hold for other in comes) * 1e-3
    other = tables[0].kinds[some][:, None] != tables[1].kinds[few]
    assert gaps[clear].min() > MARGIN - 1e-6
    assert gaps[~clear & other].max(initial=0.0) < CORNERS * MARGIN
    assert clear[other].any() and not clear[other].all() and not clear[~other].any()


def shifted(T: Array, by: Array) -> Array:
    moved = np.array(T)
    moved[:3, 3] += by
    return moved


def bodies(
    whole: Assembly, hands: HandSet, judge: Qualities, piece: int, index: int,
    places: Callable[[Array, Array], list[Array]],
) -> list[Manifold]:  # fmt: skip
    """Convex bodies [mm] of a hand's boxes over some places, from its width to 8 mm more."""
    grasps = judge.grasps(piece)
    T, width = whole.goals[piece] @ grasps.Ts_piece_tcp[index], float(grasps.widths[index])
    hand = hands.kinds[grasps.kinds[index]]
    hulls = [
        hand_hulls(hand, place, opened) for place in places(T, T[:3, 2]) for opened in (width, width + 0.008)
    ]
    return [
        Manifold.hull_points(np.vstack([hull.vertices for hull in same]) * 1e3)
        for same in zip(*hulls, strict=True)
    ]
