"""A folder with an assembly file, the mesh that it names, and broken relatives of that."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from tests.assembly.tower import GOOD
from tests.blocks import cup


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a box of 20 x 30 x 20 mm and broken relatives of it."""
    box = trimesh.creation.box((20.0, 30.0, 20.0))
    box.export(tmp_path / "box.obj")
    trimesh.Trimesh(box.vertices, box.faces[1:], process=False).export(tmp_path / "open.obj")
    trimesh.Trimesh(box.vertices, box.faces[:, ::-1], process=False).export(tmp_path / "inside_out.obj")
    flipped = box.faces.copy()
    flipped[3] = flipped[3, ::-1]
    trimesh.Trimesh(box.vertices, flipped, process=False).export(tmp_path / "mixed.obj")
    away = box.copy()
    away.apply_translation((50.0, 0.0, 0.0))
    trimesh.util.concatenate([box, away]).export(tmp_path / "two.obj")
    cup(60.0).export(tmp_path / "cup.obj")
    (tmp_path / "empty.obj").write_text("# nothing\n")
    (tmp_path / "garbage.stl").write_bytes(b"\x00\xff" * 20)
    trimesh.creation.box((0.02, 0.03, 0.02)).export(tmp_path / "metres.obj")
    box.export(tmp_path / "nan.stl")
    content = bytearray((tmp_path / "nan.stl").read_bytes())
    content[96:100] = np.float32(
        np.nan
    ).tobytes()  # x of the first corner: after a header of 80 bytes, a count and a normal
    (tmp_path / "nan.stl").write_bytes(content)
    (tmp_path / "tower.toml").write_text(GOOD)
    return tmp_path
