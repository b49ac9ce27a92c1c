"""Convex parts: they make up the body, whatever its pose, its tessellation and its clearance."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from pathlib import Path

import manifold3d
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.hulls import Hull, box_hull, hull_of_points, unique_directions, winding_numbers
from soma_bullet.assembly.polycubes import Cell, cell_mesh, cell_poses, cube_rotations
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.frames import Array, apply, make_transform, readonly

SIDE = 0.0185  # [m]
SOMA = {piece.name: piece for piece in load_assembly("cube").pieces}
LONGEST_RUNS = {
    "V": 2,
    "L": 2,
    "T": 2,
    "Z": 3,
    "A": 3,
    "B": 3,
    "P": 3,
}  # straight runs of cells that no other run contains
SEEDS = st.integers(0, 2**32 - 1)


def workpiece(mesh: trimesh.Trimesh) -> Workpiece:
    return Workpiece("piece", readonly(mesh.vertices), readonly(mesh.faces, int))


def union_volume(parts: tuple[Hull, ...]) -> float:
    """[m3]"""
    bodies = [manifold3d.Manifold.hull_points(part.vertices * 1e3) for part in parts]
    return reduce(lambda a, b: a + b, bodies).volume() * 1e-9


def inside(parts: tuple[Hull, ...], points: Array) -> Array:
    """Which of the points (n, 3) lie in one of the parts."""
    return np.any([np.all(points @ part.normals.T < part.offsets, axis=1) for part in parts], axis=0)


def random_pose(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    return make_transform(Rotation.random(rng=rng).as_matrix(), rng.uniform(-1, 1, 3))


def random_polycube(seed: int, count: int) -> list[Cell]:
    """Cells grown one by one, each beside an earlier one."""
    rng = np.random.default_rng(seed)
    cells: list[Cell] = [(0, 0, 0)]
    while len(cells) < count:
        step = rng.choice((-1, 1)) * np.eye(3, dtype=int)[rng.integers(3)]
        new = tuple(int(v) for v in np.array(cells[rng.integers(len(cells))]) + step)
        if new not in cells:
            cells.append((new[0], new[1], new[2]))
    return cells


@pytest.mark.parametrize("name", sorted(SOMA))
def test_parts_of_the_soma_pieces(name: str) -> None:
    piece = SOMA[name]
    assert len(piece.parts) == LONGEST_RUNS[name]
    assert all(part.box is not None for part in piece.parts)
    cells = 3 if name == "V" else 4
    assert union_volume(piece.parts) == pytest.approx(cells * SIDE**3)
    assert piece.mass == pytest.approx(cells * SIDE**3 * 700)
    eigenvalues = np.linalg.eigvalsh(piece.inertia)
    assert (eigenvalues > 0).all()
    assert eigenvalues[2] <= eigenvalues[:2].sum()


@given(name=st.sampled_from(sorted(SOMA)), seed=SEEDS)
def test_parts_move_with_the_mesh(name: str, seed: int) -> None:
    piece, pose = SOMA[name], random_pose(seed)
    moved = replace(piece, vertices=apply(pose, piece.vertices))
    assert len(moved.parts) == len(piece.parts)
    assert union_volume(moved.parts) == pytest.approx(union_volume(piece.parts), rel=1e-6)
    points = np.random.default_rng(seed).uniform(-0.03, 0.06, (200, 3))
    expected = inside(piece.parts, points)
    assert (inside(moved.parts, apply(pose, points)) == expected).all()
    assert (inside(tuple(part.moved(pose) for part in piece.parts), apply(pose, points)) == expected).all()
    assert (winding_numbers(piece.vertices, piece.faces, points).round() == expected).all()


@given(seed=SEEDS, count=st.integers(1, 9))
def test_any_polycube_is_made_of_its_boxes(seed: int, count: int) -> None:
    vertices, faces = cell_mesh(random_polycube(seed, count), SIDE)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert (
        mesh.is_volume or not mesh.is_watertight
    )  # cells that meet in an edge only leave it with four triangles
    assert mesh.volume == pytest.approx(count * SIDE**3)
    piece = Workpiece("polycube", vertices, faces)
    assert union_volume(piece.parts) == pytest.approx(count * SIDE**3)
    assert union_volume(
        Workpiece("finer", *trimesh.remesh.subdivide(vertices, faces)).parts
    ) == pytest.approx(count * SIDE**3)


@given(seed=SEEDS, clearance=st.floats(1e-5, 4e-3))
def test_the_real_body_is_the_mesh_eroded_by_the_clearance(seed: int, clearance: float) -> None:
    """A point lies in the union of the inset boxes exactly where the cube of the clearance about it fits into
    the mesh."""
    cells = random_polycube(seed, 5)
    piece = Workpiece("polycube", *cell_mesh(cells, SIDE), clearance=clearance)
    rng = np.random.default_rng(seed)
    points = (np.array(cells)[rng.integers(len(cells), size=200)] + rng.uniform(-0.5, 0.5, (200, 3))) * SIDE
    corners = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    reached = np.floor((points[:, None] + corners * clearance) / SIDE + 0.5).astype(
        int
    )  # a cell, as the cube is smaller
    fits = np.array([{tuple(cell) for cell in cube} <= set(cells) for cube in reached.tolist()])
    assert (inside(piece.body_parts, points) == fits).all()


def test_an_inset_that_leaves_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="20 mm"):
        box_hull(np.zeros(3), np.eye(3), np.array((0.01, 0.02, 0.03))).inset(0.01)


@given(seed=SEEDS)
def test_a_box_is_known_as_one_in_every_pose(seed: int) -> None:
    rng = np.random.default_rng(seed)
    half, pose = rng.uniform(0.002, 0.1, 3), random_pose(seed)
    box = hull_of_points(apply(pose, box_hull(np.zeros(3), np.eye(3), half).vertices))
    assert box.box is not None
    assert sorted(box.box[2]) == pytest.approx(sorted(half))
    assert box.box[0] == pytest.approx(pose[:3, 3])
    inner = box.inset(0.001)
    assert inner.box is not None
    assert sorted(inner.box[2]) == pytest.approx(sorted(half - 0.001))


@given(seed=SEEDS, count=st.integers(5, 30))
def test_faces_and_edges_of_a_hull(seed: int, count: int) -> None:
    points = np.random.default_rng(seed).uniform(-0.05, 0.05, (count, 3))
    hull, pose = hull_of_points(points), random_pose(seed)
    for body in (hull, hull.moved(pose)):
        assert (body.vertices @ body.normals.T - body.offsets).max() < 1e-9
        assert np.linalg.norm(body.normals, axis=1) == pytest.approx(np.ones(len(body.normals)))
        assert np.linalg.norm(body.edges, axis=1) == pytest.approx(np.ones(len(body.edges)))
        on_plane = np.abs(body.vertices @ body.normals.T - body.offsets) < 1e-9
        assert (on_plane.sum(axis=0) >= 3).all()
    inner = hull.inset(1e-5)
    assert (inner.vertices @ hull.normals.T - hull.offsets).max() < -1e-5 + 1e-9
    assert union_volume((inner,)) < union_volume((hull,))


@pytest.mark.parametrize(
    "mesh",
    [
        trimesh.creation.cylinder(0.01, 0.04, sections=48),
        trimesh.creation.cone(0.01, 0.03, sections=24),
        trimesh.creation.icosphere(2, 0.01),
    ],
    ids=["cylinder", "cone", "sphere"],
)
def test_a_convex_mesh_is_one_part(mesh: trimesh.Trimesh) -> None:
    piece = workpiece(mesh)
    assert len(piece.parts) == 1
    assert union_volume(piece.parts) == pytest.approx(mesh.volume, rel=1e-6)
    assert union_volume(piece.body_parts) < mesh.volume


def test_boxes_of_unequal_sizes_that_are_not_on_a_grid() -> None:
    tee = trimesh.boolean.union(
        [trimesh.creation.box((0.05, 0.011, 0.007)), trimesh.creation.box((0.013, 0.04, 0.0029))]
    )
    assert union_volume(workpiece(tee).parts) == pytest.approx(tee.volume)


def test_directions_are_unique_up_to_sign() -> None:
    found = unique_directions(np.array([(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0), (0, 0, 1.0)]))
    assert found.tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    assert unique_directions(np.zeros((0, 3))).shape == (0, 3)


def test_cube_rotations_and_the_poses_of_a_polycube() -> None:
    rotations = cube_rotations()
    assert len({tuple(rotation.ravel()) for rotation in rotations}) == 24
    assert all(np.linalg.det(rotation) == pytest.approx(1) for rotation in rotations)
    screw: list[Cell] = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 0, 1)]
    mirrored = [(x, y, -z) for x, y, z in screw]
    assert len(cell_poses(screw, screw)) == 2
    assert cell_poses(screw, mirrored) == []
    assert cell_poses(screw, screw[:3]) == []


def test_the_meshes_of_the_package_are_those_of_their_cells() -> None:
    for path in sorted((Path(__file__).resolve().parents[2] / "meshes" / "soma").glob("*.obj")):
        mesh = trimesh.load_mesh(path)
        assert mesh.is_volume
        assert mesh.volume == pytest.approx((3 if path.stem == "V" else 4) * 18.5**3)
