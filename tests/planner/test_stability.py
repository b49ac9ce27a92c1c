"""Both stability modes: figures by hand, and what must not change them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from blocks import SIDE, assembly, box, cells, moved, refined, scaled
from hypothesis import given, settings
from hypothesis import strategies as st

from soma_bullet.assembly.contacts import SUPPORT
from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import make_transform, readonly, rotation_about
from soma_bullet.planner.equilibrium import (
    LARGEST,
    PYRAMID,
    classify,
    contact_forces,
    disturbance_angles,
    equilibrium_margin,
    friction_of,
    frictionless,
)
from soma_bullet.planner.paper_stability import contact_wrenches, wrench_margin

ALL = {name: load_assembly(name) for name in ("soma3", "soma4")}
names = st.sampled_from(sorted(ALL))
PYRAMID_ERROR = 0.02  # twelve sides between the inscribed and the circumscribed


def margins(whole: Assembly) -> list[tuple[float, float]]:
    """Of every subset that is not empty, with nothing held and with the first piece held."""
    count = len(whole.pieces)
    subsets = [frozenset(k for k in range(count) if code >> k & 1) for code in range(1, 2**count)]
    states = [classify(whole, s, h) for s in subsets for h in (frozenset(), frozenset({min(s)}))]
    return [(state.margin, state.margin_sides) for state in states]


def paper(whole: Assembly) -> list[float]:
    """s of every piece in the finished assembly."""
    placed, found = frozenset(range(len(whole.pieces))), []
    for k, piece in enumerate(whole.pieces):
        contacts = whole.contacts_of(k, placed)
        friction = np.array([friction_of(c, whole) for c in contacts])
        found.append(wrench_margin(contact_wrenches(contacts, whole.goal_centres[k], piece.radius, friction)))
    return found


PAPER = {name: paper(whole) for name, whole in ALL.items()}


@pytest.mark.parametrize(("height", "friction"), [(4.0, 0.5), (2.5, 0.5), (1.0, 0.5), (1.0, 0.2), (1.0, 1.5)])
def test_one_block_on_the_table(height: float, friction: float) -> None:
    """It topples at half its width over half its height, or slides at mu."""
    block = box((0.02, 0.02, 0.02 * height), friction=friction)
    whole = assembly([block], [(0, 0, 0.01 * height)], friction=friction)
    state = classify(whole, frozenset({0}))
    toppling = 1.0 / height
    assert state.verdict == "robust"
    if toppling < friction * (1 - PYRAMID_ERROR):
        assert state.margin == pytest.approx(toppling, abs=1e-8)
    else:
        assert state.margin == pytest.approx(min(friction, toppling), rel=PYRAMID_ERROR)
    assert state.quality == min(state.margin, 1.0)


def test_friction_is_the_geometric_mean() -> None:
    whole = assembly([box((0.02,) * 3, friction=0.2)], [(0, 0, 0.01)], friction=0.8)
    assert friction_of(whole.contacts[0], whole) == pytest.approx(0.4)
    assert classify(whole, frozenset({0})).margin == pytest.approx(0.4, rel=PYRAMID_ERROR)


def test_a_tie_is_unstable() -> None:
    """A beam whose centre of mass is exactly over the edge of what carries it."""
    post, beam = box((0.02, 0.02, 0.02), "post"), box((0.04, 0.02, 0.02), "beam")
    for shift, verdict in ((0.0, "unstable"), (1e-4, "robust"), (-1e-4, "unstable")):
        whole = assembly([post, beam], [(0, 0, 0.01), (0.01 - shift, 0, 0.03)])
        assert classify(whole, frozenset({0, 1})).verdict == verdict
        assert classify(whole, frozenset({0, 1})).margin == pytest.approx(max(0, shift) / 0.01, abs=1e-6)


def test_a_tower_is_as_good_as_its_worst_joint() -> None:
    """Three cubes, each shifted: the margin is that of the rigid stack above the worst edge."""
    cube = [box((0.02,) * 3, str(k)) for k in range(3)]
    whole = assembly(cube, [(0, 0, 0.01), (0.004, 0, 0.03), (0.008, 0, 0.05)])
    # above the table: centre at x = 0.004, z = 0.03; above cube 0: x = 0.006, z = 0.02 over it, edge at x =
    # 0.01
    assert classify(whole, frozenset(range(3))).margin == pytest.approx(
        min((0.010 - 0.004) / 0.03, 0.004 / 0.02), abs=1e-6
    )


def test_lying_between_walls_counts_on_the_clearance() -> None:
    """A leaning piece that only a side face keeps up."""
    post = cells(
        [(0, 0, k) for k in range(3)] + [(i, j, -1) for i in range(-1, 3) for j in range(-1, 2)], "post"
    )
    hook = cells([(1, 0, 0), (2, 0, 0), (1, 0, 1)], "hook")
    whole = assembly([post, hook], [(0, 0, 0)] * 2, height=-1.5 * SIDE)
    assert classify(whole, frozenset({0, 1})).verdict == "robust"
    lone = equilibrium_margin(whole, frozenset({0, 1}), frozenset(), "dropped")
    sides = equilibrium_margin(whole, frozenset({0, 1}), frozenset(), "frictionless")
    rubbing = equilibrium_margin(whole, frozenset({0, 1}), frozenset(), "friction")
    assert lone <= sides + 1e-9 <= rubbing + 2e-9


def test_values_that_depend_on_clearance_lie_below_robust_ones() -> None:
    soma3 = ALL["soma3"]
    leaning = classify(soma3, frozenset({0, 1}), frozenset({0}))
    assert leaning.verdict == "clearance-dependent"
    assert 0 < leaning.quality <= 1e-3
    fallen = classify(soma3, frozenset({0, 1}))
    assert (fallen.verdict, fallen.quality) == ("unstable", 0.0)


def test_no_preload_by_a_hand() -> None:
    """A beam that tips off its post: a block held on the tipping end would have to push up, which none
    can."""
    post, beam, block = box((0.02,) * 3, "post"), box((0.08, 0.02, 0.02), "beam"), box((0.02,) * 3, "block")
    whole = assembly([post, beam, block], [(0, 0, 0.01), (0.025, 0, 0.03), (0.055, 0, 0.05)])
    placed = frozenset(range(3))
    assert classify(whole, placed).verdict == "unstable"
    assert classify(whole, placed, frozenset({2})).verdict == "unstable"
    assert classify(whole, placed, frozenset({1})).verdict == "robust"


def test_what_a_held_piece_presses_down_does_not_rub() -> None:
    """Friction there would come from the hand's push alone."""
    whole = assembly(
        [box((0.02,) * 3, str(k)) for k in range(3)], [(0, 0, 0.01 + 0.02 * k) for k in range(3)]
    )
    between = {(c.body_a, c.body_b): c for c in whole.contacts}
    held = frozenset({1})
    assert frictionless(between[0, 1], held, "dropped")  # the held one lies on 0
    assert not frictionless(between[1, 2], held, "dropped")  # and carries 2
    assert not frictionless(between[SUPPORT, 0], held, "dropped")
    assert classify(whole, frozenset({0, 1, 2}), frozenset({0, 1, 2})).margin == LARGEST


def test_the_pyramid_lies_about_the_cone() -> None:
    whole = assembly([box((0.02,) * 3)], [(0, 0, 0.01)])
    forces = contact_forces(whole.contacts[0], 0.5, smooth=False)
    assert len(forces) == PYRAMID
    tangential = np.linalg.norm(forces - whole.contacts[0].normal, axis=1)
    inscribed = tangential * np.cos(np.pi / PYRAMID)
    assert np.all(tangential > 0.5) and np.all(inscribed < 0.5)
    assert (tangential + inscribed) / 2 == pytest.approx(0.5)


def test_directions_include_the_normals_of_the_footprint() -> None:
    turned = replace(box((0.03, 0.02, 0.02)), friction=0.5)
    whole = assembly([turned], [(0, 0, 0.01)])
    whole = moved(whole, make_transform(rotation_about((0, 0, 1), 0.1)))
    angles = disturbance_angles(whole, frozenset({0}))
    for k in range(4):
        assert np.abs(angles - (0.1 + k * np.pi / 2)).min() < 1e-6


@settings(max_examples=8)
@given(name=names, x=st.floats(-1, 1), y=st.floats(-1, 1), z=st.floats(-1, 1))
def test_a_shift_changes_nothing(name: str, x: float, y: float, z: float) -> None:
    whole = ALL[name]
    shifted = moved(whole, make_transform(None, (x, y, z)))
    np.testing.assert_allclose(margins(shifted), margins(whole), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(paper(shifted), PAPER[name], rtol=1e-6, atol=1e-6)


@settings(max_examples=8)
@given(name=names, yaw=st.floats(-np.pi, np.pi))
def test_a_yaw_of_everything_changes_little(name: str, yaw: float) -> None:
    """The pyramids and the fan of directions stay with the frame."""
    whole = ALL[name]
    turned = moved(whole, make_transform(rotation_about((0, 0, 1), yaw)))
    before, after = np.array(margins(whole)), np.array(margins(turned))
    assert ((before > 1e-3) == (after > 1e-3)).all()
    # friction enters the margin of a lean less the lean itself: 2 % of one is 3 % of the other
    np.testing.assert_allclose(after, before, rtol=0.03, atol=1e-6)


@given(yaw=st.floats(-np.pi, np.pi), height=st.floats(0.5, 4.0))
def test_a_yaw_of_what_stands_on_the_table_changes_two_percent(yaw: float, height: float) -> None:
    whole = assembly([box((0.03, 0.02, 0.02 * height))], [(0, 0, 0.01 * height)])
    turned = moved(whole, make_transform(rotation_about((0, 0, 1), yaw)))
    assert classify(turned, frozenset({0})).margin == pytest.approx(
        classify(whole, frozenset({0})).margin, rel=0.02
    )


@settings(max_examples=6)
@given(name=names, data=st.data())
def test_names_and_order_change_nothing(name: str, data: st.DataObject) -> None:
    whole = ALL[name]
    order = data.draw(st.permutations(range(len(whole.pieces))))
    pieces = tuple(replace(whole.pieces[k], name=f"piece {k}") for k in order)
    shuffled = replace(whole, pieces=pieces, goals=readonly(whole.goals[list(order)]))
    everything = frozenset(range(len(order)))
    for held in (frozenset(), frozenset({0})):
        there = classify(shuffled, everything, frozenset(order.index(k) for k in held))
        assert there.margin_sides == pytest.approx(classify(whole, everything, held).margin_sides, abs=1e-6)
    assert paper(shuffled) == pytest.approx([paper(whole)[k] for k in order], rel=1e-6)


@pytest.mark.parametrize("name", sorted(ALL))
@pytest.mark.parametrize("factor", [0.1, 7.0])
def test_size_and_weight_change_nothing(name: str, factor: float) -> None:
    """Margins are in g, and s in weights: neither knows metres or kilograms."""
    whole = ALL[name]
    heavier = replace(whole, pieces=tuple(replace(p, density=p.density * factor) for p in whole.pieces))
    np.testing.assert_allclose(margins(heavier), margins(whole), rtol=1e-6, atol=1e-6)
    if factor > 1:  # patches below a square millimetre are none
        larger = scaled(whole, factor)
        np.testing.assert_allclose(margins(larger), margins(whole), rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(paper(larger), PAPER[name], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", sorted(ALL))
@pytest.mark.parametrize("seed", [0, 1])
def test_tessellation_changes_nothing(name: str, seed: int) -> None:
    """A Minkowski sum over the points would grow with their number; the convex hull does not."""
    whole = ALL[name]
    finer = refined(whole, seed)
    assert sum(len(p.faces) for p in finer.pieces) > 1.5 * sum(len(p.faces) for p in whole.pieces)
    np.testing.assert_allclose(paper(finer), PAPER[name], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(margins(finer), margins(whole), rtol=1e-6, atol=1e-6)


def test_paper_mode_of_one_block() -> None:
    """Stable on a face, not on an edge, and never without contacts."""
    block = box((0.02,) * 3)
    whole = assembly([block], [(0, 0, 0.01)])
    assert paper(whole)[0] > 0.1
    assert wrench_margin(np.zeros((0, 6))) == 0.0
    overhanging = assembly([box((0.02,) * 3), block], [(0, 0, 0.01), (0.01, 0, 0.03)])
    assert paper(overhanging)[1] == 0.0
    more = assembly([replace(block, friction=1.0)], [(0, 0, 0.01)], friction=1.0)
    assert paper(more)[0] >= paper(whole)[0]
