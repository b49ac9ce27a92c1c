"""Assembly files: what comes with the package loads, in any unit and mesh format."""

from __future__ import annotations

import importlib.util
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from soma_bullet.assembly.file import find_assembly_file, load_assembly
from soma_bullet.errors import InputError
from tests.assembly.tower import GOOD, LOWER_GOAL, UPPER_GOAL

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted((ROOT / "meshes").glob("*/*.toml"))


def test_values_arrive_in_si(folder: Path) -> None:
    tower = load_assembly(folder / "tower.toml")
    assert tower.names == ("lower", "upper")
    lower, upper = tower.pieces
    assert (lower.density, lower.friction, lower.clearance) == (700.0, 0.5, pytest.approx(2e-4))
    assert (upper.density, upper.friction, upper.clearance) == (500.0, 0.3, pytest.approx(1e-4))
    assert upper.color == pytest.approx((1.0, 128 / 255, 0.0))
    assert np.ptp(upper.vertices, axis=0) == pytest.approx((0.02, 0.03, 0.02))
    assert lower.mass == pytest.approx(700 * 12e-6)
    assert tower.goals[1, :3, 3] == pytest.approx((0, 0, 0.03))
    assert tower.goals[0, :3, :3] == pytest.approx(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]))
    assert tower.goals[1, :3, :3] == pytest.approx(
        np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    )  # normalised: exact
    assert not tower.goals.flags.writeable


def test_roll_pitch_yaw_turn_about_fixed_axes(folder: Path) -> None:
    text = GOOD.replace("rpy_deg = [0, 0, 90]", "rpy_deg = [90, 0, 90]").replace(
        LOWER_GOAL, "position = [0, 0, 15]"
    )
    (folder / "rpy.toml").write_text(text.replace(UPPER_GOAL, "position = [0, 0, 40]"))
    assert load_assembly(folder / "rpy.toml").goals[0, :3, :3] == pytest.approx(
        np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0.0]])
    )


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_every_assembly_of_the_package_loads_by_path_and_by_name(path: Path) -> None:
    by_path = load_assembly(path)
    assert (
        by_path.digest
        == load_assembly(f"{path.parent.name}/{path.stem}").digest
        == load_assembly(path.stem).digest
    )
    assert by_path.name == path.stem
    assert len({piece.color for piece in by_path.pieces}) == len(by_path.pieces)
    lowest = min(part.vertices[:, 2].min() for parts in by_path.goal_parts for part in parts)
    assert lowest == pytest.approx(by_path.support.height, abs=1e-9)


def test_the_generator_reproduces_the_package_files(tmp_path: Path) -> None:
    spec = importlib.util.spec_from_file_location("generate_meshes", ROOT / "scripts" / "generate_meshes.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules["generate_meshes"] = module
    spec.loader.exec_module(module)
    module.main(tmp_path)
    for file in tmp_path.iterdir():
        assert file.read_bytes() == (ROOT / "meshes" / "soma" / file.name).read_bytes(), file.name
    assert len(list(tmp_path.iterdir())) == 10


SOMA3_CELLS = {
    "BigL": {(-3, 1), (-2, 1), (-1, 1), (-1, 2)},
    "smallL": {(-1, 3), (0, 3), (0, 2)},
    "Z": {(-1, -1), (-1, 0), (0, 0), (0, 1)},
}


def test_soma3_fills_the_cells_of_the_paper() -> None:
    soma3 = load_assembly("soma3")
    assert soma3.names == ("BigL", "smallL", "Z")
    for name, parts in zip(soma3.names, soma3.goal_parts, strict=True):
        cells = set()
        for part in parts:
            low, high = part.vertices.min(axis=0) / 0.0185, part.vertices.max(axis=0) / 0.0185
            assert (low[0], high[0]) == pytest.approx((-0.5, 0.5))
            cells |= {
                (y, z - 1)
                for y in range(round(low[1] + 0.5), round(high[1] + 0.5))
                for z in range(round(low[2]), round(high[2]))
            }
        assert cells == SOMA3_CELLS[name]


@pytest.mark.parametrize("extension", ["stl", "ply", "glb"])
def test_other_mesh_formats(folder: Path, extension: str) -> None:
    trimesh.creation.box((20.0, 30.0, 20.0)).export(folder / f"box.{extension}")
    (folder / "other.toml").write_text(GOOD.replace("box.obj", f"box.{extension}"))
    other = load_assembly(folder / "other.toml")
    assert other.pieces[0].mesh.volume == pytest.approx(12e-6)
    assert len(other.pieces[0].vertices) == 8


@pytest.mark.parametrize(("unit", "size"), [("m", 1e-3), ("cm", 0.1), ("in", 1 / 25.4)])
def test_the_unit_does_not_matter(folder: Path, unit: str, size: float) -> None:
    text = GOOD.replace('unit = "mm"', f'unit = "{unit}"').replace(
        'mesh = "box.obj"', 'mesh = "box.obj"\nmesh_unit = "mm"'
    )
    for value in ("10]", "30.0]", "0.2\n", "0.1\n"):
        text = text.replace(value, f"{float(value.strip(']')) * size!r}{value[-1]}")
    (folder / "other.toml").write_text(text)
    other, tower = load_assembly(folder / "other.toml"), load_assembly(folder / "tower.toml")
    assert other.goals == pytest.approx(tower.goals)
    for a, b in zip(other.pieces, tower.pieces, strict=True):
        assert a.vertices == pytest.approx(b.vertices)
        assert a.clearance == pytest.approx(b.clearance)
        assert a.mass == pytest.approx(b.mass)


def test_the_digest_follows_the_content_and_not_the_path(
    folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    digest = load_assembly(folder / "tower.toml").digest
    moved = tmp_path_factory.mktemp("elsewhere")
    shutil.copy(folder / "box.obj", moved / "brick.obj")
    (moved / "a.toml").write_text("# a comment\n" + GOOD.replace("box.obj", "brick.obj"))
    assert load_assembly(moved / "a.toml").digest == digest
    explicit = GOOD.replace('"lower"', '"lower"\nfriction = 0.5\nclearance = 0.2')
    (moved / "a.toml").write_text(explicit.replace("box.obj", "brick.obj"))
    assert load_assembly(moved / "a.toml").digest == digest
    (moved / "a.toml").write_text(
        GOOD.replace("box.obj", "brick.obj").replace("friction = 0.3", "friction = 0.31")
    )
    assert load_assembly(moved / "a.toml").digest != digest
    (moved / "a.toml").write_text(GOOD.replace("box.obj", "brick.obj"))
    (moved / "brick.obj").write_text((moved / "brick.obj").read_text() + "\n# touched\n")
    assert load_assembly(moved / "a.toml").digest != digest


def test_an_unknown_name_says_where_it_looked_and_what_there_is() -> None:
    with pytest.raises(InputError) as caught:
        find_assembly_file("soma/soma33")
    message = str(caught.value)
    assert str(Path("soma/soma33").absolute()) in message
    assert str(ROOT / "meshes" / "soma" / "soma33.toml") in message
    assert "soma/cube, soma/soma3, soma/soma4" in message
    assert "did you mean 'soma/soma3'" in message


def test_a_folder_is_no_file() -> None:
    with pytest.raises(InputError, match="is a folder"):
        find_assembly_file(ROOT / "meshes" / "soma")
