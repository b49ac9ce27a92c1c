"""The command line: bad input is named, costs nothing and writes nothing; what is found goes to files, stdout
stays clean."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import trimesh

from soma_bullet.cli.episode import run_episode
from soma_bullet.cli.plan import plan
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.records import read_json, write_json

ROOT = Path(__file__).resolve().parents[1]
EMPTY = b""
Captured = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is written by default lands in the test's own folder."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def planned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of one plan of soma3."""
    folder = tmp_path_factory.mktemp("planned")
    assert run_episode(["soma3", "--plan-only", "--out", str(folder)]) == 0
    return folder


@pytest.fixture
def never_planned(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever plans or simulates has not looked at the input first."""

    def fail(*_: object, **__: object) -> None:
        pytest.fail("it planned before it refused the input")

    import soma_bullet.episode as episode

    for name in ("kept_plan", "program_of_best_order", "Workcell", "executed"):
        monkeypatch.setattr(episode, name, fail)


def refused(arguments: list[str], capsys: Captured) -> str:
    """What goes to stderr when the input is bad, in one line; checks that nothing else happened."""
    out = Path("refused")
    before = sorted(Path.cwd().rglob("*"))
    try:
        status = run_episode([*arguments, "--out", str(out)])
    except SystemExit as exit_:  # tyro ends the process itself
        status = int(exit_.code or 0)
    captured = capsys.readouterr()
    assert status == 2, captured.err
    assert captured.out == ""
    assert "Traceback" not in captured.err
    assert sorted(Path.cwd().rglob("*")) == before
    return re.sub(r"[\s│]+", " ", captured.err)


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


def test_a_file_that_cannot_be_resumed_from(
    planned: Path, tmp_path: Path, capsys: Captured, never_planned: None
) -> None:
    assert "--from: no file" in refused(["soma3", "--from", str(planned)], capsys)
    (tmp_path / "other.json").write_text('{"schema": 1, "success": true, "pieces": [], "assembly": "soma3"}')
    said = refused(["soma3", "--from", "other.json"], capsys)
    assert "other.json: is none of AssemblyPlan, Program, ExecutionLog" in said


def test_a_plan_under_any_name(planned: Path, tmp_path: Path) -> None:
    for name in ("mine.json", "program.npz"):
        shutil.copy(planned / "plan.json", tmp_path / name)
        assert run_episode(["soma3", "--plan-only", "--from", name, "--out", "again"]) == 0
        assert (tmp_path / "again/plan.json").read_bytes() == (planned / "plan.json").read_bytes()


def test_an_episode_goes_on_from_a_plan_of_the_planner(tmp_path: Path) -> None:
    assert plan(["soma3", "--stability", "paper", "--out", "mine.json"]) == 0
    assert run_episode(["soma3", "--plan-only", "--from", "mine.json", "--out", "again"]) == 0
    assert (tmp_path / "again/plan.json").read_bytes() == (tmp_path / "mine.json").read_bytes()


def test_options_that_come_too_late(planned: Path, capsys: Captured, never_planned: None) -> None:
    late = ["--stability", "paper", "--push", "1"]
    said = refused(["soma3", "--from", str(planned / "plan.json"), *late], capsys)
    assert "2 faults" in said and "--stability paper: comes too late for the plan" in said


def test_a_plan_for_more_hands(planned: Path, tmp_path: Path, capsys: Captured, never_planned: None) -> None:
    plan = read_json(AssemblyPlan, planned / "plan.json")
    write_json(replace(plan, options=replace(plan.options, hands=3)), tmp_path / "plan.json")
    said = refused(["soma3", "--from", "plan.json"], capsys)
    assert "was made for 3 hands; ur5e_pair has 2 arms" in said


def test_a_plan_of_another_assembly(planned: Path, capsys: Captured, never_planned: None) -> None:
    said = refused(["soma4", "--from", str(planned / "plan.json")], capsys)
    assert re.search(r"was made for another assembly: digest [0-9a-f]{12}, soma4 has [0-9a-f]{12}", said)


def test_a_plan_of_an_assembly_that_has_changed_since(
    planned: Path, tmp_path: Path, capsys: Captured, never_planned: None
) -> None:
    shutil.copytree(ROOT / "meshes/soma", tmp_path / "soma")
    file = tmp_path / "soma/soma3.toml"
    file.write_text(file.read_text().replace("density = 700.0", "density = 701.0"))
    assert "was made for another assembly" in refused(
        [str(file), "--from", str(planned / "plan.json")], capsys
    )


def test_a_plan_for_another_hand(
    planned: Path, tmp_path: Path, capsys: Captured, never_planned: None
) -> None:
    (tmp_path / "run").mkdir()
    plan = read_json(AssemblyPlan, planned / "plan.json")
    write_json(
        replace(plan, hands=("slim_hand", "other_hand"), hand_kinds=(0, 1)), tmp_path / "run/plan.json"
    )
    assert "was made for the hands slim_hand, other_hand, not slim_hand, slim_hand" in refused(
        ["soma3", "--from", "run/plan.json"], capsys
    )


def test_a_program_beside_another_plan(
    planned: Path, tmp_path: Path, capsys: Captured, never_planned: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    import soma_bullet.resume as resume

    (tmp_path / "run").mkdir()
    shutil.copy(planned / "plan.json", tmp_path / "run")
    (tmp_path / "run/program.npz").write_bytes(b"")
    plan = read_json(AssemblyPlan, planned / "plan.json")

    class Made(SimpleNamespace):
        """As much of a program as is looked at."""

    made = Made(digest=plan.digest, cell="ur5e_pair", order=("BigL", "Z", "smallL"))
    monkeypatch.setattr(resume, "Program", Made)
    monkeypatch.setattr(resume, "read_any", lambda kinds, path: made)
    said = refused(["soma3", "--from", "run/program.npz"], capsys)
    assert (
        "was made for another plan than the one beside it: BigL <- Z <- smallL, not Z <- BigL <- smallL"
        in said
    )
    made.cell = "other"
    assert "was made for the cell 'other', not 'ur5e_pair'" in refused(
        ["soma3", "--from", "run/program.npz"], capsys
    )
    (tmp_path / "run/plan.json").unlink()
    assert "its plan is missing: no file run/plan.json" in refused(
        ["soma3", "--from", "run/program.npz"], capsys
    )


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda text: "", "cannot be read as JSON"),
        (lambda text: text[: len(text) // 2], "cannot be read as JSON"),
        (lambda text: "[]", "is none of AssemblyPlan, Program, ExecutionLog"),
        (lambda text: text.replace('"schema": 1', '"schema": 9'), "is not a schema-1 file"),
        (lambda text: text.replace('"order": [', '"ordre": [', 1), "is not a AssemblyPlan"),
        (lambda text: text.replace('"way": ', '"way": "far", "was": ', 1), "is not a AssemblyPlan"),
    ],
)
def test_a_spoilt_plan(
    planned: Path,
    tmp_path: Path,
    capsys: Captured,
    never_planned: None,
    spoil: Callable[[str], str],
    said: str,
) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run/plan.json").write_text(spoil((planned / "plan.json").read_text()))
    assert said in refused(["soma3", "--from", "run/plan.json"], capsys)


@pytest.mark.parametrize("name", ["program.npz", "log.npz"])
@pytest.mark.parametrize("content", [EMPTY, b"PK\x03\x04 but no archive", b"\x93NUMPY\x01\x00"])
def test_a_spoilt_archive(
    planned: Path, tmp_path: Path, capsys: Captured, never_planned: None, name: str, content: bytes
) -> None:
    (tmp_path / "run").mkdir()
    shutil.copy(planned / "plan.json", tmp_path / "run")
    (tmp_path / "run" / name).write_bytes(content)
    assert f"run/{name}: cannot be read as " in refused(["soma3", "--from", f"run/{name}"], capsys)


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


# --- plan.json ----------------------------------------------------------------------------------------------


def test_plan_only_writes_the_plan_and_nothing_else(tmp_path: Path, capsys: Captured) -> None:
    assert run_episode(["soma3", "--plan-only"]) == 0
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "soma3: Z <- BigL <- smallL (equilibrium mode)" in captured.err
    assert "written to runs/soma3/plan.json" in captured.err
    assert [path.name for path in (tmp_path / "runs/soma3").iterdir()] == ["plan.json"]


def test_a_folder_with_brackets_is_not_read_as_markup(tmp_path: Path, capsys: Captured) -> None:
    assert run_episode(["soma3", "--plan-only", "--out", "run[red]1"]) == 0
    assert "written to run[red]1/plan.json" in capsys.readouterr().err
    assert (tmp_path / "run[red]1/plan.json").is_file()


@pytest.mark.parametrize("stability", ["equilibrium", "paper"])
def test_plan_json_says_everything(stability: str, tmp_path: Path) -> None:
    assert run_episode(["soma3", "--plan-only", "--stability", stability, "--out", "run"]) == 0
    text = (tmp_path / "run/plan.json").read_text()
    plan = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert plan["assembly"] == "soma3" and plan["schema"] == 1
    assert len(plan["order"]) == 3 and len(plan["orders"]) == math.factorial(3)
    keys = {"order", "s", "s_recomputed", "g", "a", "directions", "held", "score", "feasible"}
    for row in plan["orders"]:
        assert keys <= set(row)
        assert all(len(row[key]) == 3 for key in keys - {"score", "feasible"})
        values = [*row["s"], *row["s_recomputed"], *row["g"], *row["a"], row["score"]]
        assert all(isinstance(v, int | float) or v in ("inf", "-inf") for v in values)
    assert ('"inf"' in text) == (stability == "paper")  # a piece that stands alone is stable without bound
    assert "Infinity" not in text and "NaN" not in text
    assert plan["orders"][0]["feasible"] and plan["order"] == plan["orders"][0]["order"]
    assert [step["piece"] for step in plan["steps"]] == plan["order"]
    assert not re.search(r'"[^"]*(wall|seconds|elapsed|time|date)[^"]*"\s*:', text)
    assert str(ROOT) not in text and str(tmp_path) not in text


def test_the_same_seed_gives_the_same_plan_in_another_process(planned: Path, tmp_path: Path) -> None:
    command = [
        sys.executable,
        str(ROOT / "scripts/run_episode.py"),
        "soma3",
        "--plan-only",
        "--out",
        str(tmp_path / "again"),
    ]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONHASHSEED": "12345"}
    result = subprocess.run(
        command, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout == ""
    assert (tmp_path / "again/plan.json").read_bytes() == (planned / "plan.json").read_bytes()


def test_planning_on_from_a_plan_keeps_it(planned: Path, tmp_path: Path) -> None:
    assert run_episode(["soma3", "--plan-only", "--from", str(planned / "plan.json"), "--out", "again"]) == 0
    assert (tmp_path / "again/plan.json").read_bytes() == (planned / "plan.json").read_bytes()
