"""Transfers around obstacles: free all along, repeatable, and clear about why not."""

from __future__ import annotations

import numpy as np
import pytest

from soma_bullet.frames import Array
from soma_bullet.motion.transfer import (
    EDGE_STEP,
    TransferError,
    TransferOptions,
    blend_corners,
    edge_free,
    plan_transfer,
)
from soma_bullet.robot.cell import load_cell
from soma_bullet.robot.collision import CollisionModel, Situation
from soma_bullet.robot.kinematics import Robot

LOWER, UPPER = np.full(6, -2 * np.pi), np.full(6, 2 * np.pi)
START, GOAL = np.array([-1.0, 0, 0, 0, 0, 0]), np.array([1.0, 0, 0, 0, 0, 0])


def wall(q: Array) -> bool:
    """Between start and goal; the way leads around it in the second joint."""
    return bool(abs(q[0]) < 0.4 and abs(q[1]) < 0.8)


def finely_free(path: Array, collides: object, step: float = 0.005) -> bool:
    for a, b in zip(path[:-1], path[1:], strict=True):
        count = max(1, int(np.ceil(np.abs(b - a).max() / step)))
        if any(collides(a + (b - a) * k / count) for k in range(count + 1)):  # type: ignore[operator]
            return False
    return True


def test_a_free_edge_is_taken_as_it_is() -> None:
    far = GOAL + 0.5
    path = plan_transfer(START, np.array([far, GOAL]), LOWER, UPPER, lambda q: False, TransferOptions())
    np.testing.assert_array_equal(path, [START, GOAL])  # the nearest of the goals


@pytest.mark.parametrize("seed", range(5))
def test_it_goes_around_the_wall(seed: int) -> None:
    assert not edge_free(START, GOAL, wall)
    path = plan_transfer(START, GOAL[None], LOWER, UPPER, wall, TransferOptions(seed=seed))
    np.testing.assert_allclose(path[[0, -1]], [START, GOAL], atol=1e-12)
    assert all(edge_free(a, b, wall) for a, b in zip(path[:-1], path[1:], strict=True))
    assert np.abs(path[:, 1]).max() > 0.7
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    assert length < 6.0  # around the corners takes 2 sqrt(0.6**2 + 0.8**2) + 0.8 = 2.8
    # between checked states an edge may cut a corner by less than its step
    assert finely_free(path, lambda q: abs(q[0]) < 0.4 - EDGE_STEP and abs(q[1]) < 0.8 - EDGE_STEP)


@pytest.mark.parametrize("seed", range(3))
def test_the_same_seed_gives_the_same_path(seed: int) -> None:
    first, second = (
        plan_transfer(START, GOAL[None], LOWER, UPPER, wall, TransferOptions(seed=seed)) for _ in range(2)
    )
    np.testing.assert_array_equal(first, second)
    other = plan_transfer(START, GOAL[None], LOWER, UPPER, wall, TransferOptions(seed=seed + 100))
    assert other.shape != first.shape or np.abs(other - first).max() > 1e-6


def test_a_goal_behind_the_wall_is_taken_if_the_near_one_is_blocked() -> None:
    blocked, free = np.zeros(6), GOAL
    path = plan_transfer(START, np.array([blocked, free]), LOWER, UPPER, wall, TransferOptions())
    np.testing.assert_allclose(path[-1], free, atol=1e-12)


@pytest.mark.parametrize(
    ("start", "goals", "cause", "q"),
    [(np.zeros(6), GOAL[None], "start", np.zeros(6)), (START, np.zeros((1, 6)), "goal", np.zeros(6)),
     (START, np.zeros((0, 6)), "goal", None)],
)  # fmt: skip
def test_what_is_wrong_at_the_ends(start: Array, goals: Array, cause: str, q: Array | None) -> None:
    with pytest.raises(TransferError) as caught:
        plan_transfer(start, goals, LOWER, UPPER, wall, TransferOptions())
    assert caught.value.cause == cause
    assert q is None if caught.value.q is None else caught.value.q == pytest.approx(q)


def test_a_search_ends_by_its_count_of_checks() -> None:
    calls = [0]

    def shut(q: Array) -> bool:
        calls[0] += 1
        return bool(abs(q[0]) < 0.4)

    with pytest.raises(TransferError, match="budget"):
        plan_transfer(START, GOAL[None], LOWER, UPPER, shut, TransferOptions(checks=2000))
    assert 2000 < calls[0] < 4000


def test_the_limits_hold() -> None:
    lower, upper = LOWER.copy(), UPPER.copy()
    lower[1], upper[1] = -0.2, 1.5  # the way below is shut
    for seed in range(4):
        path = plan_transfer(START, GOAL[None], lower, upper, wall, TransferOptions(seed=seed))
        assert (path >= lower - 1e-12).all() and (path <= upper + 1e-12).all()
        assert path[:, 1].max() > 0.7


def test_edges_are_checked_at_every_step() -> None:
    seen: list[Array] = []
    assert edge_free(START, GOAL, lambda q: bool(seen.append(q)))
    places = np.sort(np.array(seen)[:, 0])
    assert np.diff(np.concatenate([[-1.0], places])).max() <= EDGE_STEP + 1e-12
    assert places[-1] == 1.0
    thin = lambda q: abs(q[0] - 0.3) < EDGE_STEP / 2 + 1e-9  # noqa: E731
    assert not edge_free(START, GOAL, thin)


def test_blended_corners_are_dense_smooth_and_free() -> None:
    path = np.array([START, [0.0, 0.9, 0, 0, 0, 0], GOAL])
    hull = lambda q: abs(q[0]) < 0.02 and q[1] < 0.875  # noqa: E731
    loose, tight = blend_corners(path, lambda q: False), blend_corners(path, hull)
    for dense in (loose, tight):
        np.testing.assert_array_equal(dense[[0, -1]], path[[0, -1]])
        assert np.abs(np.diff(dense, axis=0)).max() <= EDGE_STEP + 1e-12
        assert (np.abs(np.diff(dense, axis=0)).max(axis=1) > 1e-9).all()
    assert loose[:, 1].max() < tight[:, 1].max() <= 0.9
    assert not any(hull(q) for q in tight)
    turns = [
        np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)) for a, b in _steps(loose)
    ]
    assert max(turns) < 0.3  # the corner alone turns by 1.46


def _steps(path: Array) -> list[tuple[Array, Array]]:
    steps = np.diff(path, axis=0)
    return list(zip(steps[:-1], steps[1:], strict=True))


def test_the_arm_goes_around_the_stand_and_the_other_arm() -> None:
    """From one feed area to the other, low: free all along by the collision model's own word."""
    robot = Robot(load_cell("ur5e_pair"), (0.05, 0.05))
    scene = CollisionModel(robot, {}).scene(Situation({}, frozenset({0})))

    def collides(q: Array) -> bool:
        return scene.collides(robot.configuration(np.array([q, robot.home[1]]), robot.closed))

    T = np.diag((1.0, -1.0, -1.0, 1.0))
    T[:3, 3] = (0.0, 0.25, 0.03)
    start = next(q for q in robot.inverse(0, T, robot.home[0]) if not collides(q))
    T[1, 3] = -0.25
    goals = robot.inverse(0, T, start)
    arm = robot.arm(0)
    path = plan_transfer(start, goals, arm.lower, arm.upper, collides, TransferOptions(seed=1))
    assert all(edge_free(a, b, collides) for a, b in zip(path[:-1], path[1:], strict=True))
    assert not any(collides(q) for q in blend_corners(path, collides))
    assert robot.tcp(0, path[-1])[:3, 3] == pytest.approx(T[:3, 3], abs=1e-6)
