"""Equilibrium of what stands on edges and corners, by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from blocks import box, solid
from manifold3d import CrossSection, Manifold
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from soma_bullet.assembly.contacts import SUPPORT
from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly, Support
from soma_bullet.frames import make_transform, readonly
from soma_bullet.planner.equilibrium import classify, contact_columns, equilibrium_margin
from soma_bullet.planner.options import HoldLoad
from soma_bullet.planner.pushes import Pushes

NONE: frozenset[int] = frozenset()


def ladder(lean: float, friction: float, height: float = 0.1, width: float = 0.01) -> Assembly:
    """A board of height and width [m], `lean` degrees from upright, against a heavy wall."""
    rotation = Rotation.from_euler("y", -lean, degrees=True).as_matrix()
    foot = (height * np.sin(np.deg2rad(lean)), 0, 0)
    goals = [
        make_transform(None, (-0.05, 0, 0.1)),
        make_transform(rotation, foot + rotation @ (width / 2, 0, height / 2)),
    ]
    pieces = (
        box((0.1, 0.2, 0.2), "wall", density=1e5, friction=friction),
        box((width, 0.08, height), "board", friction=friction),
    )
    return Assembly("ladder", pieces, readonly(goals), Support(0.0, friction))


@pytest.mark.parametrize("lean", [15.0, 25.0, 40.0])
def test_a_ladder_slides_where_its_foot_lacks_friction(lean: float) -> None:
    """Moments about the foot: wall * h cos = weight * (h sin - w cos) / 2, and the foot bears what the wall
    gives."""
    least = np.tan(np.deg2rad(lean)) / 2 - 0.01 / (2 * 0.1)
    both = frozenset({0, 1})
    assert equilibrium_margin(ladder(lean, least * 1.03), both, NONE, "frictionless") > 0
    assert equilibrium_margin(ladder(lean, least * 0.97), both, NONE, "frictionless") == 0
    # with friction at the wall as well it stands at less
    assert equilibrium_margin(ladder(lean, least * 0.97), both, NONE, "friction") > 0


def test_a_ladder_tips_back_where_its_weight_is_above_its_foot() -> None:
    """Sideways it resists the moment of its weight over its foot: (h sin - w cos) / (h cos + w sin)."""
    angle = np.deg2rad(25.0)
    whole, both = ladder(25.0, 0.6), frozenset({0, 1})
    state = classify(whole, both)
    expected = (0.1 * np.sin(angle) - 0.01 * np.cos(angle)) / (0.1 * np.cos(angle) + 0.01 * np.sin(angle))
    assert state.margin_sides == pytest.approx(expected, abs=1e-6)
    assert state.verdict == "clearance-dependent"  # an upright wall is a side contact
    assert classify(whole, frozenset({1})).verdict == "unstable"
    assert equilibrium_margin(ladder(4.0, 0.6), both, NONE, "frictionless") == 0  # leans too little


def on_ridges(shift: float) -> Assembly:
    """A beam on two ridges 60 mm apart, its middle `shift` [m] beyond theirs."""
    section = CrossSection([[(-10, 0), (10, 0), (0, 10)]])
    roof = Manifold.extrude(section, 30).translate([0, 0, -15]).rotate([90, 0, 0])
    pieces = (solid(roof, "left"), solid(roof, "right"), box((0.14, 0.02, 0.01), "beam"))
    places = [(-0.03, 0, 0), (0.03, 0, 0), (shift, 0, 0.015)]
    return Assembly("ridges", pieces, readonly([make_transform(None, p) for p in places]), Support())


@pytest.mark.parametrize("shift", [0.0, 0.01, -0.025])
def test_a_beam_on_two_edges_shares_its_weight_by_the_levers(shift: float) -> None:
    whole = on_ridges(shift)
    lines = [c.into(2) for c in whole.contacts if 2 in (c.body_a, c.body_b)]
    assert [(c.body_a, len(c.points), c.area) for c in lines] == [(0, 2, 0.0), (1, 2, 0.0)]
    columns = [contact_columns(c, whole, [2], NONE, "dropped") for c in lines]
    matrix = np.hstack(columns)
    weight = np.array([0, 0, 1.0, 0, 0, 0])
    left = np.where(np.arange(matrix.shape[1]) < columns[0].shape[1], matrix[2], 0.0)
    carried = [sign * linprog(sign * left, A_eq=matrix, b_eq=weight).fun for sign in (1, -1)]
    # friction at both edges may twist the ridges apart, but not lift
    assert carried == pytest.approx([0.5 - shift / 0.06] * 2, abs=1e-6)
    assert classify(whole, frozenset({0, 1, 2})).verdict == "robust"


def test_a_beam_beyond_its_edges_falls() -> None:
    assert classify(on_ridges(0.031), frozenset({0, 1, 2})).verdict == "unstable"


def test_a_pyramid_on_its_corner_falls() -> None:
    points = [(0, 0, 0), (-15, -15, 40), (15, -15, 40), (15, 15, 40), (-15, 15, 40)]
    pieces = (solid(Manifold.hull_points(points), "pyramid"),)
    whole = Assembly("pyramid", pieces, readonly([np.eye(4)]), Support())
    (contact,) = whole.contacts
    assert (contact.body_a, len(contact.points)) == (SUPPORT, 1)
    assert classify(whole, frozenset({0})).verdict == "unstable"
    upright = replace(whole, goals=readonly([make_transform(np.diag([1.0, -1, -1]), (0, 0, 0.04))]))
    assert classify(upright, frozenset({0})).verdict == "robust"


def test_dominoes_stand_one_after_another_and_not_without_the_first() -> None:
    whole = load_assembly("dominoes")
    for count in range(1, 5):
        state = classify(whole, frozenset(range(count + 1)))
        assert state.verdict == "clearance-dependent"
        assert state.margin_sides > 0.1
        assert classify(whole, frozenset(range(1, count + 1))).verdict == "unstable"
    # the first alone, by hand
    angle, state = np.deg2rad(18.0), classify(whole, frozenset({0, 1}))
    expected = (60 * np.sin(angle) - 10 * np.cos(angle)) / (60 * np.cos(angle) + 10 * np.sin(angle))
    assert state.margin_sides == pytest.approx(expected, abs=1e-6)


def test_the_bridge_stands_with_all_its_beams_alone() -> None:
    """A cross beam is wedged between faces at 40 degrees, which squeeze it out unless the friction angle is
    20 degrees; its own weight is little."""
    whole = load_assembly("leonardo")
    every = frozenset(range(5))
    assert classify(whole, every).verdict == "robust"
    for missing in range(5):
        assert classify(whole, every - {missing}).verdict == "unstable"

    def rubbing(friction: float) -> Assembly:
        pieces = tuple(replace(piece, friction=friction) for piece in whole.pieces)
        return replace(whole, pieces=pieces, support=replace(whole.support, friction=friction))

    assert equilibrium_margin(rubbing(np.tan(np.deg2rad(21.0))), every) > 0
    assert equilibrium_margin(rubbing(np.tan(np.deg2rad(18.0))), every) == 0


def test_a_push_on_an_edge_is_borne_like_one_on_a_face() -> None:
    """A beam that comes down on two ridges presses on both edges."""
    whole = on_ridges(0.0)
    bearing = Pushes(whole, HoldLoad()).bearing(frozenset({0, 1}), NONE, 2, np.array((0, 0, -1.0)))
    assert bearing.borne
    assert bearing.piece in (-1, 0, 1)
