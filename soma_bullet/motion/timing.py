"""Time-optimal timing of a joint path within velocity and acceleration limits.

Along a straight edge it is in closed form, along all else by toppra (H. Pham, Q.-C. Pham, T-RO 2018).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from soma_bullet.frames import Array

GRID = 300  # fewer grid points broke acceleration limits at corners
STRAIGHT = 1e-9  # [rad, or m] off a line
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
    if len(path) < 2 or np.abs(path[-1] - path[0]).max() < 1e-9 and np.abs(path - path[0]).max() < 1e-9:
        return np.array(path[-1:])
    points, vmax, amax = path, velocity, acceleration
    if travel is not None and hand is not None:
        points = np.column_stack([path, travel])
        vmax, amax = np.append(velocity, hand.speed), np.append(acceleration, hand.acceleration)
    if _straight(points):
        samples = _trapezoid(points[0], points[-1], vmax, amax, dt)[:, : path.shape[1]]
        samples[0], samples[-1] = path[0], path[-1]
        return samples
    import toppra
    from toppra import algorithm

    toppra.setup_logging("ERROR")
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    keep = np.concatenate([[True], np.diff(arc) > 1e-9])
    spline = toppra.SplineInterpolator(arc[keep] / arc[-1], points[keep], bc_type="natural")
    limits = list(_limits(tuple(vmax.tolist()), tuple(amax.tolist())))
    # the knots belong to the grid: between coarser points a tight corner would go unseen
    grid = np.union1d(np.linspace(0, 1, GRID), np.round(arc[keep] / arc[-1], 12))
    grid = grid[np.concatenate([[True], np.diff(grid) > 1e-6])]
    grid[-1] = 1.0
    instance = algorithm.TOPPRA(limits, spline, gridpoints=grid, parametrizer="ParametrizeConstAccel")
    instance.compute_parameterization(0, 0)
    if instance.problem_data.return_code != algorithm.algorithm.ParameterizationReturnCode.Ok:
        raise TimingError("toppra found no timing within the limits")
    timed = _Timed(spline, instance.problem_data.gridpoints, instance.problem_data.sd_vec)
    stretch = _stretch(timed, velocity, acceleration)
    if stretch > LARGEST_STRETCH:
        raise TimingError(
            f"the timed trajectory would have to be {stretch:.1f} times slower to keep the limits"
        )
    steps = max(1, int(np.ceil(timed.duration * stretch / dt)))
    times = np.linspace(0, timed.duration, steps + 1)  # stretched by less than one step more
    samples = timed.positions(times)[:, : path.shape[1]]
    samples[0], samples[-1] = path[0], path[-1]
    return samples


def _straight(points: Array) -> bool:
    """Whether points (n, j) follow one another along the line from the first to the last."""
    whole = points[-1] - points[0]
    squared = float(whole @ whole)
    if squared < 1e-18:
        return False
    along = (points - points[0]) @ whole / squared
    return bool(
        np.diff(along).min() >= -1e-12
        and np.abs(points - points[0] - along[:, None] * whole).max() < STRAIGHT
    )


def _trapezoid(start: Array, end: Array, velocity: Array, acceleration: Array, dt: float) -> Array:
    """Samples (n, j) of the fastest motion along the line between two points (j,): at once up to speed, and
    down again."""
    whole = np.abs(end - start)
    moves = whole > 0
    speed = float((velocity[moves] / whole[moves]).min())  # [1/s] of the place from 0 to 1
    rate = float((acceleration[moves] / whole[moves]).min())  # [1/s2]
    speed = min(speed, float(np.sqrt(rate)))
    rise, duration = speed / rate, 1.0 / speed + speed / rate  # [s]
    steps = max(1, int(np.ceil(duration / dt)))
    times = np.linspace(0, duration, steps + 1)  # slower by less than one step
    early = np.minimum(times, duration - times)
    place = np.where(early < rise, 0.5 * rate * early**2, speed * (early - 0.5 * rise))
    place = np.where(times > duration / 2, 1.0 - place, place)
    return np.asarray(start + (end - start) * place[:, None])


@lru_cache(maxsize=32)
def _limits(velocity: tuple[float, ...], acceleration: tuple[float, ...]) -> tuple[Any, Any]:
    """toppra's constraints for joint limits; they know nothing of a path, and are dear to make."""
    from toppra import constraint

    vmax, amax = np.array(velocity), np.array(acceleration)
    return (
        constraint.JointVelocityConstraint(np.column_stack([-vmax, vmax])),
        constraint.JointAccelerationConstraint(
            np.column_stack([-amax, amax]), discretization_scheme=constraint.DiscretizationType.Interpolation
        ),
    )


class _Timed:
    """A path (a spline) gone along with constant acceleration between grid points, all at once what toppra
    does one by one.

    Args:
        grid: places along the path (n,); speeds: of the place there (n,) [1/s].
    """

    def __init__(self, spline: Any, grid: Array, speeds: Array):
        self.spline, self.grid, self.speeds = spline, grid, speeds
        gaps, squares = np.diff(grid), speeds**2
        self.rates = 0.5 * np.diff(squares) / gaps  # [1/s^2]
        self.times = np.cumsum(np.concatenate([[0.0], 2 * gaps / (speeds[:-1] + speeds[1:])]))  # [s]
        self.duration = float(self.times[-1])

    def _places(self, times: Array) -> tuple[Array, Array, Array]:
        """Place, speed and acceleration along the path."""
        k = np.minimum(np.searchsorted(self.times, times, side="right") - 1, len(self.rates) - 1)
        dt, rate, speed = times - self.times[k], self.rates[k], self.speeds[k]
        return self.grid[k] + dt * speed + 0.5 * np.float_power(dt, 2) * rate, speed + dt * rate, rate

    def positions(self, times: Array) -> Array:
        """Joints (n, j) at times (n,) [s]."""
        return np.asarray(self.spline(self._places(times)[0]))

    def rates_of_change(self, times: Array) -> tuple[Array, Array]:
        """Velocities and accelerations of the joints (n, j) at times (n,) [s]."""
        place, speed, rate = self._places(times)
        along, bend = self.spline(place, 1), self.spline(place, 2)
        return along * speed[:, None], bend * speed[:, None] ** 2 + along * rate[:, None]


def _stretch(timed: _Timed, velocity: Array, acceleration: Array) -> float:
    """Factor by which a trajectory must be slowed down to keep its limits everywhere at 1 kHz: 1 where it
    does."""
    times = np.linspace(0, timed.duration, max(2, int(timed.duration * 1000)))
    velocities, accelerations = timed.rates_of_change(times)
    speed = (np.abs(velocities[:, : len(velocity)]) / velocity).max()
    rate = (np.abs(accelerations[:, : len(velocity)]) / acceleration).max()
    return float(max(1.0, speed / EXCESS, np.sqrt(rate / EXCESS)))


def limit_margins(samples: Array, velocity: Array, acceleration: Array, dt: float) -> tuple[float, float]:
    """Largest fraction of the velocity and of the acceleration limits that samples (n, 6) use."""
    if len(samples) < 3:
        return 0.0, 0.0
    speed = np.abs(np.diff(samples, axis=0)).max(axis=0) / dt / velocity
    rate = np.abs(np.diff(samples, n=2, axis=0)).max(axis=0) / dt**2 / acceleration
    return float(speed.max()), float(rate.max())
