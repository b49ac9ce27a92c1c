"""Every assembly that comes with the package has its place in the cell."""

from __future__ import annotations

from pathlib import Path

import pytest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.robot.cell import Cell
from soma_bullet.task.workcell import Workcell

FILES = sorted((Path(__file__).parents[2] / "meshes").glob("*/*.toml"))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_assembly_gets_a_workcell(file: Path, cell: Cell) -> None:
    assembly = load_assembly(file)
    workcell = Workcell(assembly, cell)
    assert set(workcell.settled) == set(assembly.names)
    assert all(workcell.collision.piece_shapes[name] for name in assembly.names)
