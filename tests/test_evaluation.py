"""Evaluations: the draws, the lines, and the numbers in the end."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from soma_bullet.control.options import ExecutionOptions
from soma_bullet.errors import InputError, NoSolutionError
from soma_bullet.evaluation import line as running
from soma_bullet.evaluation.line import (
    EPISODE_PARTS,
    PATIENCE,
    Line,
    categorise,
    crashed_line,
    options_of,
    run_line,
)
from soma_bullet.evaluation.options import Spread, draw, episode_options
from soma_bullet.evaluation.statistics import wilson
from soma_bullet.evaluation.summary import summarise
from soma_bullet.options import EpisodeOptions
from soma_bullet.planner.options import HoldLoad, PlannerOptions
from soma_bullet.task.search_options import SearchOptions
from soma_bullet.verdict.options import Tolerance
from soma_bullet.world.options import Physics
from tests.canned import SOMA3, canned

EVERYTHING = ("friction", "mass", "perception", "feed")

# --- what varies --------------------------------------------------------------------------------------------


def test_draws_depend_on_the_seed_alone() -> None:
    both = replace(SOMA3, vary=("mass", "friction"))
    assert draw(3, both) == draw(3, both) != draw(4, both)
    assert draw(3, replace(SOMA3, vary=("mass",))) == {"mass": draw(3, both)["mass"]}
    assert draw(3, SOMA3) == {}
    assert draw(3, both)["mass"] != draw(3, both)["friction"]


def test_draws_fill_their_spread() -> None:
    options = replace(SOMA3, vary=("friction",), spread=Spread(friction=0.2))
    drawn = np.array([draw(seed, options)["friction"] for seed in range(400)])
    assert 0.8 <= drawn.min() < 0.81 and 1.19 < drawn.max() <= 1.2
    assert abs(drawn.mean() - 1.0) < 0.02 and abs(drawn.std() - 0.4 / np.sqrt(12)) < 0.01


def test_what_varies_reaches_the_episode() -> None:
    varied = episode_options(5, replace(SOMA3, vary=EVERYTHING, spread=Spread(mm=0.7, deg=0.3)))
    assert (varied.feed.layout, varied.feed.poses, varied.feed.noise_mm, varied.feed.noise_deg) == (
        "random",
        "all",
        0.7,
        0.3,
    )
    assert varied.physics.friction != 1.0 != varied.physics.mass and varied.seed == 5
    plain = episode_options(5, replace(SOMA3, vary=()))
    assert (plain.feed.poses, plain.feed.noise_mm, plain.physics.friction, plain.physics.mass) == (
        "preferred",
        0.0,
        1.0,
        1.0,
    )


def test_options_reach_the_episode_and_come_back_from_its_line() -> None:
    common = EpisodeOptions(
        planner=PlannerOptions(stability="paper", load=HoldLoad(push=1.0)), tolerance=Tolerance(1.0, 3.0),
        ablate="hold", execution=ExecutionOptions(together=False, recover=False),
        physics=Physics(gravity=5.0), search=SearchOptions(orders=3),
    )  # fmt: skip
    options = replace(SOMA3, vary=EVERYTHING, episode=common)
    episode = episode_options(2, options)
    assert (episode.planner.stability, episode.tolerance, episode.ablate) == (
        "paper",
        Tolerance(1.0, 3.0),
        "hold",
    )
    assert (episode.execution.together, episode.execution.compliant, episode.execution.recover) == (
        False,
        True,
        False,
    )
    assert (episode.planner.load.push, episode.physics.gravity, episode.search.orders) == (1.0, 5.0, 3)
    line = json.loads(json.dumps(canned(2, options)))
    assert options_of(line, "here") == episode
    assert {"cell", "hand", "seed", "ablate", *EPISODE_PARTS} == set(line["episode"])
    line["episode"]["physics"]["magic"] = 1
    with pytest.raises(InputError, match="not of this version"):
        options_of(line, "here")


# --- one line -----------------------------------------------------------------------------------------------


def ends_with(monkeypatch: pytest.MonkeyPatch, error: Exception) -> Line:
    def run_episode(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(running, "run_episode", run_episode)
    return run_line(0, SOMA3)


def test_an_episode_without_a_schedule_is_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    line = ends_with(
        monkeypatch, NoSolutionError("schedule", "none of 3 orders", Counter({"A: no grasp": 2}))
    )
    assert (line["success"], line["cause"], line["causes"]) == (
        False,
        "no schedule",
        ["none of 3 orders", "2 x A: no grasp"],
    )


def test_a_crash_is_a_line_that_says_where(monkeypatch: pytest.MonkeyPatch) -> None:
    line = ends_with(monkeypatch, ZeroDivisionError("at last"))
    assert line["cause"] == "crash"
    assert line["causes"][0].startswith("ZeroDivisionError: at last (test_evaluation.py:")


def test_an_episode_that_goes_on_and_on_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    def run_episode(*_: object, progress: Any, **__: object) -> None:
        for _ in range(PATIENCE + 1):
            progress("left: place A", 0.5)

    monkeypatch.setattr(running, "run_episode", run_episode)
    assert (line := run_line(0, SOMA3))["cause"] == "endless" and "left: place A" in line["causes"][0]


@pytest.mark.parametrize(
    ("ended", "cause"),
    [
        ("A jammed in place", "jammed"),
        ("A lost in grasp; none of 3 orders", "lost"),
        ("A, B fell; A: no grasp", "fell"),
        ("A: transfer cannot be made from the measured joints: budget", "no motion"),
        ("something new", "stopped"),
    ],
)
def test_how_the_executive_ended_is_the_cause(ended: str, cause: str) -> None:
    verdict = SimpleNamespace(dropped=("A",), pieces=(), forbidden=())
    assert categorise(verdict, ended) == cause  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("dropped", "in_place", "forbidden", "cause"),
    [
        (("A",), False, (1,), "fell"),
        ((), False, (1,), "not in place"),
        ((), True, (1,), "forbidden contact"),
        ((), True, (), "limits"),
    ],
)
def test_otherwise_it_is_how_the_pieces_lie(
    dropped: tuple, in_place: bool, forbidden: tuple, cause: str
) -> None:
    verdict = SimpleNamespace(
        dropped=dropped, pieces=(SimpleNamespace(in_place=in_place),), forbidden=forbidden
    )
    assert categorise(verdict, "done") == cause  # type: ignore[arg-type]


# --- the summary --------------------------------------------------------------------------------------------


def test_the_interval_is_wilsons() -> None:
    n, k, z = 20, 17, 1.959964
    p = k / n
    middle, half = (p + z**2 / (2 * n)), z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    assert np.allclose(
        wilson(k, n), [(middle - half) / (1 + z**2 / n), (middle + half) / (1 + z**2 / n)], atol=1e-4
    )
    assert wilson(5, 5)[1] == 1.0 and wilson(0, 5)[0] == 0.0


def test_the_summary_counts() -> None:
    lines = [canned(seed, SOMA3) for seed in SOMA3.seeds]
    lines.append(crashed_line(6, SOMA3, "why"))
    summary = summarise(lines)
    assert (summary["episodes"], summary["successes"]) == (7, 4)
    assert summary["causes"] == {"jammed": 2, "crash": 1} and summary["failed_seeds"] == {
        "crash": [6],
        "jammed": [1, 4],
    }
    assert (summary["recoveries"], summary["retries"], summary["recovered_episodes"]) == (1, 6, 4)
    errors = [line["pieces"][0]["error_mm"] for line in lines[:6]]
    assert summary["executed"]["error_mm"] == pytest.approx(
        {
            "count": 6,
            "mean": np.mean(errors),
            "median": np.median(errors),
            "p95": np.percentile(errors, 95),
            "max": max(errors),
        },
        abs=1e-4,
    )
    assert summary["successful"]["error_mm"]["count"] == 4 and summary["executed"]["drift_mm"] == {"count": 0}
    assert summary["executed"]["makespan_s"]["max"] == 25.0
    assert summary["executed"]["saved_percent"]["max"] == pytest.approx(100 * 5 / 20, abs=1e-3)
    assert summary["executed"]["saved_of_scheduled_percent"]["max"] == pytest.approx(100 * 15 / 30, abs=1e-3)
    json.dumps(summary, allow_nan=False)


def test_a_summary_of_crashes_alone() -> None:
    summary = summarise([crashed_line(0, SOMA3, "why")])
    assert (
        summary["success_rate"] == 0.0
        and summary["wall_s"] == {}
        and summary["executed"]["error_mm"] == {"count": 0}
    )
