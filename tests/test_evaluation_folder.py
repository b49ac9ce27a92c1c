"""Evaluations: going on in a folder, what is kept there, and what is refused."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from soma_bullet.control.options import ExecutionOptions
from soma_bullet.errors import InputError
from soma_bullet.evaluation.evaluate import Watch, evaluate
from soma_bullet.evaluation.folder import LINES, read_lines
from soma_bullet.evaluation.line import (
    Line,
)
from soma_bullet.evaluation.options import EvaluationOptions, Spread
from soma_bullet.options import EpisodeOptions
from soma_bullet.pictures.options import FilmOptions
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.task.feed_options import FeedOptions
from soma_bullet.verdict.options import Tolerance
from soma_bullet.world.options import Physics
from tests.canned import SOMA3, canned, leave


def common(**options: Any) -> dict[str, Any]:
    """What all episodes have in common, as a change of the options of an evaluation."""
    return {"episode": EpisodeOptions(**options)}


def test_a_run_goes_on_where_it_stopped(tmp_path: Path) -> None:
    leave(SOMA3, tmp_path / "whole")
    whole = evaluate(SOMA3, 1, tmp_path / "whole", episode=canned)
    leave(replace(SOMA3, episodes=3), tmp_path / "parts")
    file = tmp_path / "parts" / LINES
    file.write_text(file.read_text() + file.read_text().splitlines()[0][:200])  # cut off while it was written
    found: list[int] = []
    new: list[int] = []
    watch = Watch(
        lambda lines: found.extend(line["seed"] for line in lines), lambda line: new.append(line["seed"])
    )
    assert evaluate(SOMA3, 1, tmp_path / "parts", watch, episode=canned) == whole
    assert found == [0, 1, 2] and sorted(new) == [3, 4, 5]
    assert file.read_bytes() == (tmp_path / "whole" / LINES).read_bytes()


def test_seeds_beyond_those_asked_for_are_kept(tmp_path: Path) -> None:
    leave(SOMA3, tmp_path)
    summary, lines = evaluate(replace(SOMA3, episodes=2, seed=1), 1, tmp_path, episode=canned)
    assert summary["seeds"] == [1, 2] == [line["seed"] for line in lines]
    assert [line["seed"] for line in read_lines(tmp_path / LINES)] == list(range(6))


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"vary": ("friction", "feed")}, "--vary: feed there, friction,feed here"),
        (common(tolerance=Tolerance(1.0, 2.0)), "--tolerance-mm: 2.0 there, 1.0 here"),
        (common(planner=PlannerOptions(stability="paper")), "--stability: equilibrium there, paper here"),
        (common(ablate="hold"), "--ablate: none there, hold here"),
        (
            common(execution=ExecutionOptions(recover=False)),
            "--execution.recover: True there, False here",
        ),
        (common(feed=FeedOptions(layout="rows")), "--feed.layout: random there, rows here"),
        (common(physics=Physics(asleep=0.0)), "--physics.asleep: 1e-06 there, 0.0 here"),
        ({"assembly": "soma4"}, "assembly: soma3 .* there, soma4 .* here"),
    ],
)
def test_another_evaluation_in_the_same_folder_is_refused(changed: dict, said: str, tmp_path: Path) -> None:
    leave(replace(SOMA3, episodes=1), tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(InputError, match=said):
        evaluate(replace(SOMA3, **changed), 1, tmp_path, episode=canned)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (replace(SOMA3, spread=Spread(mass=0.1)), "--spread.mass: mass does not vary, see --vary"),
        (replace(SOMA3, vary=("luck",)), "--vary luck: 'luck' is none of friction"),
        (replace(SOMA3, **common(feed=FeedOptions(noise_mm=1.0))), "must be left alone"),
        (replace(SOMA3, **common(film=FilmOptions())), "no episode of an evaluation is filmed"),
        (replace(SOMA3, **common(planner=PlannerOptions(stability="luck"))), "'luck' is not known"),
        (replace(SOMA3, seed=2**31 - 6, episodes=7), "--episodes 7: the last seed must be from 0"),
    ],
)
def test_options_that_no_evaluation_could_use(options: EvaluationOptions, said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(said)):
        evaluate(options, 1, tmp_path / "out", episode=canned)
    assert not (tmp_path / "out").exists()


def test_the_order_of_what_varies_does_not_matter() -> None:
    assert (
        replace(SOMA3, vary=("feed", "mass")).conditions()
        == replace(SOMA3, vary=("mass", "feed")).conditions()
    )


def test_lines_of_another_version_are_refused(tmp_path: Path) -> None:
    (line,) = leave(replace(SOMA3, episodes=1), tmp_path)
    line["versions"]["pybullet"] = "1.0"
    (tmp_path / LINES).write_text(json.dumps(line) + "\n")
    with pytest.raises(InputError, match="version of pybullet: 1.0 there"):
        evaluate(SOMA3, 1, tmp_path, episode=canned)
    (tmp_path / LINES).write_text('{"seed": 0, "success": true}\n')
    with pytest.raises(InputError, match="older version"):
        evaluate(SOMA3, 1, tmp_path, episode=canned)


def test_a_folder_that_cannot_be_one(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="--out: .* cannot be written"):
        evaluate(SOMA3, 1, tmp_path / "file", episode=canned)


def test_two_evaluations_do_not_write_into_one_folder(tmp_path: Path) -> None:
    def second(lines: list[Line]) -> None:
        with pytest.raises(InputError, match="another evaluation is writing into"):
            evaluate(SOMA3, 1, tmp_path, episode=canned)

    leave(replace(SOMA3, episodes=1), tmp_path)
    evaluate(replace(SOMA3, episodes=1), 1, tmp_path, Watch(found=second), episode=canned)
