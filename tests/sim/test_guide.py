"""Compliant insertion: slower against a resistance, aside with a force, and a spiral where the way is blocked."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soma_bullet.frames import Array
from soma_bullet.sim.guide import Compliance, Guide

DT = 1 / 480
DOWN = np.array((0.0, 0.0, -1.0))


def blocked(newton: float) -> Array:
    """What pushes back against a hand that goes down."""
    return np.array((0.0, 0.0, newton))


def test_free_motion_is_as_planned() -> None:
    guide = Guide(DOWN, Compliance())
    assert guide.update(np.zeros(3), DT) == 1.0
    assert not guide.offset.any() and not guide.searching and not guide.failed


@pytest.mark.parametrize(("newton", "speed"), [(0.5, 0.8), (2.5, 0.0), (5.0, -1.0), (-3.0, 1.0)])
def test_resistance_slows_down_and_turns_back(newton: float, speed: float) -> None:
    assert Guide(DOWN, Compliance(press=2.5)).update(blocked(newton), DT) == pytest.approx(speed)


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_it_yields_the_way_it_is_pushed(x: float, y: float) -> None:
    push, guide = np.array((x, y, 0.0)), Guide(DOWN, Compliance())
    for _ in range(48):
        guide.update(push, DT)
    size = float(np.linalg.norm(push))
    expected = max(size - guide.compliance.dead, 0.0) * guide.compliance.give * 48 * DT
    assert np.linalg.norm(guide.offset) == pytest.approx(min(expected, guide.compliance.reach), abs=1e-9)
    assert float(guide.offset @ push) >= 0.0 and guide.offset[2] == 0.0


def test_the_search_covers_a_disc_and_ends() -> None:
    rules = Compliance()
    guide, seen = Guide(DOWN, rules), []
    for _ in range(480 * 60):
        guide.update(blocked(2.0), DT)
        if guide.failed:
            break
        seen.append(guide.offset)
    assert guide.failed == "not found"
    places = np.array(seen)
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert steps.max() <= 1.6 * rules.speed * DT  # along the spiral, and a little outwards
    assert np.abs(places[:, 2]).max() == 0.0
    assert rules.reach - rules.pitch < np.linalg.norm(places, axis=1).max() <= rules.reach
    wanted = np.random.default_rng(0).uniform(-rules.reach, rules.reach, (400, 2))
    wanted = wanted[np.linalg.norm(wanted, axis=1) < rules.reach - rules.pitch]
    nearest = np.array([np.linalg.norm(places[:, :2] - w, axis=1).min() for w in wanted])
    assert nearest.max() <= rules.pitch / 2 + 1e-4  # no opening of that size is missed


def test_an_opening_that_is_found_is_kept() -> None:
    guide = Guide(DOWN, Compliance())
    for _ in range(700):
        guide.update(blocked(2.0), DT)
    found = guide.offset
    assert guide.searching and found.any()
    assert guide.update(np.zeros(3), DT) == 1.0
    assert not guide.searching
    np.testing.assert_array_equal(guide.offset, found)


def test_too_much_force_ends_it() -> None:
    guide = Guide(DOWN, Compliance(limit=14.0))
    guide.update(np.array((14.5, 0.0, 0.0)), DT)
    assert guide.failed == "force"


def test_what_is_neither_blocked_nor_gets_deeper_ends() -> None:
    """Resistance that comes and goes starts and stops searches for ever; the hand that only waits for it does as well."""
    for force in (lambda k: 1.0 if k // 60 % 2 else 0.0, lambda k: 0.4):
        guide = Guide(DOWN, Compliance())
        steps = next(k for k in range(round(60 / DT)) if guide.failed or guide.update(blocked(force(k)), DT, 5e-3) is None)
        assert guide.failed == "not found" and 20.0 < steps * DT < 40.0


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
        guide.update(np.array((0.8, 0.0, 0.0)), DT)
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
    assert guide.update(np.zeros(3), DT, left=10e-3) == 1.0
    guide.update(blocked(rules.search + 0.1), DT, left=8e-3)
    for deeper in (0.0, 0.5e-3, 0.9 * rules.entry):
        assert guide.update(np.zeros(3), DT, left=8e-3 - deeper) == rules.careful
    assert guide.update(np.zeros(3), DT, left=8e-3 - 1.01 * rules.entry) == 1.0
