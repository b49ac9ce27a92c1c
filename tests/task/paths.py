"""What is said of the segments of a program: the joints before each, where the hand is along it, that it is
straight."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from soma_bullet.frames import Array
from soma_bullet.task.program.program import Program
from soma_bullet.task.segment import Segment
from soma_bullet.task.workcell import Workcell

EXCESS = 1.03  # of a limit, by differences between samples


def states(program: Program, workcell: Workcell) -> Iterator[tuple[int, Segment, Array]]:
    """Index and segment, with the joints (arms, 6) of both arms before it."""
    qs = np.array(workcell.robot.home)
    for k, segment in enumerate(program.segments):
        yield k, segment, qs.copy()
        if len(segment.path):
            qs[segment.arm] = segment.path[-1]


def tips(workcell: Workcell, segment: Segment, stride: int = 1) -> Array:
    return np.array([workcell.robot.tcp(segment.arm, q) for q in [*segment.path[::stride], segment.path[-1]]])


def assert_straight(workcell: Workcell, segment: Segment) -> None:
    """The hand goes along its offset, without turning, and never backwards."""
    poses = tips(workcell, segment, 20)
    length = np.linalg.norm(segment.offset)
    along = segment.offset / length
    travel = poses[:, :3, 3] - poses[0, :3, 3]
    np.testing.assert_allclose(travel[-1], segment.offset, atol=5e-6)
    assert np.linalg.norm(travel - np.outer(travel @ along, along), axis=1).max() < 2e-5
    assert np.diff(travel @ along).min() > -1e-7
    np.testing.assert_allclose(
        poses[:, :3, :3], np.broadcast_to(poses[0, :3, :3], poses[:, :3, :3].shape), atol=1e-4
    )
