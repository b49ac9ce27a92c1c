"""Convex parts of concave solids: exact where the solid is cut, measured where it is approximated, kept by
content."""

from __future__ import annotations

from functools import reduce
from pathlib import Path

import manifold3d
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from soma_bullet.assembly import decomposition
from soma_bullet.assembly.decomposition import NotDecomposableError, cut_at_notches
from soma_bullet.assembly.hulls import Hull, winding_numbers
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.frames import readonly
from tests.blocks import cup, solid

Body = manifold3d.Manifold


def drilled(sections: int = 24) -> Body:
    """A block of 40 x 40 x 20 mm with a hole of 16 mm."""
    return Body.cube([40, 40, 20], True) - Body.cylinder(30, 8, 8, sections, True)


def crossed() -> Body:
    """A block with two holes that are square to each other."""
    across = Body.cylinder(60, 4, 4, 12, True).rotate([90, 0, 0]).translate([12, 0, 0])
    return Body.cube([60, 40, 20], True) - Body.cylinder(30, 6, 6, 16, True).translate([-15, 0, 0]) - across


def gear(teeth: int = 9) -> Body:
    angles = 2 * np.pi * (np.arange(teeth)[:, None] + np.array([0, 0.2, 0.35, 0.65, 0.8])) / teeth
    radii = np.tile([17.0, 17.0, 22.0, 22.0, 17.0], teeth)
    outline = np.column_stack([radii * np.cos(angles.ravel()), radii * np.sin(angles.ravel())])
    return Body.extrude(manifold3d.CrossSection([outline]), 10) - Body.cylinder(30, 5, 5, 16, True)


def blind() -> Body:
    """A hole with a bottom."""
    return drilled().trim_by_plane([0, 0, 1], -9.0) + Body.cube([40, 40, 4], True).translate([0, 0, -11])


BODIES = {"drilled": drilled, "blind": blind, "crossed": crossed, "gear": gear}


def volume_of(parts: tuple[Hull, ...]) -> float:
    """Of the union [m3]."""
    bodies = [Body.hull_points(part.vertices * 1e3) for part in parts]
    return float(reduce(lambda a, b: a + b, bodies).volume() * 1e-9)


@pytest.mark.parametrize("name", BODIES)
def test_cuts_make_up_the_solid(name: str) -> None:
    piece = solid(BODIES[name]())
    assert piece.decomposition.kind == "cuts"
    assert volume_of(piece.parts) == pytest.approx(piece.mesh.volume, rel=1e-6)
    assert sum(volume_of((part,)) for part in piece.parts) == pytest.approx(piece.mesh.volume, rel=1e-6)


@pytest.mark.parametrize("name", BODIES)
def test_the_body_stands_back_by_its_clearance_and_no_more_inside(name: str) -> None:
    """Real body: between erosion by the clearance and by a little more; cuts inside the solid leave no gap of
    their own."""
    piece = solid(BODIES[name](), clearance=5e-4)
    points = piece.mesh.bounds[0] + np.random.default_rng(0).random((3000, 3)) * np.ptp(
        piece.mesh.bounds, axis=0
    )
    solid_inside = winding_numbers(piece.vertices, piece.faces, points) > 0.5
    _, depth, _ = trimesh.proximity.closest_point(piece.mesh, points)
    inside = np.any(
        [np.all(points @ p.normals.T < p.offsets + 1e-9, axis=1) for p in piece.body_parts], axis=0
    )
    assert not (inside & (~solid_inside | (depth < 5e-4 - 1e-7))).any()
    deep = solid_inside & (depth > 5e-4 / np.sin(np.deg2rad(20)))
    # a cut keeps both of its sides where it does not lie in the plane of a face
    assert (inside | ~deep).mean() > 0.99


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_random_differences_are_cut_exactly(seed: int) -> None:
    rng = np.random.default_rng(seed)
    body = Body.cube([30, 30, 30], True)
    for _ in range(3):
        tool = (
            Body.cube(rng.uniform(8, 25, 3), True)
            .rotate(rng.uniform(0, 90, 3))
            .translate(rng.uniform(-18, 18, 3))
        )
        body -= tool
    largest = max(body.decompose(), key=lambda part: part.volume())
    raw = largest.to_mesh64()
    pieces = cut_at_notches(raw.vert_properties[:, :3] / 1e3, np.asarray(raw.tri_verts, int))
    assert pieces is not None
    volumes = [trimesh.convex.convex_hull(points).volume for points in pieces]
    assert sum(volumes) == pytest.approx(largest.volume() * 1e-9, rel=1e-5)


@pytest.mark.slow
def test_what_curves_inwards_is_approximated_and_says_how_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    mesh = cup(0.020)
    piece = Workpiece("cup", readonly(mesh.vertices), readonly(mesh.faces, int))
    found = piece.decomposition
    assert found.kind == "approximate"
    assert found.volume_ratio == pytest.approx(volume_of(found.parts) / mesh.volume, rel=1e-6)
    assert 1.0 < found.volume_ratio < 1.05 and 0 < found.deviation < 1e-3
    # no corner of a part stands out by more than it says
    corners = np.vstack([part.vertices for part in found.parts])
    outside = corners[winding_numbers(mesh.vertices, mesh.faces, corners) < 0.5]
    assert trimesh.proximity.closest_point(mesh, outside)[1].max() <= found.deviation + 1e-6

    def fail(*_: object) -> None:
        raise AssertionError("it should have been found in the cache")

    monkeypatch.setattr(decomposition, "_approximate", fail)
    again = Workpiece("cup", readonly(mesh.vertices), readonly(mesh.faces, int)).decomposition
    assert all(np.array_equal(a.vertices, b.vertices) for a, b in zip(found.parts, again.parts, strict=True))
    file = next((tmp_path / "soma_bullet" / "parts").iterdir())
    file.write_bytes(b"damaged")
    with pytest.raises(AssertionError, match="cache"):
        _ = Workpiece("cup", readonly(mesh.vertices), readonly(mesh.faces, int)).decomposition


def test_what_no_parts_come_close_to_is_refused_with_the_numbers() -> None:
    mesh = cup(0.060)
    hull = mesh.convex_hull.volume / mesh.volume
    with pytest.raises(NotDecomposableError, match=rf"{hull:.2f} x its volume.* stand out by 1\.\d+ mm"):
        _ = Workpiece("cup", readonly(mesh.vertices), readonly(mesh.faces, int)).parts
