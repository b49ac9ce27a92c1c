"""Compliant insertion: slower against a resistance, aside with a force, and a spiral where the way is
blocked."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soma_bullet.control.guide import PATIENCE, Guide
from soma_bullet.control.options import Compliance
from soma_bullet.frames import Array

DT = 1 / 480
DOWN = np.array((0.0, 0.0, -1.0))


def blocked(newton: float, torque: float = 0.0) -> Array:
    """What pushes back against a hand that goes down, and turns it [N m] about the way down."""
    return np.concatenate([(0.0, 0.0, newton), torque * DOWN])


def test_free_motion_is_as_planned() -> None:
    guide = Guide(DOWN, Compliance())
    assert guide.update(np.zeros(6), DT) == 1.0
    assert not guide.offset.any() and not guide.searching and not guide.failed


@pytest.mark.parametrize(("newton", "speed"), [(0.5, 0.8), (2.5, 0.0), (5.0, -1.0), (-3.0, 1.0)])
def test_resistance_slows_down_and_turns_back(newton: float, speed: float) -> None:
    assert Guide(DOWN, Compliance(press=2.5)).update(blocked(newton), DT) == pytest.approx(speed)


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_it_yields_the_way_it_is_pushed(x: float, y: float) -> None:
    push, guide = np.array((x, y, 0.0, 0.0, 0.0, 0.0)), Guide(DOWN, Compliance())
    for _ in range(48):
        guide.update(push, DT)
    size = float(np.linalg.norm(push[:3]))
    expected = max(size - guide.compliance.dead, 0.0) * guide.compliance.give * 48 * DT
    assert np.linalg.norm(guide.offset) == pytest.approx(min(expected, guide.compliance.reach), abs=1e-9)
    assert float(guide.offset @ push[:3]) >= 0.0 and guide.offset[2] == 0.0


def test_every_search_covers_the_disc_with_the_piece_turned_another_way() -> None:
    rules = Compliance()
    guide, seen = Guide(DOWN, rules), []
    for _ in range(480 * 60):
        guide.update(blocked(2.0), DT)
        if guide.failed:
            break
        seen.append((*guide.offset, guide.twist))
    assert guide.failed == "not found"
    rows = np.array(seen)
    places, twists = rows[:, :3], rows[:, 3]
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert steps.max() <= 1.6 * rules.speed * DT  # along the spiral, and a little outwards
    assert np.abs(np.diff(twists)).max() <= rules.turning * DT + 1e-12
    assert np.abs(places[:, 2]).max() == 0.0
    assert rules.reach - rules.pitch < np.linalg.norm(places, axis=1).max() <= rules.reach
    wanted = np.random.default_rng(0).uniform(-rules.reach, rules.reach, (400, 2))
    wanted = wanted[
        (np.linalg.norm(wanted, axis=1) < rules.reach - rules.pitch)
        & (np.linalg.norm(wanted, axis=1) > 0.4e-3)
    ]
    for turn in rules.turns:  # while it turns from one to the next it covers only a part
        there = places[np.abs(twists - turn) < 1e-9, :2]
        nearest = np.array([np.linalg.norm(there - w, axis=1).min() for w in wanted])
        assert np.quantile(nearest, 0.9) <= rules.pitch / 2 + 1e-4  # hardly an opening of that size is missed
        assert turn != 0.0 or nearest.max() <= rules.pitch / 2 + 1e-4


@pytest.mark.parametrize("torque", (-0.01, 0.01))
def test_past_the_rim_it_turns_as_it_is_turned(torque: float) -> None:
    """On the rim the torque of a corner on which the piece stands says nothing about how it should turn."""
    rules = Compliance()
    guide = Guide(DOWN, rules)
    guide.update(blocked(rules.search + 0.1, torque), DT, left=8e-3)
    guide.update(blocked(0.1, torque), DT, left=8e-3 - 0.9 * rules.inside)
    assert guide.twist == 0.0
    guide.update(blocked(0.1, torque), DT, left=8e-3 - 1.1 * rules.inside)
    assert guide.twist == pytest.approx(np.sign(torque) * (0.01 - rules.slack) * rules.twist * DT)
    for _ in range(4800):
        guide.update(blocked(0.1, torque), DT, left=8e-3 - 1.1 * rules.inside)
    assert abs(guide.twist) == rules.most
    still = Guide(DOWN, rules)
    still.update(blocked(rules.search + 0.1), DT, left=8e-3)
    still.update(blocked(0.1, 0.9 * rules.slack), DT, left=4e-3)
    assert still.twist == 0.0


def test_an_opening_that_is_found_is_kept() -> None:
    """A search pauses where nothing resists, and ends where the hand gets deeper."""
    guide = Guide(DOWN, Compliance())
    for _ in range(700):
        guide.update(blocked(2.0), DT, left=8e-3)
    found = guide.offset
    assert guide.searching and found.any()
    assert guide.update(blocked(0.0), DT, left=8e-3) > 0.0
    assert guide.searching
    guide.update(blocked(0.0), DT, left=7.8e-3)
    assert not guide.searching
    np.testing.assert_array_equal(guide.offset, found)


def test_what_bounces_is_searched_with_too() -> None:
    """A stiff piece on a stiff rim touches for some hundredths of a second, is withdrawn, and touches
    again."""
    guide = Guide(DOWN, Compliance())
    touching = [k % 48 < 6 for k in range(480)]
    for touches in touching:
        guide.update(blocked(3.0 if touches else 0.0), DT, left=8e-3)
    assert guide.searching and np.linalg.norm(guide.offset) > 0.05e-3
    light = Guide(DOWN, Compliance())
    for touches in touching:
        light.update(blocked(0.4 if touches else 0.0), DT, left=8e-3)
    assert not light.searching


@given(st.floats(0.02, 0.98), st.booleans())
def test_it_searches_from_its_threshold_on(share: float, above: bool) -> None:
    """Where the resistance lasts, also one that is hardly enough; where it never is, it does not."""
    rules = Compliance()
    guide, newton = Guide(DOWN, rules), rules.search * (1.0 + 0.5 * share if above else share)
    for _ in range(round((PATIENCE + 2 * DT) / DT)):
        guide.update(blocked(newton), DT, left=8e-3)
    assert guide.searching == above


def test_it_backs_off_slowly_from_a_rim() -> None:
    rules = Compliance()
    guide = Guide(DOWN, rules)
    guide.update(blocked(2 * rules.press), DT, left=8e-3)
    assert guide.update(blocked(9.0), DT, left=8e-3) == -rules.careful
    assert guide.update(blocked(9.0), DT, left=8e-3, near=True) == -1.0


def test_too_much_force_ends_it() -> None:
    guide = Guide(DOWN, Compliance(limit=14.0))
    guide.update(np.array((14.5, 0.0, 0.0, 0.0, 0.0, 0.0)), DT)
    assert guide.failed == "force"


def test_what_is_neither_blocked_nor_gets_deeper_ends() -> None:
    """Too light to search by, and all there is."""
    for force in (lambda k: 0.49 if k // 60 % 2 else 0.0, lambda k: 0.4):
        guide = Guide(DOWN, Compliance())
        steps = next(
            k
            for k in range(round(120 / DT))
            if guide.failed or guide.update(blocked(force(k)), DT, 5e-3) is None
        )
        assert guide.failed == "not found" and 60.0 < steps * DT < 110.0


def test_what_gets_deeper_is_led_around_no_more() -> None:
    guide = Guide(DOWN, Compliance())
    for _ in range(200):
        guide.update(blocked(1.0), DT, 5e-3)
    assert guide.searching
    at = guide.offset
    guide.update(blocked(1.0), DT, 4.8e-3)
    assert not guide.searching
    np.testing.assert_array_equal(guide.offset, at)


def test_so_near_to_the_end_it_does_not_search() -> None:
    guide = Guide(DOWN, Compliance())
    for _ in range(200):
        guide.update(blocked(1.0), DT, 2e-4, near=True)
    assert not guide.searching and not guide.offset.any()


def test_the_hand_stays_within_reach_and_never_jumps() -> None:
    rules = Compliance()
    guide = Guide(DOWN, rules)
    for _ in range(4000):  # pushed as far aside as it goes, then blocked
        guide.update(np.array((0.8, 0.0, 0.0, 0.0, 0.0, 0.0)), DT)
    places = [guide.offset]
    while not guide.failed:
        guide.update(blocked(1.0), DT)
        places.append(guide.offset)
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert np.linalg.norm(places, axis=1).max() < rules.reach + 1e-9
    assert steps.max() < 1.5 * rules.speed * DT


def test_what_has_met_an_edge_goes_in_carefully() -> None:
    rules = Compliance()
    guide = Guide(DOWN, rules)
    assert guide.update(np.zeros(6), DT, left=10e-3) == 1.0
    guide.update(blocked(rules.search + 0.1), DT, left=8e-3)
    for deeper in (0.0, 0.5e-3, 0.9 * rules.entry):
        assert guide.update(np.zeros(6), DT, left=8e-3 - deeper) == rules.careful
    assert guide.update(np.zeros(6), DT, left=8e-3 - 1.01 * rules.entry) == 1.0
