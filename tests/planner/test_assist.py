"""Certificates of holds: what a hand can take, by hand calculation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from blocks import assembly, box

from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import Array, make_transform
from soma_bullet.grasp.hand import Hand
from soma_bullet.planner.assist import GRAVITY, certify_hold
from soma_bullet.planner.options import HoldLoad

SIZE = 0.03  # [m]
DOWN = np.array((0.0, 0.0, -1.0))
NEVER = HoldLoad(push=0.0, disturbance=1.0)


def from_above(place: tuple[float, float, float]) -> Array:
    """T_assembly_tcp of a hand that comes down at `place` and closes along x."""
    return make_transform(np.diag((1.0, -1.0, -1.0)), place)


def in_the_air(mass: float = 0.02, size: tuple[float, float, float] = (SIZE, SIZE, SIZE)) -> Assembly:
    """A box that nothing carries, and one to be put on it."""
    density = mass / float(np.prod(size))
    below, above = box(size, "held", density=density), box((0.01, 0.01, 0.01), "next")
    return assembly([below, above], [(0, 0, 0), (0, 0, size[2] / 2 + 0.005)], height=-1.0)


def test_a_vertical_pull_is_limited_by_pad_friction(hand: Hand) -> None:
    """Both pads together rub with 2 mu F: weight and push share it."""
    whole, push = in_the_air(), 2.0
    certificate = certify_hold(
        whole,
        hand,
        frozenset({0}),
        0,
        from_above((0, 0, 0)),
        "dropped",
        1,
        DOWN,
        HoldLoad(push, disturbance=0.0),
    )
    mu = np.sqrt(whole.pieces[0].friction * hand.pad_friction)
    assert certificate.friction == pytest.approx(mu)
    limit = 2 * mu * hand.grip_force
    weight = whole.pieces[0].mass * GRAVITY
    assert certificate.margin == pytest.approx((limit - weight) / push, rel=0.03)  # twelve-sided pyramid
    assert certificate.wrench[:3] == pytest.approx((0, 0, -weight - push))
    assert certificate.wrench[3:] == pytest.approx((0, 0, 0), abs=1e-9)


def test_the_weight_itself_has_to_be_carried(hand: Hand) -> None:
    mu = np.sqrt(0.5 * hand.pad_friction)
    most = 2 * mu * hand.grip_force / GRAVITY  # [kg]
    for fraction, holds in ((0.9, True), (1.1, False)):
        whole = in_the_air(mass=most * fraction)
        load = HoldLoad(push=0.0, disturbance=1e-3)
        margin = certify_hold(
            whole, hand, frozenset({0}), 0, from_above((0, 0, 0)), "dropped", load=load
        ).margin
        assert (margin > 0) == holds


def test_a_harder_grip_takes_more(hand: Hand) -> None:
    whole = in_the_air()
    margins = []
    for force in (5.0, 10.0, 20.0, 40.0, 80.0):
        stronger = replace(hand, grip_force=force)
        certificate = certify_hold(
            whole, stronger, frozenset({0}), 0, from_above((0, 0, 0.005)), "dropped", 1, DOWN
        )
        assert certificate.grip_force == force
        margins.append(certificate.margin)
    assert np.all(np.diff(margins) > 0)
    assert margins[-1] / margins[-2] == pytest.approx(2.0, rel=0.1)  # the weight is small


def test_more_friction_takes_more(hand: Hand) -> None:
    margins = []
    for friction in (0.1, 0.3, 0.5, 1.0):
        whole = in_the_air()
        slippery = replace(whole, pieces=tuple(replace(piece, friction=friction) for piece in whole.pieces))
        margins.append(
            certify_hold(slippery, hand, frozenset({0}), 0, from_above((0, 0, 0)), "dropped", 1, DOWN).margin
        )
    assert np.all(np.diff(margins) > 0)


def test_a_load_far_from_the_pads_turns_the_piece(hand: Hand) -> None:
    """A beam across the closing axis, gripped in the middle or off it: two pads resist little moment about
    their axis."""
    margins = []
    for offset in (0.0, 0.02, 0.04, 0.06):
        whole = in_the_air(mass=0.3, size=(SIZE, 0.16, 0.02))
        T, load = from_above((0, offset, 0)), HoldLoad(push=0.0, disturbance=0.01)
        certificate = certify_hold(whole, hand, frozenset({0}), 0, T, "dropped", load=load)
        margins.append(certificate.margin)
        assert abs(certificate.wrench[3]) == pytest.approx(whole.pieces[0].mass * GRAVITY * offset, abs=1e-3)
    assert margins[0] > 0
    assert np.all(np.diff(margins) <= 0)
    assert margins[-1] == 0.0
    # the moment that slips: 2 mu F at the mean radius of the pad
    arm = hand.pad_size[0] * (np.sqrt(2) + np.arcsinh(1)) / 6
    twist = 2 * np.sqrt(0.5) * hand.grip_force * arm
    assert 0.3 * GRAVITY * 0.06 * 2 > twist > 0.3 * GRAVITY * 0.01


def test_less_pad_on_the_piece_resists_less_moment(hand: Hand) -> None:
    whole = in_the_air(mass=0.3, size=(SIZE, 0.16, 0.02))
    full, part = (
        certify_hold(
            whole, hand, frozenset({0}), 0, from_above((0, 0.01, 0)), "dropped", load=NEVER, contact=contact
        ).margin
        for contact in (1.0, 0.3)
    )
    assert part < full


def test_the_push_comes_through_the_pieces_that_it_meets(hand: Hand) -> None:
    """A push on the held piece itself uses up the grip; one that the table takes does not."""
    held, other, coming = box((SIZE,) * 3, "held"), box((SIZE,) * 3, "other"), box((0.02,) * 3, "next")
    places = [(0, 0, SIZE / 2), (0.06, 0, SIZE / 2), (0.06, 0, SIZE + 0.01)]
    whole = assembly([held, other, coming], places)
    load = HoldLoad(push=20.0)
    by_the_table = certify_hold(
        whole, hand, frozenset({0, 1}), 0, from_above((0, 0, SIZE / 2)), "dropped", 2, DOWN, load
    )
    quiet = certify_hold(
        whole, hand, frozenset({0, 1}), 0, from_above((0, 0, SIZE / 2)), "dropped", load=load
    )
    assert by_the_table.wrench == quiet.wrench
    aside = np.array((0.0, 1.0, 0.0))
    wall = assembly([held, coming], [(0, 0, 0.5), (0, -0.025, 0.5)])
    pushed = certify_hold(wall, hand, frozenset({0}), 0, from_above((0, 0, 0.5)), "dropped", 1, aside, load)
    assert pushed.wrench[1] == pytest.approx(load.push, rel=0.05)


def test_soma3_is_held_by_a_good_grasp(soma3: Assembly, hand: Hand) -> None:
    """Z alone on its one cell, held across its thickness at its centre of mass."""
    z = soma3.index("Z")
    alone = frozenset({z})
    good = from_above(tuple(soma3.goal_centres[z]))
    certificate = certify_hold(soma3, hand, alone, z, good, "dropped")
    assert certificate.margin > 1
    assert certify_hold(soma3, hand, alone, z, good, "dropped", load=HoldLoad(disturbance=1e6)).margin < 1
