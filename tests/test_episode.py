"""Whole episodes in physics: the three blocks stand, the log gives the same verdict again, and without the
hold they fall."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from soma_bullet import episode
from soma_bullet.assembly.file import load_assembly
from soma_bullet.episode import run_episode
from soma_bullet.errors import NoSolutionError
from soma_bullet.options import EpisodeOptions
from soma_bullet.pictures.options import FilmOptions
from soma_bullet.records import VERSIONED, read_npz, to_tree
from soma_bullet.report.report import EpisodeReport
from soma_bullet.robot.cell import load_cell
from soma_bullet.task.program import orders
from soma_bullet.task.program.program import Program
from soma_bullet.world.log import ExecutionLog

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("episode")]
FILM = FilmOptions((320, 180), fps=5.0, speed=8.0, supersampling=1, jobs=1)
COLLAPSED = 5.0  # [mm]; a piece in place is within 2


@dataclass(frozen=True)
class Run:
    """An episode that was run, and where its files are."""

    folder: Path
    report: EpisodeReport

    @property
    def log(self) -> ExecutionLog:
        return read_npz(ExecutionLog, self.folder / "log.npz")


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("episode") / "soma3"
    said: list[tuple[str, float]] = []
    report = run_episode(
        "soma3", EpisodeOptions(seed=0, film=FILM), folder, progress=lambda *row: said.append(row)
    )
    assert report is not None
    assert all(0.0 <= fraction <= 1.0 for _, fraction in said) and len({what for what, _ in said}) > 20
    return Run(folder, report)


@pytest.fixture(scope="module")
def ablated(built: Run, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The very same program, with the assisting hand opened where it should hold."""
    folder = tmp_path_factory.mktemp("ablated")
    report = run_episode("soma3", EpisodeOptions(seed=0, ablate="hold"), folder, built.folder / "program.npz")
    assert report is not None
    return Run(folder, report)


# --- the three blocks stand ---------------------------------------------------------------------------------


def test_three_blocks_are_built(built: Run) -> None:
    report = built.report
    assert report.success, report.judgement.causes
    assert report.judgement.causes == () == report.judgement.dropped == report.judgement.forbidden
    for piece in report.pieces:
        assert piece.in_place and piece.error_mm <= 2.0 and piece.error_deg <= 2.0
        assert piece.error_mm <= piece.error_max_mm
    assert built.log.ended == "done"


def test_files_are_written(built: Run) -> None:
    names = {"plan.json", "program.npz", "log.npz", "report.json", "episode.mp4", "still.png"}
    assert {path.name for path in built.folder.iterdir()} == names
    assert all((built.folder / name).stat().st_size > 1000 for name in names)


def test_the_report_says_everything(built: Run) -> None:
    text = (built.folder / "report.json").read_text(encoding="utf-8")
    report = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert report["success"] is True and (report["assembly"], report["cell"], report["seed"]) == (
        "soma3",
        "ur5e_pair",
        0,
    )
    assert [
        set(piece) >= {"name", "error_mm", "error_max_mm", "error_deg"} for piece in report["pieces"]
    ] == [True] * 3
    assert {"slips", "holds", "forbidden", "insertions", "dropped", "limits", "causes"} <= set(
        report["judgement"]
    )
    assert (
        len(report["judgement"]["slips"]) >= len(report["judgement"]["insertions"]) == 3
    )  # a piece may be gripped twice
    assert 10.0 < report["makespan_s"] < 90.0
    planned = report["planned_s"]
    assert planned["together"] < planned["one at a time"] <= planned["as scheduled"]
    assert {"load", "plan", "motion", "execution", "judgement", "video"} == set(report["wall_s"])
    assert all(seconds >= 0.0 for seconds in report["wall_s"].values())
    assert set(report["versions"]) == set(VERSIONED)
    assert report["video"]["file"] == "episode.mp4" and report["video"]["renderer"]
    assert report["ablation"] == "" and sorted(report["order"]) == sorted(load_assembly("soma3").names)


def test_grips_do_not_slip_and_holds_do_not_drift(built: Run) -> None:
    judgement = built.report.judgement
    assert max(slip.slip_mm for slip in judgement.slips) < 1.0
    assert max(hold.seconds for hold in judgement.holds if hold.piece == "Z") > 1.0
    for hold in judgement.holds:
        assert hold.drift_mm < 1.0 and hold.grip_n > 10.0
    assert all(
        insertion.peak_n < 10.0 and insertion.outcome != "jammed" for insertion in judgement.insertions
    )


def test_limits_are_kept(built: Run) -> None:
    assert built.report.judgement.limits.joint_deg > 0.0
    assert 0.1 < built.report.judgement.limits.speed <= 1.05


def test_only_gears_were_in_the_world(built: Run) -> None:
    arms = load_cell("ur5e_pair").arms
    assert sorted(built.log.constraints) == sorted(
        f"gear: {a} - {b}" for a, b in (arm.finger_joints for arm in arms)
    )


def test_pieces_moved_only_as_fast_as_hands(built: Run) -> None:
    """Nothing is teleported: between two samples no piece gets farther than a fast hand would."""
    log = built.log
    steps = np.linalg.norm(np.diff(log.poses[:, :, :3], axis=0), axis=2) / np.diff(log.times)[:, None]
    assert steps.max() < 2.5  # [m/s]


def test_pieces_start_where_they_were_fed(built: Run) -> None:
    program, log = read_npz(Program, built.folder / "program.npz"), built.log
    for name in log.piece_names:
        np.testing.assert_allclose(log.piece_pose(0, name)[:3, 3], program.feed.pose(name)[:3, 3], atol=2e-4)


def test_the_last_two_seconds_are_rest(built: Run) -> None:
    log = built.log
    last = log.between(log.times[-1] - 1.0, log.times[-1])
    assert np.abs(np.diff(log.poses[last, :, :3], axis=0)).max() < 1e-5
    assert log.segments[-1].kind == "final" and log.segments[-1].end - log.segments[
        -1
    ].start == pytest.approx(2.0, abs=0.01)
    assert log.grips[last].max() == 0.0


# --- again, from files --------------------------------------------------------------------------------------


def test_a_log_is_judged_again_to_the_same_numbers(
    built: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:

    for name in ("kept_plan", "program_of_best_order", "executed", "Workcell"):
        monkeypatch.setattr(episode, name, lambda *_, **__: pytest.fail("it planned or simulated"))
    again = run_episode("soma3", EpisodeOptions(seed=0), tmp_path, built.folder / "log.npz")
    assert again is not None
    assert to_tree(again.judgement) == to_tree(built.report.judgement)
    assert (again.pieces, again.makespan_s, again.order) == (
        built.report.pieces,
        built.report.makespan_s,
        built.report.order,
    )
    assert "execution" not in again.wall_s


def test_a_log_is_judged_by_another_tolerance(built: Run) -> None:
    from soma_bullet.verdict.options import Tolerance

    again = run_episode(
        "soma3", EpisodeOptions(tolerance=Tolerance(1e-6, 1e-6)), None, built.folder / "log.npz"
    )
    assert again is not None and not again.success
    assert len([cause for cause in again.judgement.causes if "from its goal" in cause]) == 3
    assert [piece.error_mm for piece in again.pieces] == [piece.error_mm for piece in built.report.pieces]


# --- the hold matters ---------------------------------------------------------------------------------------


def test_without_the_hold_it_collapses(built: Run, ablated: Run) -> None:
    report = ablated.report
    assert not report.success and report.ablation == "hold"
    assert max(piece.error_mm for piece in report.pieces) > COLLAPSED, report.pieces
    assert report.order == built.report.order
    assert [s.kind for s in ablated.log.segments].count("ablation") >= 1


def test_until_the_hold_the_ablation_is_the_same_episode(built: Run, ablated: Run) -> None:
    full, cut = built.log, ablated.log
    start = next(s.start for s in cut.segments if s.kind == "ablation")
    samples = full.between(0.0, start - 0.02)
    assert len(samples) > 100
    assert full.poses[samples].tobytes() == cut.poses[samples].tobytes()
    assert full.joints[samples].tobytes() == cut.joints[samples].tobytes()


@pytest.mark.parametrize(
    ("scores", "expected"),
    [
        ((1.0, 0.5, 1e-3, 1e-4), [(0, 1), (1, 1), (0, 3), (1, 3), (2, 1), (3, 1)]),
        ((1.0, 0.5), [(0, 1), (1, 1), (0, 3), (1, 3)]),
    ],
)
def test_better_orders_are_searched_again_before_far_worse_ones(
    scores: tuple[float, ...], expected: list[tuple[int, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    plans = [SimpleNamespace(order=(str(k),), score=score, options=None) for k, score in enumerate(scores)]

    def next_best(
        assembly: object, hand: object, options: object, excluded: frozenset[tuple[str, ...]]
    ) -> object:
        if len(excluded) == len(plans):
            raise NoSolutionError("plan", "no order is left")
        assert excluded == {plan.order for plan in plans[: len(excluded)]}
        return plans[len(excluded)]

    monkeypatch.setattr(orders, "kept_plan", next_best)
    workcell: Any = SimpleNamespace(assembly=None, cell=SimpleNamespace(hands=None))
    found = orders._candidates(workcell, plans[0], 12)  # type: ignore[arg-type]
    tried = [(int(plan.order[0]), times) for plan, times in found]
    assert tried == expected
