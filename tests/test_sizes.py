"""Sizes: what was measured for Soma pieces holds for these, and grows and shrinks with the pieces, within
bounds."""

from __future__ import annotations

from functools import cached_property

import pytest
from hypothesis import given
from hypothesis import strategies as st

from soma_bullet.assembly.file import load_assembly
from soma_bullet.robot.cell import load_cell
from soma_bullet.robot.kinematics import Robot
from soma_bullet.sizes import ARM, FINGER, LARGEST, LEAST, MOST, SMALLEST, Reach, Sizes, way_out

SOMA = {  # [m], [N]
    "run_in": 0.012,
    "lift": 0.06,
    "place": 0.010,
    "near": 0.001,
    "before_near": 0.003,
    "beyond": 0.0015,
    "fall": 0.001,
    "jam": 0.001,
    "seated": 0.00035,
    "empty": 0.002,
    "shut": 0.0005,
    "displaced": 0.0015,
    "fallen": 0.005,
    "gone": 0.015,
    "aside": 0.03,
    "askew": 0.010,
    "rim": 0.005,
    "smallest_stand": 0.03,
    "apart": 0.010,
    "room": 0.02,
    "guard": 1.0,
    "touch": 0.3,
    "leaning": 0.06,
    "resting": 0.15,
}
radii = st.lists(st.floats(1e-3, 0.5), min_size=1, max_size=9)


def test_every_size_has_its_soma_value_here() -> None:
    assert {name for name, member in vars(Sizes).items() if isinstance(member, cached_property)} == set(SOMA)


@pytest.mark.parametrize("name", ["soma3", "soma4", "cube"])
def test_soma_pieces_have_somas_values(name: str) -> None:
    sizes = Sizes.of([piece.radius for piece in load_assembly(name).pieces])
    assert sizes.scale == 1.0
    assert {name: getattr(sizes, name) for name in SOMA} == pytest.approx(SOMA)


@given(radii)
def test_sizes_are_bounded(found: list[float]) -> None:
    assert LEAST <= Sizes.of(found).scale <= MOST


@given(radii, st.floats(1.0, 4.0))
def test_larger_pieces_have_no_smaller_sizes(found: list[float], factor: float) -> None:
    small, large = Sizes.of(found), Sizes.of([factor * radius for radius in found])
    assert small.scale <= large.scale * (1 + 1e-12)
    for name, value in SOMA.items():
        assert getattr(small, name) == pytest.approx(value * small.scale)
        assert getattr(small, name) <= getattr(large, name) * (1 + 1e-12)


@given(st.floats(1e-3, 0.5))
def test_there_is_no_step_between_soma_and_others(radius: float) -> None:
    near = Sizes.of([radius * 1.001]).scale / Sizes.of([radius]).scale
    assert 1.0 - 1e-12 <= near <= 1.001 + 1e-12
    assert (Sizes.of([radius]).scale == 1.0) == (SMALLEST <= radius <= LARGEST)


@given(st.floats(0.01, 0.05), st.floats(1e-3, 1e-2))
def test_a_few_odd_pieces_change_nothing(radius: float, odd: float) -> None:
    assert Sizes.of([radius] * 3 + [odd, 100 * odd]) == Sizes.of([radius])


def test_a_hand_with_longer_fingers_goes_farther() -> None:
    assert way_out(FINGER) == pytest.approx(0.06)
    assert way_out(2 * FINGER) == pytest.approx(2 * way_out(FINGER))


def test_a_shorter_arm_is_nearer_to_all_that_it_does() -> None:
    assert (Reach.of(ARM).near, Reach.of(ARM).far, Reach.of(ARM).wrist) == pytest.approx((0.30, 0.65, 0.25))
    assert Reach.of(ARM / 2).meeting_sides == pytest.approx((0.15, 0.09))
    assert Reach.of(ARM / 2).own_side == pytest.approx(0.025)


def test_the_shipped_arms_have_the_measured_length() -> None:
    assert [reach.scale for reach in Robot(load_cell("ur5e_pair"), (0.1, 0.1)).reaches] == [1.0, 1.0]
