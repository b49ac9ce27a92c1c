"""How near the arms came to their limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from soma_bullet.robot.model import Cell
from soma_bullet.world.log import ExecutionLog

VELOCITY_EXCESS = 1.05  # of a joint's limit, measured by differences over a sample


@dataclass(frozen=True)
class Limits:
    """How near the arms came to their limits.

    Attributes:
        joint_deg: smallest distance of a joint from its end; speed: largest fraction of a joint's speed
            limit.
    """

    joint_deg: float
    speed: float


def limits_of(log: ExecutionLog, cell: Cell) -> Limits:
    nearest, fastest = np.inf, 0.0
    for arm in cell.arms:
        columns = [log.joint_names.index(name) for name in arm.joint_names]
        q = log.joints[:, columns]
        nearest = min(nearest, float((q - arm.lower).min()), float((arm.upper - q).min()))
        if len(q) > 1:
            speed = np.abs(np.diff(q, axis=0)) / np.diff(log.times)[:, None] / arm.velocity
            fastest = max(fastest, float(speed.max()))
    return Limits(float(np.rad2deg(nearest)), fastest)
