"""The words of the film follow the log, and stay long enough to be read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.pictures.caption import holds, narration, phases, says, vector
from soma_bullet.pictures.crew import Shot
from soma_bullet.pictures.views import HOLD
from soma_bullet.robot.model import Cell
from soma_bullet.world.log import ExecutionLog
from tests.pictures.logs import EPISODE, made_log


def test_phases_join_what_a_viewer_sees_as_one(log: ExecutionLog) -> None:
    found = [(p.kind, p.arm, p.piece) for p in phases(log)]
    assert found[:4] == [
        ("pick", "right", "Z"),
        ("bring", "right", "Z"),
        ("insert", "right", "Z"),
        ("pick", "left", "BigL"),
    ]
    assert found[-3:] == [("release", "left", "BigL"), ("home", "right", "Z"), ("final", "", "")]
    np.testing.assert_allclose(phases(log)[2].direction, np.array((0, 1, -1)) / np.sqrt(2))


def test_phases_of_two_arms_may_overlap(log: ExecutionLog) -> None:
    """Segments stand in the log in the order in which they end."""
    mixed = replace(log, segments=tuple(sorted(log.segments, key=lambda s: (s.arm, s.end))))
    assert phases(mixed) == phases(log)


def test_a_piece_that_is_put_down_is_not_held(cell: Cell, assembly: Assembly) -> None:
    down = (
        ("lower", 0, "right", "Z", 0.5, ""),
        ("set_down", 0, "right", "Z", 1.0, ""),
        ("settle", 0, "right", "Z", 0.2, ""),
    )
    log = made_log(cell, assembly, (*EPISODE[:5], *down, *EPISODE[-1:]))
    assert ("put down", "right", "Z") in [(p.kind, p.arm, p.piece) for p in phases(log)]
    assert all(holds(log, float(time)) == () for time in log.times)


def test_a_hold_lasts_from_settling_to_release(log: ExecutionLog) -> None:
    settle, release = (
        next(s for s in log.segments if (s.kind, s.piece) == (kind, "Z")) for kind in ("settle", "release")
    )
    assert holds(log, settle.start - 0.01) == ()
    assert holds(log, settle.start + 0.01) == (("right", "Z"),)
    assert holds(log, release.start - 0.01) == (("left", "BigL"), ("right", "Z"))
    assert holds(log, release.start + 0.01) == (("left", "BigL"),)


def test_words_of_an_episode(log: ExecutionLog) -> None:
    words = [line for _, line, _ in narration(log, 0.0)]
    assert words == [
        "right takes Z", "right brings Z", "right inserts Z along (0, 0.71, −0.71)",
        "left takes BigL", "left brings BigL", "left inserts BigL along (0, 0.71, −0.71)",
        "right lets go of Z", "left lets go of BigL", "right goes home", "settling",
    ]  # fmt: skip


def test_failures_and_ablations_are_said(cell: Cell, assembly: Assembly) -> None:
    episode = (
        *EPISODE[:6],
        ("place", 0, "right", "Z", 1.0, "jammed"),
        ("ablation", 0, "right", "Z", 0.5, ""),
        *EPISODE[8:],
    )
    words = [line for _, line, _ in narration(made_log(cell, assembly, episode), 1.0)]
    assert "right: Z jams" in words and "ablation: right lets go of Z" in words
    lost = made_log(cell, assembly, (*EPISODE[:2], ("grasp", 0, "right", "Z", 0.5, "lost"), *EPISODE[-1:]))
    assert "right: Z is not between the fingers" in [line for _, line, _ in narration(lost, 1.0)]


def test_words_stay_long_enough_to_be_read(log: ExecutionLog) -> None:
    starts = np.array([start for start, _, _ in narration(log, 2.0)])
    assert np.diff(starts).min() >= 1.0 - 1e-9
    true = {line: start for start, line, _ in narration(log, 0.0)}
    late = [start - true[line] for start, line, _ in narration(log, 2.0)]
    assert min(late) >= 0.0 and max(late) <= 2.0


@pytest.mark.parametrize("least", [1.0, 2.4, 3.6, 6.0])
def test_what_is_said_goes_on_when_it_is_said(log: ExecutionLog, least: float) -> None:
    spans = {says(phase): (phase.start, phase.end) for phase in phases(log)}
    lines = narration(log, least)
    assert all(spans[words][0] <= start < spans[words][1] for start, words, _ in lines)
    assert np.diff([start for start, _, _ in lines]).min() >= 0.5 * least - 1e-9


@pytest.mark.parametrize(("lasts", "said"), [(0.2, False), (0.6, True)])
def test_what_is_over_at_once_is_not_said(cell: Cell, assembly: Assembly, lasts: float, said: bool) -> None:
    episode = (*EPISODE[:15], ("follow", 1, "left", "BigL", lasts, ""), *EPISODE[15:])
    words = [line for _, line, _ in narration(made_log(cell, assembly, episode), 1.0)]
    assert ("left lets BigL down" in words) is said and "right lets go of Z" in words


def test_vectors_are_short() -> None:
    assert vector((0.0, -1e-9, -0.70711)) == "(0, 0, −0.71)" and vector((1.0, 0.5, 0.25)) == "(1, 0.5, 0.25)"


def test_captions_of_the_frames(board: list[Shot], log: ExecutionLog) -> None:
    captions = [shot.caption for shot in board]
    assert captions[-1].text == "every piece is in place"
    assert sum(c.text == "every piece is in place" for c in captions) == pytest.approx(HOLD * 30, abs=1)
    assert any("right holds Z" in c.subtitle and c.text.startswith("left inserts BigL") for c in captions)
    assert captions[0].note.split() == ["soma3", "seed", "7", "0.0", "s", "4×"]
    assert captions[0].rgb == load_assembly("soma3").pieces[2].color
