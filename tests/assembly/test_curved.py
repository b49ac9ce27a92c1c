"""Curved faces: contacts by points and normals, whatever their tessellation."""

from __future__ import annotations

import manifold3d
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from soma_bullet.assembly.checks import goal_faults
from soma_bullet.assembly.contacts import SUPPORT, Contact
from soma_bullet.assembly.facets import LARGEST_SAGITTA, planar_facets
from soma_bullet.assembly.model import Assembly
from soma_bullet.planner.assemblability import analyse_freedom
from soma_bullet.planner.equilibrium import classify
from tests.blocks import assembly, box, solid

Body = manifold3d.Manifold
RADIUS = 8.0  # [mm]


def dowel_in_block(sections: int, turn: float, bottom: float = 0.0) -> Assembly:
    """A drilled block of 24 sections on the support, and a dowel of its own tessellation that stands `bottom`
    [mm] up."""
    block = Body.cube([40, 40, 20], True) - Body.cylinder(30, RADIUS, RADIUS, 24, True)
    dowel = Body.cylinder(50, RADIUS, RADIUS, sections, True).rotate([0, 0, turn])
    return assembly(
        [solid(block, "block"), solid(dowel, "dowel")], [(0, 0, 0.010), (0, 0, 0.025 + bottom * 1e-3)]
    )


def between(whole: Assembly) -> list[Contact]:
    return [contact for contact in whole.contacts if contact.body_a != SUPPORT]


@pytest.mark.parametrize("sections", [24, 32, 37, 48])
@settings(max_examples=5)
@given(turn=st.floats(0.0, 15.0))
def test_a_dowel_touches_its_hole_all_round(sections: int, turn: float) -> None:
    found = between(dowel_in_block(sections, turn))
    normals = np.array([contact.normal for contact in found])
    assert np.abs(normals[:, 2]).max() < 1e-9
    # from the block into the dowel: inwards, and from all sides
    middles = np.array([contact.points.mean(axis=0) for contact in found])
    outward = middles[:, :2] / np.linalg.norm(middles[:, :2], axis=1)[:, None]
    assert (np.einsum("ij,ij->i", outward, normals[:, :2]) < -np.cos(np.deg2rad(15.0))).all()
    angles = np.sort(np.arctan2(normals[:, 1], normals[:, 0]))
    assert np.diff(angles, append=angles[0] + 2 * np.pi).max() <= np.deg2rad(16.0)
    reach = np.linalg.norm(np.vstack([contact.points for contact in found])[:, :2], axis=1)
    assert (np.abs(reach - RADIUS * 1e-3) < 2 * LARGEST_SAGITTA).all()


@pytest.mark.slow
@settings(max_examples=10)
@given(turn=st.floats(0.0, 15.0), sections=st.integers(20, 40))
def test_a_dowel_is_a_peg_whatever_its_tessellation(turn: float, sections: int) -> None:
    for bottom, kind in ((2.0, "peg through"), (0.0, "peg blind")):
        whole = dowel_in_block(sections, turn, bottom)
        freedom = analyse_freedom(
            np.array([contact.normal for contact in whole.contacts_of(1, frozenset({0}))])
        )
        assert freedom.type == kind
        assert freedom.best is not None and abs(freedom.best[2]) == pytest.approx(1.0, abs=1e-6)


def test_a_fit_by_another_tessellation_is_no_overlap_of_goals() -> None:
    assert goal_faults(dowel_in_block(37, 4.0), whole=True) == []
    wide = Body.cylinder(50, RADIUS + 0.3, RADIUS + 0.3, 37, True)
    whole = dowel_in_block(37, 4.0)
    thick = assembly([whole.pieces[0], solid(wide, "dowel")], [(0, 0, 0.010), (0, 0, 0.025)])
    assert "overlap" in goal_faults(thick, whole=True)[0]


@pytest.mark.parametrize("turn", [0.0, 3.0, 360 / 64])
def test_a_roller_rests_on_a_line_and_rolls_away(turn: float) -> None:
    roller = solid(
        Body.cylinder(50, RADIUS, RADIUS, 64, True).rotate([0, 0, turn]).rotate([0, 90, 0]), "roller"
    )
    whole = assembly(
        [box((0.06, 0.06, 0.01), "plate"), roller], [(0, 0, 0.005), (0, 0, 0.010 + RADIUS * 1e-3)]
    )
    (touch,) = between(whole)
    assert touch.normal == pytest.approx([0, 0, 1])
    size = np.ptp(touch.points, axis=0)
    assert size[0] == pytest.approx(0.05, abs=1e-6) and size[1] < 0.002
    # what it resists is the width of a facet, not of the body
    assert classify(whole, frozenset({0, 1})).margin < 0.12


def test_a_flat_face_stays_flat_and_a_curved_one_says_how_it_turns() -> None:
    facets = planar_facets(*(np.asarray(part) for part in cylinder(0.02, 48)))
    flat = [facet for facet in facets if facet.turn == 0.0]
    assert [abs(facet.normal[2]) for facet in flat] == pytest.approx([1.0, 1.0])
    curved = [facet for facet in facets if facet.turn]
    assert len(curved) == 48
    for facet in curved:
        assert facet.turn == pytest.approx(2 * np.pi / 48)
        assert facet.sagitta == pytest.approx(0.02 * (1 - np.cos(np.pi / 48)), rel=0.01)
    # six broad faces are meant to be flat
    assert not any(facet.turn for facet in planar_facets(*(np.asarray(part) for part in cylinder(0.02, 6))))


def cylinder(radius: float, sections: int) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.cylinder(radius, 0.03, sections=sections)
    return mesh.vertices, mesh.faces
