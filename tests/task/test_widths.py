"""Motions around obstacles are free all along and at every width of a hand that opens or closes on the
way."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soma_bullet.grasp.hand import Hand
from soma_bullet.task.program.motions import FINGER_STEP, collisions, refined, scene_for, widths_between
from soma_bullet.task.program.program import Program, moments
from soma_bullet.task.segment import DT
from soma_bullet.task.workcell import Workcell


@given(st.floats(0.0, 0.08), st.floats(0.0, 0.08))
def test_no_finger_moves_far_between_two_widths(first: float, last: float) -> None:
    widths = widths_between(first, last)
    assert widths[0] == pytest.approx(first) and widths[-1] == pytest.approx(last)
    assert np.abs(np.diff(widths)).max(initial=0.0) <= 2 * FINGER_STEP + 1e-12


def test_no_finger_is_thinner_than_the_step(workcell: Workcell) -> None:
    hand: Hand = workcell.cell.arms[0].hand
    for box in (*hand.left_boxes, *hand.right_boxes):
        thickness = 2 * float(np.abs(box.T[0, :3]) @ box.half)
        assert thickness >= FINGER_STEP - 1e-9


def test_timed_motions_are_free_at_every_sample_and_width(workcell: Workcell, program: Program) -> None:
    """Replayed at the simulator's rate in the scene as it is: no swept fingers, no spacing between checked
    states."""
    replayed = 0
    for context, segment, _ in moments(workcell, program):
        if not segment.kind.around:
            continue
        arm, now = segment.arm, float(context.openings[segment.arm])
        scene = scene_for(workcell, context, segment)
        widths = widths_between(now, now if segment.opening is None else segment.opening)
        for k, q in enumerate(segment.path):
            for width in widths if k % 16 == 0 else widths[[k % len(widths)]]:
                hit = scene.collides(workcell.configuration(context, arm, q, float(width)))
                assert not hit, (segment.kind, segment.piece, k * DT, width)
        replayed += 1
    assert replayed >= 6


def test_one_check_stands_for_all_widths(workcell: Workcell, program: Program) -> None:
    rng, seen = np.random.default_rng(0), {True: 0, False: 0}
    for context, segment, _ in moments(workcell, program):
        if not (segment.kind.around and segment.kind.unladen):
            continue
        arm, state = segment.arm, context
        widths = widths_between(float(state.openings[arm]), segment.opening)
        scene = scene_for(workcell, context, segment)
        collides = collisions(workcell, scene, state, arm, widths)
        for q in segment.path[rng.integers(len(segment.path), size=60)] + rng.normal(0, 0.08, (60, 6)):
            some = any(
                scene.collides(workcell.configuration(state, arm, q, float(width))) for width in widths
            )
            assert collides(q) or not some  # it sees what lies between two widths, too
            seen[some] += 1
    assert min(seen.values()) >= 10, seen


@pytest.mark.parametrize("parts", [1, 2, 5])
def test_a_refined_path_keeps_its_points(parts: int) -> None:
    path = np.random.default_rng(0).normal(size=(5, 6))
    fine = refined(path, parts)
    np.testing.assert_array_equal(fine[::parts], path)
    np.testing.assert_allclose(
        np.diff(fine, axis=0), np.repeat(np.diff(path, axis=0), parts, axis=0) / parts, atol=1e-12
    )
    np.testing.assert_array_equal(refined(path[:1], parts), path[:1])
