"""Timed motions keep their limits, by finite differences at 1 kHz."""

from __future__ import annotations

import numpy as np
import pytest

from soma_bullet.frames import Array
from soma_bullet.motion import timing
from soma_bullet.motion.timing import EXCESS, HandLimits, TimingError, limit_margins, time_path
from soma_bullet.motion.transfer import blend_corners

VELOCITY = np.array([2.0, 2.0, 3.0, 3.0, 3.0, 3.0])  # [rad/s]
ACCELERATION = np.array([4.0, 4.0, 4.0, 8.0, 8.0, 8.0])  # [rad/s2]
DT = 1e-3
ROUNDING = 1.02  # of finite differences


def bent(seed: int, corners: int = 4) -> Array:
    """A dense path with blended corners through random waypoints."""
    points = np.random.default_rng(seed).uniform(-1.5, 1.5, (corners, 6))
    return blend_corners(points, lambda q: False)


@pytest.mark.parametrize("seed", range(5))
def test_limits_are_kept(seed: int) -> None:
    path = bent(seed)
    samples = time_path(path, VELOCITY, ACCELERATION, DT)
    speed = np.abs(np.diff(samples, axis=0)) / DT
    rate = np.abs(np.diff(samples, n=2, axis=0)) / DT**2
    assert (speed.max(axis=0) <= VELOCITY * EXCESS * ROUNDING).all()
    assert (rate.max(axis=0) <= ACCELERATION * EXCESS * ROUNDING).all()
    fastest, hardest = limit_margins(samples, VELOCITY, ACCELERATION, DT)
    assert fastest == pytest.approx((speed / VELOCITY).max())
    assert hardest == pytest.approx((rate / ACCELERATION).max())
    assert max(fastest, hardest) > 0.9  # and no slower than need be


@pytest.mark.parametrize("seed", range(5))
def test_it_starts_and_ends_at_rest_where_the_path_does(seed: int) -> None:
    path = bent(seed)
    samples = time_path(path, VELOCITY, ACCELERATION, DT)
    np.testing.assert_array_equal(samples[[0, -1]], path[[0, -1]])
    for step in (samples[1] - samples[0], samples[-1] - samples[-2]):
        assert (np.abs(step) / DT <= ACCELERATION * DT * EXCESS).all()


@pytest.mark.parametrize("seed", range(3))
def test_samples_stay_on_the_path(seed: int) -> None:
    path = bent(seed)
    samples = time_path(path, VELOCITY, ACCELERATION, 5 * DT)
    a, b = path[:-1], path[1:]
    along = np.clip(np.einsum("nmk,mk->nm", samples[:, None] - a, b - a) / ((b - a) ** 2).sum(axis=1), 0, 1)
    distance = np.linalg.norm(samples[:, None] - (a + along[..., None] * (b - a)), axis=2).min(axis=1)
    assert distance.max() < 5e-3  # [rad]


def test_a_straight_path_takes_as_long_as_by_hand() -> None:
    """One joint by 1 rad: it speeds up over 0.5 rad at 4 rad/s2, and slows down over as much."""
    path = np.linspace(0, 1, 50)[:, None] * np.eye(6)[0]
    samples = time_path(path, VELOCITY, ACCELERATION, DT)
    assert (len(samples) - 1) * DT == pytest.approx(2 * np.sqrt(2 * 0.5 / 4.0), rel=0.02)
    assert np.diff(samples[:, 0]).min() > -1e-9


@pytest.mark.parametrize("seed", range(8))
def test_a_straight_path_is_gone_along_as_fast_as_can_be(seed: int) -> None:
    """One limit is used in full all the time: the speed's, or the acceleration's; and samples stay on the
    line."""
    rng = np.random.default_rng(seed)
    ends = rng.uniform(-1.0, 1.0, (2, 6)) * (0.05 if seed % 2 else 2.0)
    samples = time_path(
        ends[0] + np.sort(rng.uniform(0, 1, 50))[:, None] * (ends[1] - ends[0]), VELOCITY, ACCELERATION, DT
    )
    whole = samples[-1] - samples[0]
    along = (samples - samples[0]) @ whole / (whole @ whole)
    np.testing.assert_allclose(samples, samples[0] + along[:, None] * whole, atol=1e-12)
    speed = np.abs(np.diff(samples, axis=0)) / DT / VELOCITY
    rate = np.abs(np.diff(samples, n=2, axis=0)) / DT**2 / ACCELERATION
    slower = 1.0 + 2.0 / len(samples)  # a whole number of steps
    assert speed.max() <= 1 + 1e-6 and rate.max() <= 1 + 1e-6
    full = np.maximum(np.minimum(speed[1:], speed[:-1]).max(axis=1), rate.max(axis=1)) > 1 / slower**2 - 1e-6
    assert (~full).sum() <= 3  # the steps in which it changes from the one to the other


def test_the_closed_form_agrees_with_toppra(monkeypatch: pytest.MonkeyPatch) -> None:
    for seed in range(4):
        start, end = np.random.default_rng(seed).uniform(-1.5, 1.5, (2, 6)) * (0.1 if seed % 2 else 1.0)
        path = start + np.linspace(0, 1, 60)[:, None] * (end - start)
        exact = time_path(path, VELOCITY, ACCELERATION, DT)
        with monkeypatch.context() as patch:
            patch.setattr(timing, "_straight", lambda points: False)
            sampled = time_path(path, VELOCITY, ACCELERATION, DT)
        assert len(exact) == pytest.approx(len(sampled), rel=0.01, abs=2)
        assert len(exact) <= len(sampled) + 1


def test_a_path_that_comes_back_is_not_straight() -> None:
    path = np.zeros((4, 6))
    path[:, 0] = 0.0, 1.0, 0.5, 1.5
    assert timing._straight(path[[0, 1, 3]]) and not timing._straight(path)
    path[1, 1] = 1e-6
    assert not timing._straight(path[[0, 1, 3]])


def test_a_corner_does_not_break_the_limits() -> None:
    """Two edges at a right angle, blended tightly because nothing else is free."""
    corner = np.zeros((3, 6))
    corner[1, 0] = corner[2, 0] = 1.0
    corner[2, 1] = 1.0
    path = blend_corners(corner, lambda q: False, radius=0.02)
    samples = time_path(path, VELOCITY, ACCELERATION, DT)
    fastest, hardest = limit_margins(samples, VELOCITY, ACCELERATION, DT)
    assert fastest <= EXCESS * ROUNDING and hardest <= EXCESS * ROUNDING


@pytest.mark.parametrize("limits", [HandLimits(0.05, 0.2), HandLimits(0.2, 0.1)])
def test_the_hand_keeps_its_own_limits(limits: HandLimits) -> None:
    travel = np.linspace(0, 0.1, 200)
    path = np.sin(travel[:, None] * np.array([3.0, -2.0, 1.0, 0.5, 0.2, 0.1]))
    samples = time_path(path, VELOCITY, ACCELERATION, DT, travel, limits)
    assert samples.shape[1] == 6
    distance = np.interp(samples[:, 0], path[:, 0], travel)  # the first joint grows with the travel
    assert (np.diff(distance) / DT).max() <= limits.speed * EXCESS * ROUNDING
    rise = max(limits.speed**2 / limits.acceleration, 0.0)
    expected = (
        0.1 / limits.speed + limits.speed / limits.acceleration
        if rise < 0.1
        else 2 * np.sqrt(0.1 / limits.acceleration)
    )
    assert (len(samples) - 1) * DT == pytest.approx(expected, rel=0.03)


def test_a_path_that_goes_nowhere_is_one_sample() -> None:
    still = np.tile(np.arange(6.0), (5, 1))
    np.testing.assert_array_equal(time_path(still, VELOCITY, ACCELERATION, DT), still[:1])
    np.testing.assert_array_equal(time_path(still[:1], VELOCITY, ACCELERATION, DT), still[:1])
    assert limit_margins(still[:2], VELOCITY, ACCELERATION, DT) == (0.0, 0.0)


def test_repeated_points_do_no_harm() -> None:
    path = bent(0)
    repeated = np.repeat(path, 2, axis=0)
    np.testing.assert_allclose(
        time_path(repeated, VELOCITY, ACCELERATION, DT),
        time_path(path, VELOCITY, ACCELERATION, DT),
        atol=1e-9,
    )


def test_the_same_path_has_the_same_timing() -> None:
    first, second = (time_path(bent(1), VELOCITY, ACCELERATION, DT) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_a_timing_that_needs_too_much_stretching_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing, "_stretch", lambda *_: 10.0)
    with pytest.raises(TimingError, match="10.0 times slower"):
        time_path(bent(0), VELOCITY, ACCELERATION, DT)
