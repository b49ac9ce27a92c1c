"""Straight Cartesian lines of the hand on one inverse-kinematics branch: approach, lift, insertion,
retreat."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from soma_bullet.frames import Array, translate
from soma_bullet.robot.kinematics import Robot

STEP = 0.005  # [m] between checked states of a line
LARGEST_JOINT_STEP = 0.25  # [rad] between neighbours; more means a singularity or another branch
SPACING = 5e-4  # [m] between the samples that are handed to the timing

Check = Callable[[Array], bool]


class LineError(Exception):
    """No line.

    Attributes:
        cause: `unreachable` (also where only joints beyond their limits reach), `branch` (a joint jumps) or
            `collision`.
        at: distance from where the tracing began [m].
        q: the joints (6,) that fail, where there are any.
    """

    def __init__(self, cause: str, at: float, q: Array | None = None):
        super().__init__(cause)
        self.cause, self.at, self.q = cause, at, q


def line_back(
    robot: Robot, arm: int, q_end: Array, T_world_tcp: Array, away: Array, length: float, collides: Check
) -> Array:
    """Joints (n, 6) of a line that ends at q_end, traced backwards along the unit vector `away` (3,) for
    `length` [m].

    Returns them in the order of tracing: q_end first. The orientation of the hand stays.

    Raises:
        LineError: the first state that fails, with the cause.
    """
    count = max(1, int(np.ceil(length / STEP)))
    path = [np.asarray(q_end, float)]
    for k in range(count + 1):
        distance = length * k / count
        if k:
            path.append(_step(robot, arm, path[-1], T_world_tcp, away, distance))
        if collides(path[-1]):
            raise LineError("collision", distance, path[-1])
    return np.array(path)


def _step(robot: Robot, arm: int, previous: Array, T_world_tcp: Array, away: Array, distance: float) -> Array:
    q = robot.follow(arm, translate(T_world_tcp, away * distance), previous)
    if q is None:
        raise LineError("unreachable", distance)
    if np.abs(q - previous).max() > LARGEST_JOINT_STEP:
        raise LineError("branch", distance, q)
    return q


def sample_line(
    robot: Robot, arm: int, q_start: Array, offset: Array, spacing: float = SPACING
) -> tuple[Array, Array]:
    """Joints (n, 6) along a straight line of the hand from q_start by `offset` (3,) [m], and the distance of
    each (n,) [m].

    Raises:
        LineError: the line leaves the reach or the branch.
    """
    length = float(np.linalg.norm(offset))
    count = max(2, int(np.ceil(length / spacing)))
    distances = length * np.arange(count + 1) / count
    start = robot.tcp(arm, q_start)
    path = [np.asarray(q_start, float)]
    for distance in distances[1:]:
        path.append(_step(robot, arm, path[-1], start, offset / max(length, 1e-12), distance))
    return np.array(path), distances
