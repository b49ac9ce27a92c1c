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
from soma_bullet.seeds import derived
from soma_bullet.task.kinds import PLACE, Kind
from soma_bullet.task.posture import CARRYING
from soma_bullet.task.segment import DT, Segment
from soma_bullet.task.state import CellState
from soma_bullet.task.workcell import Workcell

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
THREADING = HandLimits(0.020, 0.06)  # [m/s], [m/s2] of what is guarded before the end of a placing


def widths_between(first: float, last: float) -> Array:
    """Widths [m] of a hand that opens or closes, so close that what fits between two of them is thinner than
    a finger."""
    return np.linspace(first, last, 1 + int(np.ceil(abs(last - first) / 2 / FINGER_STEP)))


def plan_motion(
    workcell: Workcell,
    scene: Scene,
    state: CellState,
    arm: int,
    start: Array,
    goal: Array,
    widths: Array,
    seed: int,
    checks: int = TransferOptions().checks,
    forbidden: Callable[[Array], bool] | None = None,
) -> Array:
    """Timed joints (m, n) around obstacles, free at all of the hand's widths [m] from the least to the
    greatest.

    Args:
        checks: of a state, after which the search gives up.
        forbidden: whether something else rules out joints (n,).

    Raises:
        TransferError, TimingError
    """
    limits = workcell.robot.arm(arm)
    gentle = CARRYING if scene.situation.carried else 1.0
    hits = collisions(workcell, scene, state, arm, widths)
    collides = hits if forbidden is None else lambda q: hits(q) or forbidden(q)
    for attempt, step in enumerate(EDGE_STEPS):
        options = TransferOptions(checks, derived(seed, "attempt", attempt), step)
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
    workcell: Workcell, scene: Scene, state: CellState, arm: int, widths: Array
) -> Callable[[Array], bool]:
    """Whether an arm collides at joints (n,) at any width of its hand from the least to the greatest of
    `widths` [m]."""
    narrow, wide = float(np.min(widths)), float(np.max(widths))
    seen = scene if wide == narrow else scene.swept(arm, (wide - narrow) / 2)
    configuration, slots = (
        workcell.configuration(state, arm, state.qs[arm], narrow),
        workcell.robot.arm_slots(arm),
    )

    def collides(q: Array) -> bool:
        configuration[slots] = q
        return seen.collides(configuration)

    return collides


def line_motion(
    workcell: Workcell,
    scene: Scene,
    state: CellState,
    arm: int,
    start: Array,
    offset: Array,
    limits: HandLimits,
) -> Array:
    """Timed joints (m, n) along a straight line of the hand. Raises LineError, TimingError."""
    path, travel = sample_line(workcell.robot, arm, start, offset)
    joints = workcell.robot.arm(arm)
    samples = time_path(path, joints.velocity, joints.acceleration, DT, travel, limits)
    widths = state.openings[arm : arm + 1]
    check(thinned(samples), collisions(workcell, scene, state, arm, widths))
    return samples


def straight_motion(
    workcell: Workcell, scene: Scene, state: CellState, arm: int, start: Array, offset: Array, kind: Kind
) -> Array:
    """Timed joints (m, n) along a line at the speed of its kind; a long placing is slowest at its end
    only."""
    assert kind.limits is not None
    length, slowest = float(np.linalg.norm(offset)), workcell.sizes.place
    if kind is not PLACE or length < slowest + SHORTEST:
        return line_motion(workcell, scene, state, arm, start, offset, kind.limits)
    last = offset * (slowest / length)
    threading = line_motion(workcell, scene, state, arm, start, offset - last, THREADING)
    placing = line_motion(workcell, scene, state, arm, threading[-1], last, kind.limits)
    return np.vstack([threading, placing[1:]])


def scene_of(workcell: Workcell, state: CellState, kind: Kind, arm: int, piece: str) -> Scene:
    """The scene in which one arm moves for a segment, and nothing else does."""
    return workcell.scene(state, arm, kind.touching(workcell, piece))


def scene_for(workcell: Workcell, state: CellState, segment: Segment) -> Scene:
    """The scene of a segment, in the state before it."""
    return scene_of(workcell, state, segment.kind, segment.arm, segment.piece)


def widths_along(before: CellState, segment: Segment) -> Array:
    """Widths [m] that a hand goes through along a segment."""
    return widths_to(before, segment.arm, segment.opening)


def widths_to(state: CellState, arm: int, opening: float | None) -> Array:
    """Widths [m] from that of a hand to another; None leaves it as it is."""
    now = float(state.openings[arm])
    return widths_between(now, now if opening is None else opening)


def check(path: Array, collides: Callable[[Array], bool]) -> None:
    """Raise TimingError where joints (m, n) along a path collide."""
    if any(collides(q) for q in path):
        raise TimingError("the trajectory collides")


def thinned(samples: Array) -> Array:
    """Timed joints (m, n) every CHECK_EVERY, and the last."""
    return np.vstack([samples[:: max(1, int(CHECK_EVERY / DT))], samples[-1:]])


def refined(path: Array, parts: int) -> Array:
    """A path (m, n) with every step between its points divided into equal parts (parts (n - 1) + 1, 6)."""
    shares = np.arange(parts)[:, None] / parts
    fine = (path[:-1, None] + shares * np.diff(path, axis=0)[:, None]).reshape(-1, path.shape[1])
    return np.vstack([fine, path[-1:]])


def joined(path: Array, q: Array) -> Array:
    """A timed path (m, n) that starts at q (n,) instead, and comes back to itself by its end (minimum
    jerk)."""
    s = np.linspace(0.0, 1.0, len(path))[:, None]
    bent: Array = path + (1.0 - (10 * s**3 - 15 * s**4 + 6 * s**5)) * (q - path[0])
    return bent
