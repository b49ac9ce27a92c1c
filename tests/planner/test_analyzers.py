"""Analyzers of the user's own: found beside the user, checked, and blamed by name."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from textwrap import dedent

import pytest
from blocks import assembly, box

from soma_bullet.assembly.advice import Advice
from soma_bullet.errors import InputError
from soma_bullet.grasp.hand import Hand
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.planner import analyzers
from soma_bullet.planner.options import HoldLoad, PlannerOptions
from soma_bullet.planner.plan import NoPlanError, make_plan

SIDE = 0.02  # [m]
BLOCK = assembly([box((SIDE, SIDE, SIDE), "block")], [(0, 0, SIDE / 2)])
OWN = """
from soma_bullet.planner.analyzers import Judgement
def good(qualities, placed, piece): return Judgement(1.0)
def number(qualities, placed, piece): return 0.5
def none(qualities, placed, piece): return None
def few(qualities): return Judgement(1.0)
def raises(qualities, placed, piece): raise RuntimeError("made up")
def negative(qualities, placed, piece): return Judgement(-1.0)
def nan(qualities, placed, piece): return Judgement(float("nan"))
def never(qualities, placed, piece): return Judgement(0.0)
value = 3
"""


@pytest.fixture(autouse=True)
def beside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A module of analyzers in the working folder, which is not on the path."""
    (tmp_path / "my_analyzers.py").write_text(OWN, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry not in ("", ".")])
    sys.modules.pop("my_analyzers", None)


def test_a_module_in_the_working_folder_is_found(hand: Hand) -> None:
    plan = make_plan(BLOCK, HandSet.alike(hand), PlannerOptions(analyzers=("my_analyzers:good",)))
    assert plan.orders[0].extra == {"my_analyzers:good": (1.0,)}


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("my_analyzers:number", "returned 0.5; it must return a Judgement"),
        ("my_analyzers:none", "returned None"),
        ("my_analyzers:few", "raised TypeError: few() takes 1 positional argument"),
        ("my_analyzers:raises", "raised RuntimeError: made up (my_analyzers.py:7)"),
        ("my_analyzers:negative", "returned a quality of -1.0"),
        ("my_analyzers:nan", "returned a quality of nan"),
        ("my_analyzers:value", "is no function"),
        ("my_analyzers:absent", "has no 'absent'"),
        ("math:sqrt", "raised TypeError"),
        (":x", "must be module:function"),
        ("my_analyzers:", "is not known"),
        ("..:x", "cannot be imported"),
        ("no_such_module:x", "No module named 'no_such_module'"),
    ],
)
def test_what_is_no_analyzer_is_refused_by_name(name: str, says: str, hand: Hand) -> None:
    with pytest.raises(InputError, match=re.escape(says)) as caught:
        make_plan(BLOCK, HandSet.alike(hand), PlannerOptions(analyzers=(name,)))
    assert name in str(caught.value) and "--analyzer" in str(caught.value)


def test_a_zero_without_a_reason_is_blamed_on_its_analyzer(hand: Hand) -> None:
    with pytest.raises(NoPlanError, match="--analyzer my_analyzers:never says 0"):
        make_plan(BLOCK, HandSet.alike(hand), PlannerOptions(analyzers=("my_analyzers:never",)))


def test_the_example_of_the_documents_runs_as_it_stands(tmp_path: Path, hand: Hand) -> None:
    assert analyzers.__doc__ is not None
    lines = analyzers.__doc__.splitlines()
    example = dedent("\n".join(line for line in lines if line.startswith("    ") or not line))
    (tmp_path / "example.py").write_text(example, encoding="utf-8")
    sys.modules.pop("example", None)
    make_plan(BLOCK, HandSet.alike(hand), PlannerOptions(analyzers=("example:reach",)))


def test_what_an_assembly_asks_for_counts_where_nobody_asks_otherwise() -> None:
    advice = Advice(push=1.0, disturbance=0.2, stability="paper", analyzers=("grounded",))
    advised = PlannerOptions().advised(advice)
    assert (advised.load, advised.stability) == (HoldLoad(1.0, 0.2), "paper")
    assert advised.analyzers == ("grounded",)
    own = PlannerOptions(load=HoldLoad(3.0, 0.3), stability="my:own", analyzers=("my:step",))
    assert own.advised(advice) == own and PlannerOptions().advised(Advice()) == PlannerOptions()
