"""Chamfered bodies: the outer edges are cut, the seams between the parts of a body are not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.hulls import Hull
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.bullet.bodies import collision_parts, sparing
from soma_bullet.frames import Array
from tests.blocks import cells

CHAMFER = 1e-3  # [m]
CUBE = load_assembly("cube").pieces
BRACKET = load_assembly("bracket").pieces
RING = cells([(x, y, 0) for x in (0, 1, 2) for y in (0, 1, 2) if (x, y) != (1, 1)], "ring")
SINGLE = cells([(0, 0, 0)], "single")


def covered(parts: tuple[Hull, ...], points: Array, slack: float = 0.0) -> Array:
    """Which points (n, 3) lie in any of the parts."""
    return np.any([np.all(points @ part.normals.T < part.offsets + slack, axis=1) for part in parts], axis=0)


def outer_edges(mesh: trimesh.Trimesh) -> Array:
    """End points (n, 2, 3) [m] of the edges of a mesh that turn outwards by 45 deg at least."""
    sharp = mesh.face_adjacency_convex & (mesh.face_adjacency_angles > np.deg2rad(44.9))
    return np.asarray(mesh.vertices[mesh.face_adjacency_edges[sharp]])


def to_edges(points: Array, edges: Array) -> Array:
    """Distance (n,) [m] of points from the nearest edge."""
    start, along = edges[:, 0], edges[:, 1] - edges[:, 0]
    s = np.clip(np.einsum("nej,ej->ne", points[:, None] - start, along) / (along**2).sum(axis=1), 0, 1)
    return np.asarray(np.linalg.norm(points[:, None] - start - s[..., None] * along, axis=2).min(axis=1))


@pytest.mark.parametrize("clearance", [0.0, 1e-4])
@pytest.mark.parametrize("piece", [*CUBE, RING, SINGLE], ids=lambda piece: piece.name)
def test_only_outer_edges_of_boxes_are_cut(piece: Workpiece, clearance: float) -> None:
    piece = replace(piece, clearance=clearance)
    parts = collision_parts(replace(piece, chamfer=CHAMFER))
    rng = np.random.default_rng(0)
    points = rng.uniform(piece.vertices.min(axis=0), piece.vertices.max(axis=0), (20_000, 3))
    surface, _ = trimesh.sample.sample_surface(piece.mesh, 5000, seed=0)
    points = np.vstack([points, surface + 0.002 * CHAMFER * rng.normal(size=(5000, 3))])
    before, after = covered(piece.body_parts, points), covered(parts, points, 2e-6)
    assert not (after & ~covered(piece.body_parts, points, 3e-6)).any()
    edges = outer_edges(piece.mesh)
    lost = points[before & ~after]
    assert (to_edges(lost, edges) < 1.8 * CHAMFER + 2 * clearance).all()
    middles = edges.mean(axis=1)
    depth = np.linalg.norm(middles - piece.center_of_mass, axis=1, keepdims=True)
    inside = middles + (piece.center_of_mass - middles) / depth * CHAMFER * 0.1
    assert not covered(parts, inside).any()


def test_the_cut_is_as_deep_as_asked() -> None:
    piece = replace(SINGLE, clearance=0.0, chamfer=CHAMFER)
    (part,) = collision_parts(piece)
    whole = float(np.prod(np.ptp(piece.vertices, axis=0)))
    from scipy.spatial import ConvexHull

    size = np.ptp(piece.vertices, axis=0)
    edges = 4 * size.sum() * CHAMFER**2 / 2
    assert ConvexHull(part.vertices).volume == pytest.approx(whole - edges, rel=1e-3)
    assert len(part.normals) == 18


@pytest.mark.parametrize("piece", BRACKET, ids=lambda piece: piece.name)
def test_other_bodies_lose_no_more_than_their_edges(piece: Workpiece) -> None:
    chamfer = 3e-4
    parts = collision_parts(replace(piece, chamfer=chamfer))
    points = np.random.default_rng(0).uniform(
        piece.vertices.min(axis=0), piece.vertices.max(axis=0), (20_000, 3)
    )
    before, after = covered(piece.body_parts, points), covered(parts, points, 1e-9)
    assert not (after & ~before).any()
    lost = points[before & ~after]
    assert (to_edges(lost, outer_edges(piece.mesh)) < 1.8 * chamfer + 3 * piece.clearance).all()


def test_none_leaves_everything_as_it_was() -> None:
    for piece in CUBE:
        assert [p.vertices.tobytes() for p in collision_parts(piece)] == [
            p.vertices.tobytes() for p in sparing(piece.body_parts)
        ]


def loaded(folder: Path, defaults: str) -> Workpiece:
    mesh = trimesh.creation.box((0.02, 0.02, 0.02))
    mesh.export(folder / "box.obj")
    text = f"""name = "one"\nunit = "mm"\n[defaults]\n{defaults}\n[[piece]]
name = "box"
mesh = "box.obj"
mesh_unit = "m"
goal = {{ position = [0.0, 0.0, 10.0], rpy_deg = [0.0, 0.0, 0.0] }}\n"""
    (folder / "one.toml").write_text(text, encoding="utf-8")
    return load_assembly(folder / "one.toml").pieces[0]


def test_it_is_read_in_the_unit_of_the_file(tmp_path: Path) -> None:
    assert loaded(tmp_path, "chamfer = 0.5").chamfer == pytest.approx(5e-4)
    assert loaded(tmp_path, "").chamfer == 0.0


@pytest.mark.parametrize(
    ("value", "says"),
    [("-0.1", "chamfer -0.1 must not be negative"), ("10.0", "chamfer 10 mm leaves nothing")],
)
def test_what_cannot_be_cut_is_refused(tmp_path: Path, value: str, says: str) -> None:
    from soma_bullet.errors import InputError

    with pytest.raises(InputError, match=says):
        loaded(tmp_path, f"chamfer = {value}")
