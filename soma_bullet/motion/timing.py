"""Time-optimal timing of a joint path within velocity and acceleration limits (toppra; H. Pham, Q.-C. Pham, T-RO 2018)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from soma_bullet.frames import Array

GRID = 300  # fewer grid points broke acceleration limits at corners
EXCESS = 1.02  # limits may be exceeded by this factor, from sampling
LARGEST_STRETCH = 3.0  # a tight corner may slow a whole motion down by this


class TimingError(Exception):
    """toppra found no timing, or the timed trajectory breaks a limit or collides."""


@dataclass(frozen=True)
class HandLimits:
    """Limits of the hand's travel along a line: speed [m/s] and acceleration [m/s^2]."""

    speed: float
    acceleration: float


def time_path(
    path: Array,
    velocity: Array,
    acceleration: Array,
    dt: float,
    travel: Array | None = None,
    hand: HandLimits | None = None,
) -> Array:
    """Samples (n, 6) every `dt` [s] of the fastest motion along a dense path (m, 6), at rest at both ends.

    Args:
        velocity, acceleration: joint limits (6,).
        travel: distance of the hand along the path (m,) [m]; with `hand` it is limited as one more joint.

    Raises:
        TimingError
    """
    import toppra
    from toppra import algorithm, constraint

    toppra.setup_logging("ERROR")
    if len(path) < 2 or np.abs(path[-1] - path[0]).max() < 1e-9 and np.abs(path - path[0]).max() < 1e-9:
        return np.array(path[-1:])
    points, vmax, amax = path, velocity, acceleration
    if travel is not None and hand is not None:
        points = np.column_stack([path, travel])
        vmax, amax = np.append(velocity, hand.speed), np.append(acceleration, hand.acceleration)
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    keep = np.concatenate([[True], np.diff(arc) > 1e-9])
    spline = toppra.SplineInterpolator(arc[keep] / arc[-1], points[keep], bc_type="natural")
    limits = [
        constraint.JointVelocityConstraint(np.column_stack([-vmax, vmax])),
        constraint.JointAccelerationConstraint(
            np.column_stack([-amax, amax]), discretization_scheme=constraint.DiscretizationType.Interpolation
        ),
    ]
    # the knots belong to the grid: between coarser points a tight corner would go unseen
    grid = np.union1d(np.linspace(0, 1, GRID), np.round(arc[keep] / arc[-1], 12))
    grid = grid[np.concatenate([[True], np.diff(grid) > 1e-6])]
    grid[-1] = 1.0
    instance = algorithm.TOPPRA(limits, spline, gridpoints=grid, parametrizer="ParametrizeConstAccel")
    timed = instance.compute_trajectory(0, 0)
    if timed is None:
        raise TimingError("toppra found no timing within the limits")
    stretch = _stretch(timed, velocity, acceleration)
    if stretch > LARGEST_STRETCH:
        raise TimingError(f"the timed trajectory would have to be {stretch:.1f} times slower to keep the limits")
    steps = max(1, int(np.ceil(timed.duration * stretch / dt)))
    times = np.linspace(0, timed.duration, steps + 1)  # stretched by less than one step more
    samples = np.asarray(timed(times))[:, : path.shape[1]]
    samples[0], samples[-1] = path[0], path[-1]
    return samples


def _stretch(timed: Any, velocity: Array, acceleration: Array) -> float:
    """Factor by which a trajectory must be slowed down to keep its limits everywhere at 1 kHz: 1 where it does."""
    times = np.linspace(0, timed.duration, max(2, int(timed.duration * 1000)))
    speed = (np.abs(timed(times, 1)[:, : len(velocity)]) / velocity).max()
    rate = (np.abs(timed(times, 2)[:, : len(velocity)]) / acceleration).max()
    return float(max(1.0, speed / EXCESS, np.sqrt(rate / EXCESS)))


def limit_margins(samples: Array, velocity: Array, acceleration: Array, dt: float) -> tuple[float, float]:
    """Largest fraction of the velocity and of the acceleration limits that samples (n, 6) use."""
    if len(samples) < 3:
        return 0.0, 0.0
    speed = np.abs(np.diff(samples, axis=0)).max(axis=0) / dt / velocity
    rate = np.abs(np.diff(samples, n=2, axis=0)).max(axis=0) / dt**2 / acceleration
    return float(speed.max()), float(rate.max())
