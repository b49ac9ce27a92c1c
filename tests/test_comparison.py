"""Two runs compared: counts against a count by hand, the test against the binomial, and runs that cannot be
compared."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom

from soma_bullet.errors import InputError
from soma_bullet.evaluation.compare import compare
from soma_bullet.evaluation.folder import LINES
from soma_bullet.evaluation.line import Line, blank_line
from soma_bullet.evaluation.options import EvaluationOptions
from soma_bullet.evaluation.statistics import Pairs, Rate, contrast

SCRIPT = Path(__file__).resolve().parents[1] / "scripts" / "compare_runs.py"


def line(
    seed: int, success: bool, went_in: tuple[bool, ...] = (True,), assembly: str = "soma3", **options: Any
) -> Line:
    """A line of which only what is compared has been filled in; insertions of Z, BigL, smallL in this
    order."""
    insertions = [
        {
            "piece": piece,
            "arm": "left",
            "peak_n": 1.0 + seed,
            "outcome": "as planned",
            "remaining_mm": 0.0,
            "went_in": well,
            "along_mm": 0.3,
            "across_mm": 0.4,
            "error_deg": 0.1,
            "neighbours_mm": 0.01 * seed,
        }
        for piece, well in zip(("Z", "BigL", "smallL"), went_in, strict=False)
    ]
    blank = blank_line(seed, EvaluationOptions(assembly, **options))
    pieces = [{"name": name, "error_mm": 0.1 * (seed + 1)} for name in ("BigL", "smallL", "Z")]
    return {
        **blank,
        "success": success,
        "insertions": insertions,
        "pieces": pieces,
        "makespan_s": 40.0 + seed,
    }


def write(folder: Path, lines: list[Line]) -> Path:
    folder.mkdir(parents=True)
    (folder / LINES).write_text("".join(json.dumps(one) + "\n" for one in lines))
    return folder


def test_episodes_are_paired_by_seed(tmp_path: Path) -> None:
    a = write(tmp_path / "a", [line(k, k in (0, 1)) for k in range(5)])
    b = write(tmp_path / "b", [line(k, k in (1, 2, 3)) for k in range(1, 7)])
    found = compare(a, b)
    assert (found.pairs.both, found.pairs.only_a, found.pairs.only_b, found.pairs.neither) == (1, 0, 2, 1)
    assert (found.unpaired_a, found.unpaired_b) == (1, 2)
    assert (found.rate_a.good, found.rate_b.good, found.rate_a.count) == (1, 3, 4)
    assert found.makespan_s.count == 1 and found.makespan_s.difference == 0.0
    assert not found.differences


def test_insertions_count_up_to_the_first_that_fails(tmp_path: Path) -> None:
    a = write(
        tmp_path / "a", [line(0, True, (True, False, True)), line(1, True, (True,)), line(2, False, (False,))]
    )
    b = write(
        tmp_path / "b",
        [line(0, True, (True, True, True)), line(1, True, (True, True)), line(2, True, (False,))],
    )
    found = compare(a, b).insertions
    assert found is not None
    assert [(pair.seed, pair.piece) for pair in found.compared] == [(0, "Z"), (0, "BigL"), (1, "Z"), (2, "Z")]
    assert (found.rescued.good, found.rescued.count) == (1, 2)
    assert (found.spoilt.good, found.spoilt.count) == (0, 1)
    assert (found.later, found.unpaired) == (1, 1)
    assert found.peak_a.largest == 3.0 and found.neighbours_a.largest == pytest.approx(0.02)
    assert found.compared[0].a.error_mm == pytest.approx(0.5)


def test_what_differs_is_named(tmp_path: Path) -> None:
    a = write(tmp_path / "a", [line(0, True, vary=())])
    b = write(tmp_path / "b", [line(0, True, vary=("feed",))])
    named = {d.name: (d.a, d.b) for d in compare(a, b).differences}
    assert named["--vary"] == ("none", "feed")


@given(st.integers(0, 40), st.integers(0, 40))
def test_mcnemar_is_a_fair_coin(only_a: int, only_b: int) -> None:
    p, count = Pairs(3, only_a, only_b, 4).p, only_a + only_b
    expected = 1.0 if only_a == only_b else min(1.0, 2 * float(binom.cdf(min(only_a, only_b), count, 0.5)))
    assert p == pytest.approx(expected)
    assert p == Pairs(9, only_b, only_a, 0).p


@given(st.lists(st.tuples(st.floats(-9, 9), st.floats(-9, 9)), min_size=1, max_size=60))
def test_the_interval_holds_the_median_and_turns_with_the_pair(values: list[tuple[float, float]]) -> None:
    found, turned = contrast(values), contrast([(b, a) for a, b in values])
    assert found.low <= found.difference <= found.high
    assert (turned.difference, turned.low, turned.high) == pytest.approx(
        (-found.difference, -found.high, -found.low)
    )


def test_the_interval_covers_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    hits = 0
    for sample in rng.normal(0.0, 1.0, (1000, 25)):
        found = contrast([(0.0, value) for value in sample])
        hits += found.low <= 0.0 <= found.high
    assert 0.94 <= hits / 1000 <= 0.99


def test_a_rate_of_nothing_says_nothing() -> None:
    assert Rate.of(0, 0) == Rate(0, 0, 0.0, 1.0)


def test_runs_that_cannot_be_compared(tmp_path: Path) -> None:
    a, empty = write(tmp_path / "a", [line(0, True)]), write(tmp_path / "empty", [])
    with pytest.raises(InputError, match=r"there is no episodes\.jsonl"):
        compare(a, tmp_path)
    with pytest.raises(InputError, match="has no lines"):
        compare(empty, a)
    with pytest.raises(InputError, match="no seed in common: 0 to 0 and 7 to 7"):
        compare(a, write(tmp_path / "late", [line(7, True)]))
    other = write(tmp_path / "other", [{**line(0, True), "digest": "f" * 64}])
    with pytest.raises(InputError, match="--any-assembly"):
        compare(a, other)
    assert compare(a, other, any_assembly=True).pairs.both == 1
    cube = write(
        tmp_path / "cube", [{**line(0, True), "digest": "0" * 64, "pieces": [{"name": "V", "error_mm": 0.1}]}]
    )
    with pytest.raises(InputError, match="pieces have different names"):
        compare(a, cube, any_assembly=True)


@pytest.mark.slow
def test_the_command_writes_a_table_a_file_and_a_picture(tmp_path: Path) -> None:
    a = write(tmp_path / "a", [line(k, k % 2 == 0, (True, k % 2 == 0)) for k in range(8)])
    b = write(tmp_path / "b", [line(k, True, (True, True)) for k in range(8)])
    command = [sys.executable, str(SCRIPT), str(a), str(b), "--out", str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "out" / "comparison.json").read_text())["pairs"] == {
        "both": 4, "only_a": 0, "only_b": 4, "neither": 0,
    }  # fmt: skip
    assert (tmp_path / "out" / "comparison.png").stat().st_size > 10_000
    bad = subprocess.run(
        [*command[:3], str(tmp_path), "--out", str(tmp_path / "no")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert bad.returncode == 2 and "episodes.jsonl" in bad.stderr and not (tmp_path / "no").exists()
