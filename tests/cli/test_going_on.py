"""An episode goes on from a plan in a file, and refuses files that do not fit, or are spoilt."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from soma_bullet.cli.episode import run_episode
from soma_bullet.cli.plan import plan
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.records import read_json, write_json
from tests.cli.refused import Captured, refused

ROOT = Path(__file__).resolve().parents[2]
EMPTY = b""


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
