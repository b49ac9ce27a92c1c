"""The survey of the 240 cubes: what it reports of one cube is so, and does not depend on the workers."""

from __future__ import annotations

from dataclasses import replace

import pytest

from soma_bullet.assembly.packings import soma_cube
from soma_bullet.grasp.hand import Hand
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.qualities import Qualities
from soma_bullet.robot.cell import find_hand
from soma_bullet.validation.cubes import CubeTurns, cube_table, stable_order, survey_cubes


@pytest.fixture(scope="module")
def hand() -> Hand:
    return find_hand("ur5e_pair")


def test_an_order_that_is_found_stands_at_every_step(hand: Hand) -> None:
    cube = soma_cube(7)
    order = stable_order(cube)
    assert order is not None and sorted(order) == list(range(7))
    judge = Qualities(cube, HandSet.alike(hand), PlannerOptions())
    for k, piece in enumerate(order):
        assert judge.stability(frozenset(order[: k + 1])).verdict != "unstable"
        assert judge.assemblability(piece, frozenset(order[:k])).direction is not None


@pytest.mark.slow
def test_the_survey_is_the_same_in_one_worker_and_in_two() -> None:
    found = [survey_cubes(0, 2, 6, False, 3, jobs, lambda: None) for jobs in (1, 2)]
    first, second = ([replace(turn, cpu=0.0) for turn in turns] for _, turns in found)
    assert first == second
    assert all(turn.asked == 6 and turn.stable == 6 for turn in first)


def test_the_table_counts() -> None:
    turns = [CubeTurns(0, 6, 6, 4, 0.3), CubeTurns(1, 6, 5, 0, 0.3)]
    table = cube_table([], turns)
    assert "| an order stands throughout: orientations | 11 of 12 |" in table
    assert "| ... cubes, in every orientation / in some | 1 / 2 |" in table
    assert "can be gripped: orientations | 4 of 12 |" in table
