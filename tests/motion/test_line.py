"""Straight lines of the hand: straight, on one branch, and clear about why not."""

from __future__ import annotations

import numpy as np
import pytest

from soma_bullet.frames import Array, rotation_angle
from soma_bullet.motion.line import LARGEST_JOINT_STEP, SPACING, STEP, LineError, line_back, sample_line
from soma_bullet.robot.cell import load_cell
from soma_bullet.robot.kinematics import Robot

STRAIGHT = 1e-4  # [m]
AXES = {"up": (0.0, 0.0, 1.0), "aside": (0.0, 1.0, 0.0), "diagonal": (0.0, np.sqrt(0.5), np.sqrt(0.5))}


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot(load_cell("ur5e_pair"), (0.05, 0.05))


def start(robot: Robot, arm: int) -> tuple[Array, Array]:
    """Joints and pose of a hand that looks down at the middle."""
    T = np.diag((1.0, -1.0, -1.0, 1.0))
    T[:3, 3] = (0.0, 0.0, 0.15)
    return robot.inverse(arm, T, robot.home[arm])[0], T


def deviation(robot: Robot, arm: int, path: Array, T: Array, axis: Array) -> tuple[float, float]:
    """Largest distance [m] from the line and rotation [rad], at the samples and midway between them."""
    middles = (path[1:] + path[:-1]) / 2
    poses = np.array([robot.tcp(arm, q) for q in (*path, *middles)])
    offsets = poses[:, :3, 3] - T[:3, 3]
    aside = offsets - np.outer(offsets @ axis, axis)
    turns = [rotation_angle(T[:3, :3], pose[:3, :3]) for pose in poses]
    return float(np.linalg.norm(aside, axis=1).max()), float(max(turns))


@pytest.mark.parametrize("arm", [0, 1])
@pytest.mark.parametrize("name", sorted(AXES))
def test_a_sampled_line_is_straight(robot: Robot, arm: int, name: str) -> None:
    q, T = start(robot, arm)
    axis = np.array(AXES[name])
    path, distances = sample_line(robot, arm, q, 0.08 * axis)
    np.testing.assert_array_equal(path[0], q)
    assert distances[0] == 0.0 and distances[-1] == pytest.approx(0.08)
    assert np.diff(distances).max() <= SPACING + 1e-12
    aside, turn = deviation(robot, arm, path, T, axis)
    assert aside < STRAIGHT
    assert turn < 1e-4
    ends = np.array([robot.tcp(arm, q)[:3, 3] - T[:3, 3] for q in path]) @ axis
    np.testing.assert_allclose(ends, distances, atol=1e-6)


@pytest.mark.parametrize("arm", [0, 1])
def test_a_traced_line_ends_where_it_should(robot: Robot, arm: int) -> None:
    q, T = start(robot, arm)
    away = np.array(AXES["diagonal"])
    path = line_back(robot, arm, q, T, away, 0.06, lambda _: False)
    np.testing.assert_array_equal(path[0], q)
    assert len(path) == 1 + round(0.06 / STEP)
    assert np.abs(np.diff(path, axis=0)).max() <= LARGEST_JOINT_STEP
    aside, turn = deviation(robot, arm, path, T, away)
    assert aside < STRAIGHT * 5 and turn < 1e-3  # 5 mm apart; what runs is sampled ten times finer
    assert robot.tcp(arm, path[-1])[:3, 3] == pytest.approx(T[:3, 3] + 0.06 * away, abs=1e-6)


def test_every_state_of_a_line_is_checked(robot: Robot) -> None:
    q, T = start(robot, 0)
    seen: list[Array] = []
    path = line_back(robot, 0, q, T, np.array(AXES["up"]), 0.05, lambda p: bool(seen.append(p)))
    np.testing.assert_array_equal(seen, path)


def test_a_collision_says_where(robot: Robot) -> None:
    q, T = start(robot, 0)
    up = np.array(AXES["up"])
    with pytest.raises(LineError) as caught:
        line_back(robot, 0, q, T, up, 0.1, lambda p: robot.tcp(0, p)[2, 3] > T[2, 3] + 0.042)
    assert caught.value.cause == "collision"
    assert caught.value.at == pytest.approx(0.045)
    assert caught.value.q is not None
    assert robot.tcp(0, caught.value.q)[2, 3] == pytest.approx(T[2, 3] + 0.045)
    with pytest.raises(LineError) as caught:
        line_back(robot, 0, q, T, up, 0.1, lambda p: True)
    assert caught.value.at == 0.0


def test_out_of_reach(robot: Robot) -> None:
    q, T = start(robot, 0)
    for trace in (
        lambda: line_back(robot, 0, q, T, np.array((1.0, 0.0, 0.0)), 1.5, lambda _: False),
        lambda: sample_line(robot, 0, q, np.array((1.5, 0.0, 0.0)), spacing=0.01),
    ):
        with pytest.raises(LineError) as caught:
            trace()
        assert caught.value.cause in ("unreachable", "branch")
        assert 0.1 < caught.value.at < 1.5


def test_a_jump_to_another_branch_is_no_line(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    q, T = start(robot, 0)
    monkeypatch.setattr(robot, "follow", lambda arm, pose, previous: previous + LARGEST_JOINT_STEP + 0.01)
    with pytest.raises(LineError) as caught:
        line_back(robot, 0, q, T, np.array(AXES["up"]), 0.05, lambda _: False)
    assert (caught.value.cause, caught.value.at) == ("branch", pytest.approx(STEP))


def test_no_line_at_all(robot: Robot) -> None:
    q, _ = start(robot, 0)
    path, distances = sample_line(robot, 0, q, np.zeros(3))
    assert distances.max() == 0.0
    np.testing.assert_allclose(path, np.tile(q, (len(path), 1)), atol=1e-6)
