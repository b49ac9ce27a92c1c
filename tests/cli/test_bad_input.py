"""Bad values, names and files are named, cost nothing and write nothing; what cannot be planned says why."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
import trimesh

from soma_bullet.cli.episode import run_episode
from tests.cli.refused import Captured, refused

ROOT = Path(__file__).resolve().parents[2]

# --- values -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--seed", "-1"], "--seed -1: must be from 0"),
        (["--seed", "2147483648"], "--seed 2147483648: must be from 0 to 2147483647"),
        (["--seed", "many"], "seed"),
        (["--tolerance-mm", "-2"], "--tolerance-mm -2: must be positive"),
        (["--tolerance-deg", "0"], "--tolerance-deg 0: must be positive"),
        (["--tolerance-deg", "inf"], "--tolerance-deg inf: must be positive"),
        (["--feed.noise-mm", "nan"], "--feed.noise-mm nan: must not be negative"),
        (["--feed.noise-deg", "-1"], "--feed.noise-deg -1: must not be negative"),
        (["--feed.layout", "heap"], "layout"),
        (["--physics.iterations", "0"], "--physics.iterations 0: must be from 1"),
        (["--physics.substeps", "0"], "--physics.substeps 0: must be from 1 to 20"),
        (["--physics.grip-force", "-20"], "--physics.grip-force -20: must be positive"),
        (["--physics.grip-force", "nan"], "--physics.grip-force nan: must be positive"),
        (["--physics.friction", "0"], "--physics.friction 0: must be above 0"),
        (["--physics.mass", "nan"], "--physics.mass nan: must be above 0"),
        (["--physics.solver", "magic"], "solver"),
        (["--film.size", "641", "360"], "--film.size 641 360: both must be even, and at least 16"),
        (["--film.size", "640"], "size"),
        (["--film.camera", "moon"], "film.camera"),
        (["--film.renderer", "cuda"], "renderer"),
        (["--film.fps", "0"], "--film.fps 0: must be positive"),
        (["--film.speed", "0"], "--film.speed 0: must be positive"),
        (["--film.speed", "nan"], "--film.speed nan: must be positive"),
        (["--ablate", "gravity"], "ablate"),
        (["--stability", "hope"], "--stability: 'hope' is not known; there are equilibrium, paper"),
        (["--analyzer", "json:reach"], "module 'json' has no 'reach'"),
        (["--hands", "0"], "--hands 0: must be at least 1"),
        (["--hands", "3"], "--hands: 3: ur5e_pair has 2 arms"),
        (["--top", "0"], "--top 0: must be at least 1"),
        (["--push", "nan"], "--push nan: must not be negative"),
        (["--search.lines", "0"], "--search.lines 0: must be at least 1"),
        (["--execution.longest", "0"], "--execution.longest 0: must be above 0 and at most 100000"),
        (["--no-video", "--film.speed", "2"], "--film.speed 2: there is no film with --no-video"),
        (["--plan-only", "--film.speed", "2"], "--film.speed 2: there is no film with --plan-only"),
        (["--sede", "1"], "sede"),
    ],
)
def test_a_bad_value(arguments: list[str], said: str, capsys: Captured, never_planned: None) -> None:
    assert said in refused(["soma3", *arguments], capsys)


def test_all_bad_values_are_listed_at_once(capsys: Captured, never_planned: None) -> None:
    said = refused(["soma3", "--seed", "-1", "--tolerance-mm", "0", "--physics.mass", "-1"], capsys)
    assert "3 faults" in said
    assert all(name in said for name in ("--seed -1", "--tolerance-mm 0", "--physics.mass -1"))


def test_no_assembly_at_all(capsys: Captured) -> None:
    assert "assembly" in refused([], capsys).lower()


# --- names and files ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["som3"], "there is no such assembly; .* did you mean 'soma3'"),
        (["meshes/none.toml"], "there is no such assembly; tried"),
        (["soma3", "--cell", "ur5_pair"], "no such cell; tried .* known cells: .*ur5e_pair"),
        (["soma3", "--hand", "none.toml"], "none.toml: no such hand; tried .*known hands: .*ur5e_pair"),
        (["soma3", "--hand", "no_cell"], "no such hand"),
        (["soma3", "--from", "none/plan.json"], "--from: no file none/plan.json"),
    ],
)
def test_a_name_that_nothing_has(
    arguments: list[str], said: str, capsys: Captured, never_planned: None
) -> None:
    assert re.search(said, refused(arguments, capsys))


def test_an_assembly_file_with_faults(tmp_path: Path, capsys: Captured, never_planned: None) -> None:
    text = (ROOT / "meshes/soma/soma3.toml").read_text()
    (tmp_path / "bad.toml").write_text(
        text.replace('unit = "mm"', "").replace('mesh = "V.obj"', 'mesh = "none.obj"')
    )
    said = refused(["bad.toml"], capsys)
    assert "unit" in said
    (tmp_path / "bad.toml").write_text(text.replace('mesh = "V.obj"', 'mesh = "none.obj"'))
    said = refused(["bad.toml"], capsys)
    assert "smallL" in said and "none.obj" in said
    (tmp_path / "bad.toml").write_text("name = [")
    assert "is not valid TOML" in refused(["bad.toml"], capsys)


def test_a_hand_file_with_faults(tmp_path: Path, capsys: Captured, never_planned: None) -> None:
    folder = tmp_path / "hand"
    shutil.copytree(ROOT / "robots/ur5e_pair", folder)
    text = (folder / "hand.toml").read_text()
    (folder / "hand.toml").write_text(
        text.replace("opening = 85.0", "opening = -85.0").replace('tcp = "tcp"', 'tool = "tcp"')
    )
    said = refused(["soma3", "--hand", str(folder / "hand.toml")], capsys)
    assert (
        "grip.opening = -85.0: must be positive" in said
        and "links.tcp is missing" in said
        and "links.tool is unknown" in said
    )
    (folder / "hand.toml").write_text("[grip")
    assert "cannot be read as TOML" in refused(["soma3", "--hand", str(folder / "hand.toml")], capsys)


def test_an_output_folder_that_is_a_file(tmp_path: Path, capsys: Captured, never_planned: None) -> None:
    (tmp_path / "taken").write_text("")
    for out in ("taken", "taken/run"):
        assert run_episode(["soma3", "--out", out]) == 2
        captured = capsys.readouterr()
        assert "--out" in captured.err and "taken" in captured.err and captured.out == ""


# --- what cannot be planned ---------------------------------------------------------------------------------


def test_a_piece_too_large_for_the_hand(tmp_path: Path, capsys: Captured) -> None:
    trimesh.creation.box((0.12, 0.12, 0.12)).export(tmp_path / "crate.stl")
    piece = (
        '[[piece]]\nname = "{}"\nmesh = "crate.stl"\nmesh_unit = "m"\n'
        "goal = {{ position = [0.0, 0.0, {}], rpy_deg = [0, 0, 0] }}\n"
    )
    (tmp_path / "crates.toml").write_text(
        'name = "crates"\nunit = "mm"\n' + piece.format("low", 60.0) + piece.format("high", 180.0)
    )
    assert run_episode(["crates.toml", "--out", "run"]) == 3
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "plan: none of the 2 orders of crates can be built" in captured.err
    assert re.search(r"\d+ x .*grasp", captured.err)
    assert not (tmp_path / "run").exists()
