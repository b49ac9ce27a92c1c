"""Where pieces come to rest, by hand calculation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.settling import rest_shifts
from tests.blocks import assembly, box, solid

CLEARANCE = 1e-4  # [m]


@pytest.mark.parametrize("name", ["soma3", "soma4", "cube", "dowel", "sliding_lid"])
def test_what_stands_on_level_faces_drops_by_the_gaps_below_it(name: str) -> None:
    whole = load_assembly(name)
    np.testing.assert_allclose(rest_shifts(whole)[:, :2], 0.0, atol=1e-9)
    np.testing.assert_allclose(rest_shifts(whole)[:, 2], -whole.drops, atol=1e-9)


@given(st.floats(1e-5, 3e-4))
def test_a_stack_drops_floor_by_floor(clearance: float) -> None:
    pieces = [box((0.02, 0.02, 0.02), name, clearance=clearance) for name in "abc"]
    whole = assembly(pieces, [(0, 0, 0.01), (0, 0, 0.03), (0, 0, 0.05)])
    assert rest_shifts(whole)[:, 2] == pytest.approx(-clearance * np.array((1.0, 3.0, 5.0)), abs=1e-8)


def test_a_driven_wedge_closes_all_gaps_beside_it() -> None:
    """Three gaps of two clearances and one along a slope, across a wedge that is tan = 0.35 steep."""
    whole = load_assembly("wedge_clamp")
    driven = rest_shifts(whole)[whole.index("driven")]
    assert -3.0e-3 < driven[2] < -1.5e-3 and abs(driven[0]) <= 4 * CLEARANCE


def test_what_friction_holds_on_a_slope_only_drops() -> None:
    """A wedge of 20 degrees under a block of the same slope: friction of 0.5 holds up to 26 degrees."""
    import manifold3d

    def ramp(height: float) -> manifold3d.Manifold:
        section = manifold3d.CrossSection([[(-20, 0), (20, 0), (20, height)]])
        return manifold3d.Manifold.extrude(section, 20).rotate([90, 0, 0]).translate([0, 10, 0])

    height = 40 * np.tan(np.deg2rad(20.0))
    low = solid(ramp(height), "low")
    high = solid(
        manifold3d.Manifold.cube([40, 20, 2 * height], True).translate([0, 0, height]) - ramp(height), "high"
    )
    whole = assembly([low, high], [(0, 0, 0), (0, 0, 0)])
    low_shift, high_shift = rest_shifts(whole)
    assert low_shift[2] == pytest.approx(-low.clearance, abs=1e-8) and abs(low_shift[0]) < 2e-4
    assert abs(high_shift[0]) < 5e-4 and high_shift[2] < 0.0
