"""The nearest facet of a hull, found without the others, is the one that qhull finds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from soma_bullet.planner.paper_stability import smallest_offset

SEEDS = st.integers(0, 2**32 - 1)


@given(SEEDS, st.integers(2, 6), st.integers(0, 60))
def test_it_is_that_of_the_whole_hull(seed: int, dimension: int, more: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(dimension + 2 + more, dimension)) + rng.normal(size=dimension) * rng.random()
    expected = -ConvexHull(points).equations[:, -1].max()
    found = smallest_offset(points)
    if expected > 0.0:
        assert found == pytest.approx(expected, abs=1e-7)
    else:  # outside: some facet that says so
        assert expected - 1e-7 <= found < 1e-7


@given(SEEDS, st.integers(2, 5))
def test_coplanar_points_do_no_harm(seed: int, dimension: int) -> None:
    """A box with points all over its faces, turned: the nearest face is the nearest of the box's."""
    rng = np.random.default_rng(seed)
    low, high = -rng.uniform(0.2, 1.0, dimension), rng.uniform(0.2, 1.0, dimension)
    corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(dimension, -1).T
    inner = rng.uniform(low, high, (30, dimension))
    axis = rng.integers(dimension, size=30)
    inner[np.arange(30), axis] = np.where(rng.random(30) < 0.5, low[axis], high[axis])
    turn = np.linalg.qr(rng.normal(size=(dimension, dimension)))[0]
    points = np.vstack([corners, inner, corners * 0.5]) @ turn
    assert smallest_offset(points) == pytest.approx(min((-low).min(), high.min()), abs=1e-9)


def test_the_origin_outside_is_negative_and_a_flat_hull_is_zero() -> None:
    square = np.array([(1.0, -1.0), (3.0, -1.0), (1.0, 1.0), (3.0, 1.0)])
    assert smallest_offset(square) == pytest.approx(-1.0)
    assert smallest_offset(np.column_stack([square, np.zeros(4)])) == 0.0


@given(SEEDS)
def test_it_scales(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(40, 6))
    assert smallest_offset(3.0 * points) == pytest.approx(3.0 * smallest_offset(points), rel=1e-6, abs=1e-9)
