"""Timed motions of one arm: around obstacles, or along a straight line of the hand; checked again after the
timing."""

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

CHECK_EVERY = 0.010  # [s] between collision checks on a timed line
FINGER_STEP = 0.004  # [m] of one finger; none is thinner
EDGE_STEPS = (
    0.02,
    0.004,
    0.004,
    0.004,
    0.004,
)  # [rad] between checked states of an edge, one for each attempt
# parts of a step of the path that is taken, to be checked once more: the planner's edges may graze something
# between
FINER = 4
SHORTEST = 1e-4  # [m] of a line that is worth a motion of its own
BRIEFLY = 250  # checks of collisions, after which the search for a path that would only save time gives up
CARRYING = 0.6  # of the joint limits while a hand carries a piece


def widths_between(first: float, last: float) -> Array:
    """Widths [m] of a hand that opens or closes, so close that what fits between two of them is thinner than
    a finger."""
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
    forbidden: Callable[[Array], bool] | None = None,
) -> Array:
    """Timed joints (n, 6) around obstacles, free at all of the hand's widths [m] from the least to the
    greatest.

    Args:
        checks: of a state, after which the search gives up.
        forbidden: whether something else rules out joints (6,).

    Raises:
        TransferError, TimingError
    """
    limits = workcell.robot.arm(arm)
    gentle = CARRYING if scene.situation.carried else 1.0
    hits = collisions(workcell, scene, hands, arm, widths)
    collides = hits if forbidden is None else lambda q: hits(q) or forbidden(q)
    for attempt, step in enumerate(EDGE_STEPS):
        options = TransferOptions(checks, seed + 7919 * attempt, step)
        waypoints = plan_transfer(start, np.array([goal]), limits.lower, limits.upper, collides, options)
        dense = blend_corners(waypoints, collides)
        samples = time_path(dense, gentle * limits.velocity, gentle * limits.acceleration, DT)
        try:
            fine = refined(dense, FINER)
            # the states of a straight edge have been checked, but not those between them; what is bent is all
            # new
            new = np.arange(len(fine)) % FINER > 0 if len(waypoints) == 2 else np.full(len(fine), True)
            check(fine[new], collides)
        except TimingError:
            if attempt + 1 == len(EDGE_STEPS):
                raise
            continue  # it grazes something between two checked states: look more closely, and elsewhere
        break
    return samples


def collisions(
    workcell: Workcell, scene: Scene, hands: Hands, arm: int, widths: Array
) -> Callable[[Array], bool]:
    """Whether an arm collides at joints (6,) at any width of its hand from the least to the greatest of
    `widths` [m]."""
    narrow, wide = float(np.min(widths)), float(np.max(widths))
    seen = scene if wide == narrow else scene.swept(arm, (wide - narrow) / 2)
    configuration, slots = (
        workcell.configuration(hands, arm, hands.qs[arm], narrow),
        workcell.robot.arm_slots(arm),
    )

    def collides(q: Array) -> bool:
        configuration[slots] = q
        return seen.collides(configuration)

    return collides


def line_motion(
    workcell: Workcell, scene: Scene, hands: Hands, arm: int, start: Array, offset: Array, limits: HandLimits
) -> Array:
    """Timed joints (n, 6) along a straight line of the hand. Raises LineError, TimingError."""
    path, travel = sample_line(workcell.robot, arm, start, offset)
    joints = workcell.robot.arm(arm)
    samples = time_path(path, joints.velocity, joints.acceleration, DT, travel, limits)
    widths = hands.openings[arm : arm + 1]
    check(thinned(samples), collisions(workcell, scene, hands, arm, widths))
    return samples


def straight_motion(
    workcell: Workcell, scene: Scene, hands: Hands, arm: int, start: Array, offset: Array, kind: Kind
) -> Array:  # fmt: skip
    """Timed joints (n, 6) along a line at the speed of its kind; a long placing is slowest at its end
    only."""
    length = float(np.linalg.norm(offset))
    if kind != "place" or length < PLACE + SHORTEST:
        return line_motion(workcell, scene, hands, arm, start, offset, SPEEDS[kind])
    last = offset * (PLACE / length)
    threading = line_motion(workcell, scene, hands, arm, start, offset - last, THREADING)
    placing = line_motion(workcell, scene, hands, arm, threading[-1], last, SPEEDS[kind])
    return np.vstack([threading, placing[1:]])


def check(path: Array, collides: Callable[[Array], bool]) -> None:
    """Raise TimingError where joints (n, 6) along a path collide."""
    if any(collides(q) for q in path):
        raise TimingError("the trajectory collides")


def thinned(samples: Array) -> Array:
    """Timed joints (n, 6) every CHECK_EVERY, and the last."""
    return np.vstack([samples[:: max(1, int(CHECK_EVERY / DT))], samples[-1:]])


def refined(path: Array, parts: int) -> Array:
    """A path (n, 6) with every step between its points divided into equal parts (parts (n - 1) + 1, 6)."""
    shares = np.arange(parts)[:, None] / parts
    fine = (path[:-1, None] + shares * np.diff(path, axis=0)[:, None]).reshape(-1, path.shape[1])
    return np.vstack([fine, path[-1:]])


def joined(path: Array, q: Array) -> Array:
    """A timed path (n, 6) that starts at q (6,) instead, and comes back to itself by its end (minimum
    jerk)."""
    s = np.linspace(0.0, 1.0, len(path))[:, None]
    bent: Array = path + (1.0 - (10 * s**3 - 15 * s**4 + 6 * s**5)) * (q - path[0])
    return bent
