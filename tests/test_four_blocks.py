"""Four blocks in physics: a hold that goes on while another arm inserts, and pieces that slide in along a
diagonal."""

from __future__ import annotations

import numpy as np
import pytest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.episode import run_episode
from soma_bullet.options import EpisodeOptions


def test_pieces_that_share_an_edge_may_meet() -> None:
    soma4 = load_assembly("soma4")
    faces = {frozenset((contact.body_a, contact.body_b)) for contact in soma4.contacts}
    v = soma4.index("V")  # cells of L and A lie diagonally above some of its own
    assert soma4.meeting - faces == {frozenset((v, soma4.index("L"))), frozenset((v, soma4.index("A")))}


@pytest.mark.slow
def test_four_blocks_are_built() -> None:
    report = run_episode("soma4", EpisodeOptions(seed=100))
    assert report is not None
    assert report.success, report.judgement.causes
    assert report.order in (("V", "Z", "L", "A"), ("V", "Z", "A", "L"))
    assert max(piece.error_mm for piece in report.pieces) < 2.0
    assert report.judgement.forbidden == ()
    (hold,) = [drift for drift in report.judgement.holds if drift.piece == "Z"]
    assert hold.seconds > 2.0 and hold.drift_mm < 0.5
    assert np.isfinite(report.certificates["Z"]) and report.certificates["Z"] >= 1.0
