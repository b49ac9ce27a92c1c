"""Orders: scores, held sets and ties."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from blocks import assembly, box

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.errors import InputError
from soma_bullet.grasp.hand import Hand
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.grasp.options import SamplingOptions
from soma_bullet.planner.analyzers import Judgement
from soma_bullet.planner.assemblability import Assemblability
from soma_bullet.planner.equilibrium import StateStability
from soma_bullet.planner.holds import PUSH
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.orders import Orders
from soma_bullet.planner.plan import NoPlanError, make_plan
from soma_bullet.planner.pushes import Bearing
from soma_bullet.planner.qualities import Qualities
from soma_bullet.planner.search import NOTHING, follow, score_of

ROBUST, LEANING, FALLS = (
    StateStability("robust", 0.5, 0.5),
    StateStability("clearance-dependent", 0.0, 0.3),
    StateStability("unstable", 0.0, 0.0),
)


@dataclass
class Table:
    """Qualities as they are told: letters of the placed, a slash, letters of the held -> state.

    What is not told is as good as with fewer pieces held, and falls where nothing is told.
    """

    states: dict[str, StateStability]
    hands: int = 2
    ungraspable: set[tuple[str, str]] = field(default_factory=set)  # (held, next piece)
    pushed: dict[tuple[str, str], str] = field(default_factory=dict)  # what the next piece pushes
    asked: list[Any] = field(default_factory=list)

    @property
    def assembly(self) -> Any:
        return SimpleNamespace(names=tuple("abcd"))

    @property
    def options(self) -> PlannerOptions:
        return PlannerOptions(hands=self.hands)

    def stability(self, placed: frozenset[int], held: frozenset[int] = NOTHING) -> StateStability:
        name = "/".join("".join("abcd"[k] for k in sorted(s)) for s in (placed, held & placed))
        if held >= placed or name in self.states:
            return self.states.get(name, ROBUST)
        fewer = [self.stability(placed, (held & placed) - {k}) for k in held & placed]
        return max(fewer, key=lambda state: (state.verdict != "unstable", state.quality), default=FALLS)

    def assemblability(self, piece: int, placed: frozenset[int]) -> Assemblability:
        return Assemblability("plane", 1.0, np.array((0.0, 0.0, -1.0)))

    def bearing(self, placed: frozenset[int], held: frozenset[int], piece: int) -> Bearing:
        weak = ("".join("abcd"[k] for k in sorted(placed)), "abcd"[piece])
        strong = weak not in self.pushed or any("abcd"[k] == self.pushed[weak] for k in held)
        return Bearing(1.0, 1.0) if strong else Bearing(0.1, 0.25, "abcd".index(self.pushed[weak]))

    def graspability(self, piece: int, placed: frozenset[int]) -> int:
        return 10 + piece

    def together(self, held: frozenset[int], *_: Any) -> bool:
        return True

    def accessible(self, piece: int, placed: frozenset[int]) -> list[int]:
        return [0]

    def can_assist(self, *question: Any) -> bool:
        return bool(self.assisting(*question))

    def assisting(
        self, piece: int, placed: frozenset[int], upcoming: int | None, direction: Any
    ) -> list[int]:
        return [] if upcoming is not None and ("abcd"[piece], "abcd"[upcoming]) in self.ungraspable else [0]


def held(table: Table, order: str) -> tuple[list[str], str]:
    """What is held after each step as far as the order goes, and what fails."""
    orders = Orders(table, frozenset({PUSH}))  # type: ignore[arg-type]
    indices = tuple("abcd".index(p) for p in order)
    followed = follow(orders.supports, indices)
    reason = "" if followed.complete else orders.support_fault(indices, len(followed.holds[2])).reason
    return ["".join("abcd"[k] for k in sorted(s)) for s in followed.holds[2]], reason


def test_score_is_the_product_of_the_smallest() -> None:
    assert score_of((0.2, 3.0, 0.1)) == pytest.approx(0.2 * 3 * 0.1)


@pytest.mark.parametrize(
    ("minima", "score"),
    [
        ((2.0, 3, math.inf), math.inf),
        ((math.inf, 0, 10.0), 0.0),
        ((0.0, 5, math.inf), 0.0),
        ((math.inf, 5, 0.0), 0.0),
        ((0.5, 2, 10.0), 10.0),
    ],
)
def test_infinity_times_zero_is_zero(minima: tuple[float, ...], score: float) -> None:
    assert score_of(minima) == score


def test_nothing_is_held_that_stands() -> None:
    table = Table({"a/": ROBUST, "ab/": ROBUST, "abc/": ROBUST})
    assert held(table, "abc") == (["", "", ""], "")


def test_the_smallest_held_set_comes_before_its_margin() -> None:
    better = StateStability("robust", 5.0, 5.0)
    table = Table({"a/": ROBUST, "ab/": LEANING, "ab/a": better, "abc/": ROBUST})
    assert held(table, "abc") == (["", "", ""], "")


def test_a_hold_goes_on_rather_than_being_taken_up_again() -> None:
    table = Table({"ab/": ROBUST, "abc/a": ROBUST, "abcd/": ROBUST})
    assert held(table, "abcd") == (["a", "a", "a", ""], "")


def test_robust_comes_before_leaning() -> None:
    table = Table({"a/": ROBUST, "ab/a": LEANING, "ab/b": ROBUST, "abc/": ROBUST})
    assert held(table, "abc") == (["", "b", ""], "")


def test_the_hand_that_is_there_stays() -> None:
    """Either piece could be held after the second step: the one that the hand holds already."""
    for first in "ab":
        table = Table({f"ab/{name}": ROBUST for name in "ab"} | {"abc/": ROBUST})
        assert held(table, first + ("b" if first == "a" else "a") + "c") == ([first, first, ""], "")


def test_a_hand_changes_pieces_while_the_other_keeps_the_state() -> None:
    """a is held first, b must be held next: the hand that inserts b is on it already."""
    table = Table({"ab/b": ROBUST, "ab/ab": ROBUST, "abc/": ROBUST})
    assert held(table, "abc") == (["a", "b", ""], "")


def test_a_hand_does_not_let_go_of_what_would_fall() -> None:
    """After c, only a may be held, and nothing keeps the state while a hand goes from b to a."""
    states = {"ab/b": ROBUST, "abc/a": ROBUST, "abcd/": ROBUST, "abc/bc": ROBUST}
    sets, reason = held(Table(states), "abcd")
    assert "{a, b, c} falls" in reason
    assert sets == ["a", "b"]
    # with c alone keeping it for the while, the other hand can go over
    states |= {"abc/c": ROBUST}
    assert held(Table(states), "abcd") == (["a", "b", "c", ""], "")
    assert held(Table(states, ungraspable={("c", "d")}), "abcd") == (["a", "b", "a", ""], "")


def test_in_the_end_nothing_is_held() -> None:
    sets, reason = held(Table({"ab/a": ROBUST, "abc/a": ROBUST}), "abc")
    assert "falls" in reason and "the end" in reason
    assert sets == ["a", "a"]


def test_a_hand_that_the_next_piece_would_hit_does_not_hold() -> None:
    states = {"ab/a": ROBUST, "ab/b": ROBUST, "abc/": ROBUST}
    assert held(Table(states), "abc")[0] == ["a", "a", ""]
    assert held(Table(states, ungraspable={("a", "c")}), "abc")[0] == ["a", "b", ""]
    assert "before c" in held(Table(states, ungraspable={("a", "c"), ("b", "c")}), "abc")[1]


def test_one_hand_cannot_hold_and_insert() -> None:
    table = Table({"ab/": ROBUST, "abc/": ROBUST}, hands=1)
    assert "there is no hand to spare" in held(table, "abc")[1]
    assert held(replace(table, states=table.states | {"a/": ROBUST}), "abc") == (["", "", ""], "")


def test_steps_that_orders_share_agree() -> None:
    """The held sets of an order are the best among all paths, by brute force over the moves."""
    rng = np.random.default_rng(0)
    for _ in range(40):
        names = ["a", "b", "ab", "ac", "bc", "abc", "ad", "bd", "cd", "abd", "acd", "bcd"]
        states = {
            f"{p}/{h}": (ROBUST, LEANING, FALLS)[rng.integers(3)] for p in names for h in ("", *p, *_pairs(p))
        }
        orders = Orders(Table(states | {"abcd/": ROBUST}), frozenset({PUSH}))  # type: ignore[arg-type]
        for order in ((0, 1, 2, 3), (2, 0, 3, 1)):
            followed = follow(orders.supports, order)
            paths = list(_paths(orders, order, 0, NOTHING))
            assert bool(paths) == followed.complete
            if paths:
                assert _cost(orders, order, followed.holds[2]) == min(
                    _cost(orders, order, path) for path in paths
                )


def test_a_hand_that_is_not_needed_adds_nothing() -> None:
    """Two hands to spare: the second hold would make the state better, but the first suffices."""
    better = StateStability("robust", 5.0, 5.0)
    table = Table({"ab/a": ROBUST, "ab/ab": better, "ab/b": LEANING, "abc/": ROBUST}, hands=3)
    assert held(table, "abc") == (["a", "a", ""], "")
    holds = Orders(table, frozenset({PUSH})).holds  # type: ignore[arg-type]
    assert holds.judge(frozenset({0, 1}), frozenset({0, 1})).quality == 0.5
    assert holds.judge(frozenset({0, 1}), frozenset({1})).quality == LEANING.quality


def test_more_hands_hold_more_pieces() -> None:
    states = {"ab/ab": ROBUST, "abc/": ROBUST}
    assert "falls" in held(Table(states), "abc")[1]
    assert held(Table(states, hands=3), "abc") == (["a", "ab", ""], "")
    assert "{a, b} falls" in held(Table(states, hands=3, ungraspable={("a", "c")}), "abc")[1]


def _pairs(names: str) -> list[str]:
    return [a + b for a in names for b in names if a < b]


def _paths(orders: Orders, order: tuple[int, ...], k: int, before: frozenset[int]) -> Any:
    if k == len(order):
        yield []
        return
    upcoming = order[k + 1] if k + 1 < len(order) else None
    for support in orders.supports(frozenset(order[:k]), order[k], before, upcoming):
        for rest in _paths(orders, order, k + 1, support.held):
            yield [support.held, *rest]


def _cost(orders: Orders, order: tuple[int, ...], sets: Sequence[frozenset[int]]) -> tuple[float, ...]:
    states = [orders.holds.judge(frozenset(order[: k + 1]), kept) for k, kept in enumerate(sets)]
    steps = list(zip(order, [NOTHING, *sets], sets, strict=False))
    again = sum(len(kept - before - {piece}) for piece, before, kept in steps)
    changes = sum(len(kept - before) for _, before, kept in steps)
    leaning = sum(state.verdict == "clearance-dependent" for state in states)
    return -min(state.quality for state in states), again, sum(map(len, sets)), leaning, changes


@pytest.fixture(scope="module")
def twins() -> Assembly:
    """Two equal cubes that do not touch: either first."""
    cube = [box((0.02,) * 3, name) for name in ("one", "two")]
    return assembly(cube, [(0, 0, 0.01), (0.3, 0, 0.01)])


def test_ties_are_reported_and_picked_by_the_seed(twins: Assembly, hand: Hand) -> None:
    picked = {}
    for seed in range(6):
        plan = make_plan(twins, HandSet.alike(hand), PlannerOptions(seed=seed))
        assert set(plan.ties) == {("one", "two"), ("two", "one")}
        assert plan.order == make_plan(twins, HandSet.alike(hand), PlannerOptions(seed=seed)).order
        picked[seed] = plan.order
    assert len(set(picked.values())) == 2


ALONE = PlannerOptions(hands=1, sampling=SamplingOptions(spacing=0.02, rolls=4))


def nine_cubes(first: float = 0.02) -> Assembly:
    """Nine cubes far apart, the first of another size [m]: any order can be built."""
    cubes = [box((first if k == 0 else 0.02,) * 3, f"cube{k}") for k in range(9)]
    return assembly(cubes, [(0.1 * (k % 3), 0.1 * (k // 3), first / 2 if k == 0 else 0.01) for k in range(9)])


def never_complete(qualities: Qualities, placed: frozenset[int], piece: int) -> Judgement:
    """An analyzer that nothing tells before the last piece."""
    return Judgement(0.0, "would be the last") if len(placed) == 8 else Judgement(1.0)


@pytest.mark.slow
def test_a_search_that_reaches_its_limit_says_so(hand: Hand) -> None:
    """Which order of the cubes is best takes more labels than are allowed."""
    apart, hands = nine_cubes(), HandSet.alike(hand)
    full = make_plan(apart, hands, ALONE)
    assert full.optimality.startswith("exact: a search over subsets with ")
    needed = int(full.optimality.split(" labels")[0].split()[-1])
    cut = make_plan(apart, hands, replace(ALONE, labels=needed // 2))
    assert cut.optimality.startswith("not proven best: ")
    assert f"its limit of {needed // 2} labels" in cut.optimality
    assert sorted(cut.order) == sorted(apart.names) and 0 < cut.score <= full.score
    nearly = make_plan(apart, hands, replace(ALONE, labels=needed - 1))
    assert nearly.score == full.score and nearly.optimality.startswith("exact for the best ")


@pytest.mark.slow
def test_no_order_within_the_limit_is_a_reason(hand: Hand) -> None:
    """Where nothing was found it matters whether everything was looked at."""
    apart, hands = nine_cubes(), HandSet.alike(hand)
    limited = replace(ALONE, analyzers=(f"{__name__}:never_complete",), labels=500)
    message = r"no order of test was found: .* limit of 500 labels \(PlannerOptions.labels\); what rules out"
    with pytest.raises(NoPlanError, match=message) as caught:
        make_plan(apart, hands, limited)
    assert all("would be the last" in reason for reason in caught.value.reasons)
    with pytest.raises(NoPlanError, match="no order of test can be built; what rules out 200 orders"):
        make_plan(nine_cubes(first=hand.opening), hands, ALONE)
    with pytest.raises(InputError, match=r"--labels 0"):
        make_plan(apart, hands, PlannerOptions(labels=0))


def test_a_single_piece_has_no_tie(hand: Hand) -> None:
    plan = make_plan(assembly([box((0.02,) * 3, "one")], [(0, 0, 0.01)]), HandSet.alike(hand))
    assert plan.order == ("one",) and plan.ties == () and plan.steps[0].holds == ()


def test_four_blocks_in_paper_mode(hand: Hand) -> None:
    """The Z is unstable when it is placed and the L restabilises it; V, Z, A, L scores within a per cent."""
    plan = make_plan(load_assembly("soma4"), HandSet.alike(hand), PlannerOptions(stability="paper"))
    assert plan.order in (("V", "Z", "L", "A"), ("V", "Z", "A", "L"))
    rows = {row.order: row for row in plan.orders}
    best, other = rows["V", "Z", "L", "A"], rows["V", "Z", "A", "L"]
    assert best.held == ((), ("Z",), (), ())
    assert other.score == pytest.approx(best.score, rel=0.02)
    assert not any(row.stable_throughout and row.feasible for row in plan.orders)
    assert sum(all(len(h) <= 1 for h in row.held) for row in plan.orders) == 16
    assert [tuple(h.piece for h in step.holds) for step in plan.steps] == [(), ("Z",), (), ()]
