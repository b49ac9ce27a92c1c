"""Timed motions of one arm: around obstacles, or along a straight line of the hand; checked again after the timing."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from soma_bullet.frames import Array
from soma_bullet.motion.line import sample_line
from soma_bullet.motion.timing import HandLimits, TimingError, time_path
from soma_bullet.motion.transfer import TransferOptions, blend_corners, plan_transfer
from soma_bullet.robot.collision import Scene
from soma_bullet.task.segments import DT, PLACE, SPEEDS, THREADING, Kind
from soma_bullet.task.workcell import Hands, Workcell

CHECK_EVERY = 0.010  # [s] between collision checks on the timed trajectory
FINGER_STEP = 0.004  # [m] of one finger; none is thinner
EDGE_STEPS = (0.02, 0.004, 0.004, 0.004, 0.004)  # [rad] between checked states of an edge, one for each attempt
SHORTEST = 1e-4  # [m] of a line that is worth a motion of its own
CARRYING = 0.6  # of the joint limits while a hand carries a piece


def widths_between(first: float, last: float) -> Array:
    """Widths [m] of a hand that opens or closes, so close that what fits between two of them is thinner than a finger."""
    return np.linspace(first, last, 1 + int(np.ceil(abs(last - first) / 2 / FINGER_STEP)))


def plan_motion(
    workcell: Workcell,
    scene: Scene,
    hands: Hands,
    arm: int,
    start: Array,
    goal: Array,
    widths: Array,
    seed: int,
    checks: int = TransferOptions().checks,
    forbidden: Callable[[Array], bool] = lambda q: False,
) -> Array:
    """Timed joints (n, 6) around obstacles, free at every one of the hand's widths [m].

    Args:
        checks: of a state, after which the search gives up.
        forbidden: whether something else rules out joints (6,).

    Raises:
        TransferError, TimingError
    """
    limits = workcell.robot.arm(arm)
    gentle = CARRYING if scene.situation.carried else 1.0

    def collides(q: Array) -> bool:
        return forbidden(q) or any(scene.collides(workcell.configuration(hands, arm, q, width)) for width in widths)

    for attempt, step in enumerate(EDGE_STEPS):
        options = TransferOptions(checks, seed + 7919 * attempt, step)
        waypoints = plan_transfer(start, np.array([goal]), limits.lower, limits.upper, collides, options)
        dense = blend_corners(waypoints, collides)
        samples = time_path(dense, gentle * limits.velocity, gentle * limits.acceleration, DT)
        try:
            check(samples, collides)
        except TimingError:
            if attempt + 1 == len(EDGE_STEPS):
                raise
            continue  # it grazes something between two checked states: look more closely, and elsewhere
        break
    return samples


def line_motion(
    workcell: Workcell, scene: Scene, hands: Hands, arm: int, start: Array, offset: Array, limits: HandLimits
) -> Array:
    """Timed joints (n, 6) along a straight line of the hand. Raises LineError, TimingError."""
    path, travel = sample_line(workcell.robot, arm, start, offset)
    joints = workcell.robot.arm(arm)
    samples = time_path(path, joints.velocity, joints.acceleration, DT, travel, limits)
    check(samples, lambda q: scene.collides(workcell.configuration(hands, arm, q)))
    return samples


def straight_motion(
    workcell: Workcell, scene: Scene, hands: Hands, arm: int, start: Array, offset: Array, kind: Kind
) -> Array:  # fmt: skip
    """Timed joints (n, 6) along a line at the speed of its kind; a long placing is slowest at its end only."""
    length = float(np.linalg.norm(offset))
    if kind != "place" or length < PLACE + SHORTEST:
        return line_motion(workcell, scene, hands, arm, start, offset, SPEEDS[kind])
    last = offset * (PLACE / length)
    threading = line_motion(workcell, scene, hands, arm, start, offset - last, THREADING)
    placing = line_motion(workcell, scene, hands, arm, threading[-1], last, SPEEDS[kind])
    return np.vstack([threading, placing[1:]])


def check(samples: Array, collides: Callable[[Array], bool]) -> None:
    """Raise TimingError where timed joints (n, 6) collide."""
    stride = max(1, int(CHECK_EVERY / DT))
    for q in [*samples[::stride], samples[-1]]:
        if collides(q):
            raise TimingError("the timed trajectory collides")


def joined(path: Array, q: Array) -> Array:
    """A timed path (n, 6) that starts at q (6,) instead, and comes back to itself by its end (minimum jerk)."""
    s = np.linspace(0.0, 1.0, len(path))[:, None]
    bent: Array = path + (1.0 - (10 * s**3 - 15 * s**4 + 6 * s**5)) * (q - path[0])
    return bent
