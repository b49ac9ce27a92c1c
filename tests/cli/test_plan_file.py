"""plan.json: what it says, and that it is the same again; stdout stays clean."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from soma_bullet.cli.episode import run_episode
from tests.cli.refused import Captured

ROOT = Path(__file__).resolve().parents[2]


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
