"""The planner's command line: everything in one run, refusals that cost nothing, reasons where no plan
exists."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from soma_bullet.cli.plan import plan
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.records import read_json

ROOT = Path(__file__).resolve().parents[1]
Captured = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def said(capsys: Captured) -> str:
    """What went to stderr, in one line; stdout stays clean."""
    captured = capsys.readouterr()
    assert captured.out == ""
    return re.sub(r"[\s│├└─]+", " ", captured.err)


@pytest.mark.slow
def test_one_run_plans_explains_draws_and_writes(capsys: Captured) -> None:
    arguments = [
        "soma3",
        "--stability",
        "paper",
        "--top",
        "2",
        "--explain",
        "--figure",
        "orders.svg",
        "--rows",
        "2",
    ]
    assert plan([*arguments, "--exploded", "exploded.png", "--out", "plan.json"]) == 0
    text = said(capsys)
    assert "chosen Z <- BigL <- smallL, score 351" in text
    assert "2. BigL <- Z <- smallL" in text
    assert re.search(r"a hand stays on Z: \d+ assisting grasps; number \d+ takes [\d.]+ x the load", text)
    assert "paper mode calls {smallL, Z} stable (smallL 0.087, Z 1.516), but it falls" in text
    assert "exact: all 6 orders were compared" in text
    found = read_json(AssemblyPlan, Path("plan.json"))
    assert found.order == ("Z", "BigL", "smallL") and len(found.alternatives) == 1 and len(found.orders) == 6
    assert "smallL" in Path("orders.svg").read_text()
    assert Path("exploded.png").read_bytes().startswith(b"\x89PNG")


def test_reasons_are_counted_most_frequent_first(capsys: Captured) -> None:
    assert plan(["soma4", "--explain"]) == 0
    text = said(capsys)
    assert "22 of 24 orders are ruled out" in text and "grounded: 22 orders" in text
    assert text.index("6 orders: A into {}") < text.index("2 orders: A into {V}: would hang in the air")


def test_what_falls_and_what_cannot_be_held_is_told(capsys: Captured) -> None:
    assert plan(["soma3", "--explain"]) == 0
    assert "{smallL, Z} falls before BigL: alone it resists 0.000 g" in said(capsys)
    assert plan(["soma4", "--stability", "paper", "--explain"]) == 0
    text = said(capsys)
    assert re.search(r"\{\w+\} in \{[\w, ]+\} cannot be gripped clear of \w+", text)


def test_no_plan_says_why_and_writes_nothing(capsys: Captured) -> None:
    assert plan(["soma3", "--hands", "1", "--explain", "--out", "plan.json", "--figure", "orders.png"]) == 3
    text = said(capsys)
    assert "6 of 6 orders are ruled out" in text and "there is no hand to spare" in text
    assert list(Path.cwd().iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["soma3", "--hands", "0", "--top", "0"],
            r"2 faults - --hands 0: must be at least 1 - --top 0: must be at least 1",
        ),
        (["soma3", "--figure", "orders.jpg"], r"--figure orders.jpg: must end in .png or .svg or .pdf"),
        (["soma3", "--out", "none/plan.json"], r"--out none/plan.json: there is no folder"),
        (["soma3", "--out", "plan.txt"], r"--out plan.txt: must end in .json"),
        (["soma3", "--push", "nan"], r"--push nan: must not be negative"),
        (
            ["soma3", "--stability", "papr"],
            r"--stability: 'papr' is not known; there are equilibrium, paper, and your own",
        ),
        (["soma3", "--analyzer", "no_such_module:reach"], r"module 'no_such_module' cannot be imported"),
        (["soma3", "--analyzer", "json:reach"], r"module 'json' has no 'reach'"),
        (["soma3", "--analyzer", "json:__doc__"], r"'json:__doc__' is no function"),
        (["soma3", "--hand", "claw"], r"claw: no such hand; tried .*known hands: .*ur5e_pair"),
        (["soma9"], r"there is no such assembly"),
    ],
)
def test_bad_input_is_named(arguments: list[str], message: str, capsys: Captured) -> None:
    assert plan(arguments) == 2
    text = said(capsys)
    assert re.search(message, text), text
    assert "Traceback" not in text and list(Path.cwd().iterdir()) == []


ANALYZERS = '''
from soma_bullet.planner.analyzers import Judgement, equilibrium

def low(qualities, placed, piece):
    """Pieces that end up high are hard to reach."""
    height = float(qualities.assembly.goal_centres[piece][2])
    late = qualities.assembly.names[piece] == "BigL" and len(placed) == 1
    if late:
        return Judgement(0.0, f"BigL must not be second, its goal is {height:.3f} m up")
    return Judgement(2.0)

def doubtful(qualities, placed, held):
    """Half of what equilibrium says."""
    judgement = equilibrium(qualities, placed, held)
    return Judgement(judgement.quality / 2, judgement.reason, judgement.verdict)
'''


def test_analyzers_of_ones_own_plug_in_by_name(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(ANALYZERS)
    command = [sys.executable, str(ROOT / "scripts/plan.py"), "soma3", "--explain", "--out", "plan.json"]
    options = ["--analyzer", "mine:low", "--stability", "mine:doubtful"]
    environment = {"PYTHONPATH": f"{tmp_path}:{ROOT}", "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)}
    run = subprocess.run(
        [*command, *options],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    text = re.sub(r"[\s│├└─]+", " ", run.stderr)
    assert "mine:low: 2 orders" in text and "BigL into {Z}: BigL must not be second" in text
    found = json.loads((tmp_path / "plan.json").read_text())
    assert found["order"] == ["BigL", "Z", "smallL"]
    best = found["orders"][0]
    assert best["extra"] == {"mine:low": [2.0, 2.0, 2.0]}
    # half the S, twice the score of the further analyzer: the score of equilibrium mode
    assert best["s_recomputed"][2] == pytest.approx(9 / 59 / 2, abs=1e-6)
    assert best["score"] == pytest.approx(min(best["s_recomputed"]) * min(best["g"]) * min(best["a"]) * 2)
