"""What insertions do to placed pieces, by hand calculation; and what the planner makes of it."""

from __future__ import annotations

import numpy as np
import pytest
from blocks import assembly, box, cells
from hypothesis import given
from hypothesis import strategies as st

from soma_bullet.assembly.model import Assembly
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.grasp.hand import Hand
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.planner.assist import GRAVITY
from soma_bullet.planner.holds import AIR, PUSH
from soma_bullet.planner.options import HoldLoad, PlannerOptions
from soma_bullet.planner.orders import Orders
from soma_bullet.planner.plan import make_plan
from soma_bullet.planner.programs import LARGEST
from soma_bullet.planner.pushes import Pushes
from soma_bullet.planner.qualities import Qualities

SIDE = 0.02  # [m]
ALONG = np.array((-1.0, 0.0, 0.0))
DOWN = np.array((0.0, 0.0, -1.0))
NOTHING: frozenset[int] = frozenset()
CALM = HoldLoad(disturbance=0.0)


def cube(name: str, **options: float) -> Workpiece:
    """A cube about its origin."""
    return box((SIDE, SIDE, SIDE), name, **options)


def beside(density: float = 1000.0) -> Assembly:
    """A cube on the support, and one that comes beside it."""
    wall, comes = cube("wall", density=density), cube("comes")
    return assembly([wall, comes], [(0, 0, SIDE / 2), (SIDE, 0, SIDE / 2)])


@given(st.floats(100.0, 8000.0))
def test_a_free_piece_bears_its_weight_times_friction_sideways(density: float) -> None:
    whole = beside(density)
    weight = whole.pieces[0].mass * GRAVITY
    found = Pushes(whole, CALM).bearing(frozenset({0}), NOTHING, 1, ALONG)
    assert found.force == pytest.approx(0.5 * weight, rel=0.03)  # twelve-sided pyramid
    assert found.piece == 0 and not found.rubbed
    assert found.margin == pytest.approx(found.force / whole.sizes.touch, rel=1e-3)
    swaying = Pushes(whole, HoldLoad(disturbance=0.1)).bearing(frozenset({0}), NOTHING, 1, ALONG)
    assert swaying.force == pytest.approx(0.4 * weight, rel=0.03)


def test_what_stands_on_it_counts_and_a_hand_bears_all() -> None:
    wall, top, comes = cube("wall"), cube("top"), cube("comes")
    whole = assembly([wall, top, comes], [(0, 0, SIDE / 2), (0, 0, 1.5 * SIDE), (SIDE, 0, SIDE / 2)])
    pushes, weight = Pushes(whole, CALM), whole.pieces[0].mass * GRAVITY
    assert pushes.bearing(frozenset({0, 1}), NOTHING, 2, ALONG).force == pytest.approx(weight, rel=0.03)
    assert pushes.bearing(frozenset({0, 1}), frozenset({0}), 2, ALONG).force == LARGEST


def test_what_leans_on_another_piece_bears_with_it() -> None:
    pieces = [cube("first"), cube("second"), cube("comes")]
    whole = assembly(pieces, [(0, 0, SIDE / 2), (-SIDE, 0, SIDE / 2), (SIDE, 0, SIDE / 2)])
    pushes, weight = Pushes(whole, CALM), whole.pieces[0].mass * GRAVITY
    one = pushes.bearing(frozenset({0}), NOTHING, 2, ALONG).force
    assert one == pytest.approx(0.5 * weight, rel=0.03)
    assert pushes.bearing(frozenset({0, 1}), NOTHING, 2, ALONG).force == pytest.approx(2 * one, rel=0.01)


def test_a_plank_tips_about_its_post() -> None:
    """Pressed down at its end, beyond the post's edge, it turns about that edge."""
    post, plank, comes = cube("post"), box((5 * SIDE, SIDE, SIDE / 2), "plank"), cube("comes")
    places = [(0, 0, SIDE / 2), (0, 0, 1.25 * SIDE), (2 * SIDE, 0, 2 * SIDE)]
    whole = assembly([post, plank, comes], places)
    found = Pushes(whole, CALM).bearing(frozenset({0, 1}), NOTHING, 2, DOWN)
    weight = whole.pieces[1].mass * GRAVITY
    assert found.force == pytest.approx(weight * (SIDE / 2) / (1.5 * SIDE), rel=1e-3)


def test_straight_down_is_rubbing_only() -> None:
    found = Pushes(beside(), CALM).bearing(frozenset({0}), NOTHING, 1, DOWN)
    assert found.force == LARGEST and found.borne


def test_a_piece_comes_down_beside_what_it_would_push_away(hand: Hand) -> None:
    """The widest way into a corner is the slant; of a light wall it is straight down."""
    heavy, light = (
        Qualities(beside(density), HandSet.alike(hand), PlannerOptions()) for density in (2e5, 1000.0)
    )
    slant = heavy.assemblability(1, frozenset({0}))
    assert slant.direction == pytest.approx(np.array((-1.0, 0.0, -1.0)) / np.sqrt(2))
    down = light.assemblability(1, frozenset({0}))
    assert light.bearing(frozenset({0}), NOTHING, 1).borne
    assert down.direction is not None and down.direction[2] < slant.direction[2]  # type: ignore[index]
    assert down.quality < slant.quality


def tunnelled() -> Assembly:
    """A drawer in a tunnel, up to a light wall that stands in it by itself. Into the tunnel it goes level."""
    sides = [(x, y, 0) for x in (-1, 0, 1) for y in (-1, 1)]
    tunnel = cells([*sides, *((x, y, 1) for x in (-1, 0, 1) for y in (-1, 0, 1))], "tunnel", SIDE)
    return assembly(
        [box((SIDE, SIDE, 0.8 * SIDE), "wall"), tunnel, box((4 * SIDE, SIDE, SIDE), "drawer")],
        [(-SIDE, 0, 0.4 * SIDE), (0, 0, SIDE / 2), (1.5 * SIDE, 0, SIDE / 2)],
    )


def test_an_order_that_pushes_something_away_is_ruled_out_where_there_is_another(hand: Hand) -> None:
    whole = tunnelled()
    orders = Orders(Qualities(whole, HandSet.alike(hand), PlannerOptions()), frozenset({PUSH}))
    last = orders.row([0, 1, 2])
    assert not last.feasible and "pushed apart: drawer presses on wall" in last.reason
    first = make_plan(whole, HandSet.alike(hand))
    assert first.order.index("drawer") < first.order.index("tunnel")
    assert not [text for text in first.warnings if "may move" in text]
    assert all(step.borne == 1.0 and step.pressed == "" for step in first.steps)


def test_where_no_other_order_is_left_it_is_taken_and_said(hand: Hand) -> None:
    whole = tunnelled()
    orders = [row.order for row in make_plan(whole, HandSet.alike(hand)).orders]
    at_last = [order for order in orders if order[-1] == "drawer"]
    plan = make_plan(whole, HandSet.alike(hand), excluded=frozenset(set(orders) - set(at_last)))
    step = next(step for step in plan.steps if step.piece == "drawer")
    assert step.pressed == "wall" and 0.0 < step.borne < 1.0 and step.bears < whole.sizes.touch
    assert any(text.startswith("drawer may move wall as it comes in") for text in plan.warnings)


def test_nothing_is_put_into_the_air_where_there_is_another_order(hand: Hand) -> None:
    below, above = cube("below"), cube("above")
    whole = assembly([below, above], [(0, 0, SIDE / 2), (0, 0, 1.5 * SIDE)])
    quality = Qualities(whole, HandSet.alike(hand), PlannerOptions())
    assert not Orders(quality, frozenset({AIR})).row([1, 0]).feasible
    assert make_plan(whole, HandSet.alike(hand)).order == ("below", "above")
