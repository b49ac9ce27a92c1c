"""How awkward it is for an arm to have its hand somewhere, and which grasps are alike."""

from __future__ import annotations

import numpy as np

from soma_bullet.frames import Array, Indices
from soma_bullet.robot.kinematics import Robot

OUTWARD = 0.5  # of a hand that is held well: outwards for each part down
CARRYING = 0.6  # of the joint limits while a hand carries a piece


def posture_cost(robot: Robot, arm: int, Ts_world_tcp: Array) -> Array:
    """How awkward an arm has its hand at poses (..., 4, 4): about the angle [rad] from reaching down and
    outwards."""
    offset = Ts_world_tcp[..., :3, 3] - robot.arm(arm).T_world_base[:3, 3]
    flat = offset * np.array((1.0, 1.0, 0.0))
    outward = flat / np.maximum(np.linalg.norm(flat, axis=-1, keepdims=True), 1e-9)
    ideal = np.array((0.0, 0.0, -1.0)) + OUTWARD * outward
    ideal /= np.linalg.norm(ideal, axis=-1, keepdims=True)
    angle = np.arccos(np.clip((Ts_world_tcp[..., :3, 2] * ideal).sum(axis=-1), -1, 1))
    away, reach = np.linalg.norm(offset, axis=-1), robot.reaches[arm]
    return np.asarray(angle + 5 * (np.maximum(away - reach.far, 0) + np.maximum(reach.near - away, 0)))


def bearings(poses: Array) -> list[tuple[float, ...]]:
    """Of hands at poses (n, 4, 4) the directions of approach and of closing, coarsely: hands that may fail
    alike are alike."""
    return [tuple(row) for row in np.round(4.0 * poses[:, :3, [2, 0]]).reshape(-1, 6).tolist()]


def spread(poses: Array, indices: Indices, cost: Array) -> list[int]:
    """Grasps (some indices of poses (n, 4, 4)) by cost: the best one of every direction of the hand first."""
    groups: dict[tuple[float, ...], list[int]] = {}
    ranked = indices[np.argsort(np.round(cost, 9), kind="stable")]
    for g, direction in zip(ranked.tolist(), bearings(poses[ranked]), strict=True):
        groups.setdefault(direction, []).append(g)
    longest = max(map(len, groups.values()), default=0)
    return [group[k] for k in range(longest) for group in groups.values() if k < len(group)]


def carrying_time(robot: Robot, arm: int, start: Array, goal: Array) -> float:
    """How long [s] an arm takes along a straight edge between joints (n,) with a piece in its hand."""
    far = np.abs(goal - start)
    velocity, acceleration = CARRYING * robot.arm(arm).velocity, CARRYING * robot.arm(arm).acceleration
    ramps = velocity**2 / acceleration
    seconds = np.where(far < ramps, 2 * np.sqrt(far / acceleration), far / velocity + velocity / acceleration)
    return float(seconds.max())
