"""The report: what a person reads, and the same again from its file."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from soma_bullet.records import package_versions, read_json, write_json
from soma_bullet.report.report import EpisodeReport, print_report
from soma_bullet.verdict.judge import (
    ForbiddenContact,
    GraspSlip,
    HoldDrift,
    InsertionForce,
    Judgement,
    Limits,
    PieceVerdict,
)
from soma_bullet.verdict.options import Tolerance
from soma_bullet.world.log import Event


@pytest.fixture
def report() -> EpisodeReport:
    pieces = (PieceVerdict("Z", 0.1234, 0.5678, 0.21, True), PieceVerdict("BigL", 0.02, 0.03, 0.04, True))
    judgement = Judgement(
        success=True,
        causes=(),
        pieces=pieces,
        slips=(GraspSlip("Z", "right", 0.07, 0.1), GraspSlip("BigL", "left", 0.31, 0.2)),
        holds=(HoldDrift("Z", "right", 8.25, 0.015, 0.01, 19.5),),
        forbidden=(),
        insertions=(InsertionForce("Z", "right", 1.3, "stopped early", 0.2),),
        dropped=(),
        limits=Limits(12.0, 0.97),
        makespan_s=29.3,
    )
    return EpisodeReport(
        success=True,
        pieces=pieces,
        assembly="soma3",
        digest="0123",
        cell="ur5e_pair",
        order=("Z", "BigL"),
        stability="equilibrium",
        seed=5,
        ablation="",
        tolerance=Tolerance(),
        judgement=judgement,
        feed_rejected={"overlap": 2},
        rejections={"Z: right arm does not reach the goal": 3},
        certificates={"Z": 17.6},
        makespan_s=29.3,
        planned_s={"together": 28.0, "one at a time": 40.0, "as scheduled": 50.0},
        events=(Event(4.5, "trouble", "Z", "Z lost in grasp"),),
        notes=("the program was made with seed 3",),
        wall_s={"plan": 0.4, "execution": 7.0},
        video={"file": "", "renderer": "", "note": ""},
        versions=package_versions(),
    )


def printed(report: EpisodeReport) -> str:
    console = Console(file=io.StringIO(), width=160)
    print_report(report, console)
    return console.file.getvalue()  # type: ignore[attr-defined, no-any-return]


def test_a_success_reads_like_one(report: EpisodeReport) -> None:
    text = printed(report)
    assert "soma3, seed 5: Z <- BigL" in text
    (row,) = [line for line in text.splitlines() if line.startswith("│ Z")]
    assert [cell.strip() for cell in row.split("│")[1:-1]] == ["Z", "0.12", "0.57", "0.21", "yes"]
    assert "success" in text and "failure" not in text
    assert "0.31 mm, 0.20 deg (BigL, left hand)" in text  # the largest slip, not the first
    assert "right held Z" in text and "8.2 s, drift 0.01 mm, grip at least 20 N" in text
    assert "peak 1.3 N at the right wrist, stopped early" in text
    assert (
        "29.3 s simulated; planned 28.0 s, 44% less than 50.0 s as scheduled, 30% less than 40.0 s with "
        "one arm" in text
    )
    assert "4.5 s   trouble: Z Z lost in grasp" in text and "execution 7.0 s" in text


def test_a_failure_says_why(report: EpisodeReport) -> None:
    bad = replace(report.pieces[0], error_mm=31.0, in_place=False)
    causes = ("Z is 31.00 mm and 0.21 deg from its goal", "left_palm touched table at 3.00 s (4.0 N)")
    forbidden = (ForbiddenContact("left_palm", "table", 3.0, 2, 4.0),)
    judgement = replace(report.judgement, success=False, causes=causes, forbidden=forbidden)
    text = printed(replace(report, success=False, pieces=(bad, report.pieces[1]), judgement=judgement))
    assert "failure" in text and "success" not in text
    assert all(cause in text for cause in causes)
    assert [line.split("│")[-2].strip() for line in text.splitlines() if line.startswith("│ ")] == [
        "no",
        "yes",
    ]


def test_an_episode_that_broke_off_at_once_can_be_printed(report: EpisodeReport) -> None:
    judgement = replace(
        report.judgement, success=False, causes=("Z lost in grasp",), slips=(), holds=(), insertions=()
    )
    assert "Z lost in grasp" in printed(replace(report, success=False, judgement=judgement))


def test_a_report_survives_its_file(report: EpisodeReport, tmp_path: Path) -> None:
    write_json(report, tmp_path / "report.json")
    assert read_json(EpisodeReport, tmp_path / "report.json") == report
