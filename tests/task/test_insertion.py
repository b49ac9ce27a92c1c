"""An insertion as a value: where the piece is along it, what it sweeps, and the line of an arm."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soma_bullet.frames import inverse, make_transform, rotation_about
from soma_bullet.motion.line import LineError
from soma_bullet.task.insertion import StraightInsertion
from soma_bullet.task.kinds import INSERT, PLACE
from soma_bullet.task.program.program import Program
from soma_bullet.task.workcell import Workcell

angles, lengths, shares = st.floats(0.0, 3.0), st.floats(0.01, 0.1), st.floats(0.0, 1.0)


@given(angles, angles, lengths, shares, shares)
def test_it_goes_straight_from_its_beginning_to_the_goal(
    a: float, b: float, length: float, share: float, guarded: float
) -> None:
    goal = make_transform(rotation_about((0, 0, 1), a), (0.1, 0.2, 0.3))
    direction = np.array((np.cos(a) * np.sin(b), np.sin(a) * np.sin(b), -np.cos(b)))
    way = StraightInsertion("piece", goal, direction, length, guarded * length, 1.0)
    np.testing.assert_allclose(way.pose(1.0), goal)
    at = way.pose(share)
    np.testing.assert_array_equal(at[:3, :3], goal[:3, :3])
    np.testing.assert_allclose(goal[:3, 3] - at[:3, 3], (1.0 - share) * length * direction, atol=1e-12)
    np.testing.assert_allclose(way.pose(0.0)[:3, 3] - goal[:3, 3], way.sweep()[-1], atol=1e-12)
    assert not way.sweep()[0].any()
    (fast, first), (slow, last) = way.parts()
    assert (fast, slow) == (INSERT, PLACE)
    np.testing.assert_allclose(first + last, length * direction, atol=1e-12)
    assert np.linalg.norm(last) == pytest.approx(guarded * length, abs=1e-12)


def test_the_hand_goes_with_the_piece(workcell: Workcell, program: Program) -> None:
    for a in program.schedule.assignments:
        way, robot = a.insert.way, workcell.robot
        T_piece_tcp = inverse(way.goal) @ robot.tcp(a.arm, a.insert.q_goal)
        line = way.line(robot, a.arm, T_piece_tcp, a.insert.q_goal, lambda q: False)
        np.testing.assert_array_equal(line[0], a.insert.q_goal)
        for k, q in enumerate(line):
            at = way.pose(1.0 - k / (len(line) - 1)) @ T_piece_tcp
            np.testing.assert_allclose(robot.tcp(a.arm, q), at, atol=5e-6)
        np.testing.assert_allclose(line[-1], a.insert.q_ready, atol=1e-9)
        with pytest.raises(LineError, match="collision") as caught:
            way.line(robot, a.arm, T_piece_tcp, a.insert.q_goal, lambda q: bool(np.abs(q).any()))
        np.testing.assert_array_equal(caught.value.q, a.insert.q_goal)
