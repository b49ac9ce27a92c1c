"""Every assembly that comes with the package has its place in the cell."""

from __future__ import annotations

from pathlib import Path

import pytest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.robot.model import Cell
from soma_bullet.task.workcell import Workcell

FILES = sorted((Path(__file__).parents[2] / "meshes").glob("*/*.toml"))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_assembly_gets_a_workcell(file: Path, cell: Cell) -> None:
    assembly = load_assembly(file)
    workcell = Workcell(assembly, cell)
    assert set(workcell.settled) == set(assembly.names)
    assert all(workcell.collision.piece_shapes[name] for name in assembly.names)


@pytest.mark.parametrize("name", ["soma3", "soma4"])
def test_what_stands_on_what(name: str, cell: Cell) -> None:
    """A piece stands on another exactly where points just below its surface lie inside that other."""
    assembly = load_assembly(name)
    workcell = Workcell(assembly, cell)
    meshes = [piece.mesh.copy().apply_transform(workcell.settled[piece.name]) for piece in assembly.pieces]
    found = set()
    for above, mesh in zip(assembly.names, meshes, strict=True):
        points = mesh.triangles_center[mesh.face_normals[:, 2] < -0.9] - (0.0, 0.0, 1e-3)
        for below, other in zip(assembly.names, meshes, strict=True):
            if above != below and other.contains(points).any():
                found.add((below, above))
    assert found == {
        (a, b) for a in assembly.names for b in assembly.names if a != b and workcell.carries(a, b)
    }
    assert found
