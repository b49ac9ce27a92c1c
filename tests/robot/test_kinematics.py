"""Forward and inverse kinematics of both arms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soma_bullet.frames import Array, translate
from soma_bullet.robot.cell import load_cell
from soma_bullet.robot.kinematics import FK_ERROR, Robot, nearest_turn

COUNT = 300


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot(load_cell("ur5e_pair"), (0.05, 0.05))


def configurations(robot: Robot, arm: int, count: int, seed: int) -> Array:
    limits = robot.arm(arm)
    return np.random.default_rng(seed).uniform(limits.lower, limits.upper, (count, len(limits.lower)))


@pytest.mark.parametrize("arm", [0, 1])
def test_every_configuration_is_found_again(robot: Robot, arm: int) -> None:
    limits, branches = robot.arm(arm), []
    for q in configurations(robot, arm, COUNT, arm):
        T = robot.tcp(arm, q)
        found = robot.inverse(arm, T, q)
        assert np.abs(found - q).max(axis=1).min() < 1e-6, q
        assert np.abs(found[0] - q).max() < 1e-6  # the nearest to the reference comes first
        for solution in found:
            assert np.abs(robot.tcp(arm, solution) - T).max() < FK_ERROR
            assert (solution >= limits.lower).all() and (solution <= limits.upper).all()
        branches.append(len(found))
    assert np.mean(branches) > 4


@pytest.mark.parametrize("arm", [0, 1])
def test_branches_differ_and_lie_near_the_reference(robot: Robot, arm: int) -> None:
    limits, home = robot.arm(arm), robot.home[arm]
    for q in configurations(robot, arm, 50, 10 + arm):
        found = robot.inverse(arm, robot.tcp(arm, q), home)
        assert len(found) > 0
        away = np.abs(found - home)
        # beyond half a turn only where the limits leave no nearer one
        beyond = away > np.pi + 1e-9
        nearer = found - 2 * np.pi * np.sign(found - home)
        assert not (beyond & (nearer >= limits.lower) & (nearer <= limits.upper)).any()
        assert (np.diff(away.max(axis=1)) > -1e-6).all()
        gaps = [np.abs(a - b).max() for i, a in enumerate(found) for b in found[i + 1 :]]
        assert not gaps or min(gaps) > 1e-6


@pytest.mark.parametrize("arm", [0, 1])
def test_what_is_out_of_reach_has_no_solution(robot: Robot, arm: int) -> None:
    far = translate(robot.tcp(arm, robot.home[arm]), (0, 0, 3.0))
    assert robot.inverse(arm, far, robot.home[arm]).shape == (0, 6)
    assert robot.follow(arm, far, robot.home[arm]) is None


@pytest.mark.parametrize("arm", [0, 1])
def test_following_stays_on_its_branch(robot: Robot, arm: int) -> None:
    q = robot.home[arm]
    T = robot.tcp(arm, q)
    for k in range(1, 11):
        after = robot.follow(arm, translate(T, (0, 0, 0.002 * k)), q)
        assert after is not None and np.abs(after - q).max() < 0.05
        assert np.abs(robot.tcp(arm, after) - translate(T, (0, 0, 0.002 * k))).max() < FK_ERROR
        q = after


def test_following_keeps_the_turn(robot: Robot) -> None:
    """A wrist a whole turn on stays there, though the solver knows angles within half a turn only."""
    q = np.array(robot.home[0])
    q[5] += 2 * np.pi if q[5] < 0 else -2 * np.pi
    after = robot.follow(0, robot.tcp(0, q), q)
    assert after is not None and after == pytest.approx(q, abs=1e-6)


def test_one_arm_leaves_the_other_alone(robot: Robot) -> None:
    """Each arm's joints stand where `arm_slots` says; fingers take half the opening each."""
    qs, openings = np.arange(12.0).reshape(2, 6), np.array((0.02, 0.06))
    vector = robot.configuration(qs, openings)
    assert len(vector) == robot.model.nq == 16
    for arm in (0, 1):
        assert vector[robot.arm_slots(arm)] == pytest.approx(qs[arm])
    fingers = np.delete(vector, np.r_[robot.arm_slots(0), robot.arm_slots(1)])
    assert sorted(fingers) == pytest.approx([0.01, 0.01, 0.03, 0.03])


def test_hands_point_down_at_home_or_can(robot: Robot) -> None:
    """A vertical pick in the middle of every feed area is within reach of each arm."""
    for area in robot.cell.feed_areas:
        for arm in (0, 1):
            T = np.diag((1.0, -1.0, -1.0, 1.0))
            T[:3, 3] = (*area.mean(axis=1), 0.02)
            assert len(robot.inverse(arm, T, robot.home[arm])) > 0


@given(data=st.data())
def test_nearest_turn(data: st.DataObject) -> None:
    angles = st.lists(st.floats(-6.28, 6.28), min_size=6, max_size=6).map(np.array)
    q, reference = data.draw(angles), data.draw(angles)
    lower, upper = np.full(6, -2 * np.pi), np.full(6, 2 * np.pi)
    lower[2], upper[2] = -np.pi, np.pi
    reference = np.clip(reference, lower, upper)
    turned = nearest_turn(q, reference, lower, upper)
    assert turned is not None  # every range spans a whole turn
    assert (turned >= lower).all() and (turned <= upper).all()
    assert np.exp(1j * turned) == pytest.approx(np.exp(1j * q), abs=1e-9)
    for k in range(6):
        others = [q[k] + 2 * np.pi * n for n in range(-3, 4)]
        best = min(abs(v - reference[k]) for v in others if lower[k] <= v <= upper[k])
        assert abs(turned[k] - reference[k]) == pytest.approx(best, abs=1e-9)
    assert nearest_turn(np.full(6, 3.0), np.zeros(6), np.full(6, -1.0), np.full(6, 1.0)) is None


@pytest.mark.parametrize("arm", [0, 1])
def test_the_jacobian_is_the_rate_of_the_tcp(robot: Robot, arm: int) -> None:
    """Against central differences: translation of the TCP's origin, rotation in world axes."""
    h = 1e-6
    for q in configurations(robot, arm, 20, 30 + arm):
        jacobian = robot.jacobian(arm, q)
        for joint, step in enumerate(h * np.eye(len(q))):
            after, before = robot.tcp(arm, q + step), robot.tcp(arm, q - step)
            turn = (after[:3, :3] - before[:3, :3]) / (2 * h) @ robot.tcp(arm, q)[:3, :3].T
            rate = np.concatenate(
                [(after[:3, 3] - before[:3, 3]) / (2 * h), (turn[2, 1], turn[0, 2], turn[1, 0])]
            )
            np.testing.assert_allclose(jacobian[:, joint], rate, atol=1e-7)
