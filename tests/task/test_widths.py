"""A hand that closes on its way home sweeps its fingers through all widths between."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soma_bullet.grasp.hand import Hand
from soma_bullet.task.motions import FINGER_STEP, widths_between
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
