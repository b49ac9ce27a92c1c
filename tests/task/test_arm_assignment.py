"""The order in which the options of a step are tried: what lets one arm fetch while the other inserts comes
first."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
import pytest

from soma_bullet.grasp.graph import Grip
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.task.feed import Feed
from soma_bullet.task.posture import carrying_time
from soma_bullet.task.search.arm_assignment import CHANGE, FETCHING, ArmAssignment, Option
from soma_bullet.task.search.scheduler import Scheduler
from soma_bullet.task.workcell import Workcell

Make = Callable[..., Option]


@pytest.fixture
def make(workcell: Workcell) -> Make:
    """An option of one arm that fetches at home, or where the other arm has its home turned about the middle
    of the stand."""
    grip = Grip(0, np.eye(4), 0.02, 1.0)

    def option(arm: int, cost: float = 0.0, far: bool = False) -> Option:
        home = np.array(workcell.robot.home[arm])[None]
        away = home.copy()
        away[0, :3] = np.deg2rad((-20.0, -45.0, 75.0))  # reaches far across the table
        return Option(arm, arm, grip, cost, away if far else home, away)

    return option


def test_a_fetch_is_hidden_by_the_other_arm_only_where_it_is_clear(workcell: Workcell, make: Make) -> None:
    turns = ArmAssignment(workcell, {})
    assert turns.unhidden(None, make(0)) == turns.unhidden(make(0), make(0)) == FETCHING
    assert turns.unhidden(make(0), make(1)) == CHANGE
    assert turns.unhidden(make(0), make(1, far=True)) == CHANGE + FETCHING


def test_arms_take_turns_unless_that_costs_more(workcell: Workcell, make: Make) -> None:
    cheap = {k: [make(0), make(1, cost=1.0)] for k in range(3)}
    turns = ArmAssignment(workcell, cheap)
    assert turns.ranked(0, None)[0].inserter == 0
    assert turns.ranked(1, cheap[0][0])[0].inserter == 1
    dear = {k: [make(0), make(1, cost=10.0)] for k in range(3)}
    assert ArmAssignment(workcell, dear).ranked(1, dear[0][0])[0].inserter == 0


def test_the_first_option_begins_the_cheapest_sequence(workcell: Workcell, make: Make) -> None:
    rng = np.random.default_rng(3)
    for _ in range(5):
        options = {
            k: [make(arm, rng.uniform(0, 4), far) for arm in (0, 1) for far in (False, True)]
            for k in range(4)
        }
        turns = ArmAssignment(workcell, options)

        def total(sequence: tuple[Option, ...], turns: ArmAssignment = turns) -> float:
            pairs = zip((None, *sequence), sequence, strict=False)
            return sum(turns.unhidden(before, after) + after.cost for before, after in pairs)

        best = min(product(*options.values()), key=total)
        assert turns.ranked(0, None)[0] is best[0]
        assert turns.ranked(2, best[1])[0] is best[2]


def test_options_are_reached_and_free(workcell: Workcell, plan: AssemblyPlan, feed: Feed) -> None:
    search = Scheduler(workcell, plan, feed).feed_search
    found = search.arms.options
    assert sorted(found) == list(range(len(plan.steps))) and all(found.values())
    for k, options in found.items():
        step = plan.steps[k]
        for option in options:
            assert option.grip.index in step.grasps
            T = workcell.settled[step.piece] @ option.grip.T_piece_tcp
            np.testing.assert_allclose(workcell.robot.tcp(option.inserter, option.inserting[0]), T, atol=1e-5)
            at_pick = workcell.robot.tcp(option.fetcher, option.fetching[1])
            if option.fetcher == option.inserter:
                np.testing.assert_allclose(
                    at_pick, feed.pose(step.piece) @ option.grip.T_piece_tcp, atol=1e-5
                )


def test_carrying_takes_as_long_as_its_slowest_joint(workcell: Workcell) -> None:
    home = np.array(workcell.robot.home[0])
    short, long = home.copy(), home.copy()
    short[2] += 0.05
    long[0] += 1.5
    assert 0.0 == carrying_time(workcell.robot, 0, home, home) < carrying_time(workcell.robot, 0, home, short)
    assert carrying_time(workcell.robot, 0, home, long) > carrying_time(workcell.robot, 0, home, short)
    assert carrying_time(workcell.robot, 0, home, long) == carrying_time(workcell.robot, 0, long, home)
