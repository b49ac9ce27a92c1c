"""Which hands the arms have: equal ones are one kind, and a pair takes two arms."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import pytest

from soma_bullet.errors import InputError
from soma_bullet.grasp.hand import Hand, load_hand
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.robot.cell import load_cell

ROOT = Path(__file__).resolve().parents[2]
SLIM, MIXED = ROOT / "robots/ur5e_pair/hand.toml", ROOT / "tests/data/mixed_pair"


@pytest.fixture(scope="module")
def slim() -> Hand:
    return load_hand(SLIM)


@pytest.fixture(scope="module")
def small() -> Hand:
    return load_hand(MIXED / "hand.toml")


def test_equal_hands_are_one_kind(slim: Hand, small: Hand) -> None:
    hands = HandSet.of([slim, small, load_hand(SLIM), slim])
    assert hands.kinds == (slim, small)
    assert hands.arms == (0, 1, 0, 0)
    assert hands.names == ("slim_hand", "small_hand", "slim_hand", "slim_hand")
    assert [hands.of_arm(arm) is slim for arm in range(4)] == [True, False, True, True]


def test_kinds_go_by_the_arms(slim: Hand, small: Hand) -> None:
    assert HandSet.of([small, slim]).kinds == (small, slim)
    assert HandSet.alike(slim, 3).arms == HandSet.of([slim] * 3).arms == (0, 0, 0)


@pytest.mark.parametrize("change", [{"grip_force": 15.0}, {"opening": 0.08}, {"pad_friction": 0.5}])
def test_another_figure_is_another_kind(slim: Hand, change: dict[str, float]) -> None:
    assert HandSet.of([slim, replace(slim, **change)]).arms == (0, 1)


def test_another_urdf_is_another_kind(slim: Hand, small: Hand) -> None:
    assert HandSet.of([slim, replace(slim, urdf=small.urdf)]).arms == (0, 1)
    assert HandSet.of([slim, replace(slim, palm_boxes=small.palm_boxes)]).arms == (0, 1)


def test_a_pair_takes_two_arms(slim: Hand, small: Hand) -> None:
    two, three = HandSet.of([slim, small]), HandSet.of([slim, small, slim])
    assert two.pairs.tolist() == [[False, True], [True, False]]
    assert three.pairs.tolist() == [[True, True], [True, False]]
    assert HandSet.alike(slim).pairs.tolist() == [[True]]
    assert HandSet.alike(slim, 1).pairs.tolist() == [[False]]
    for hands in (two, three):
        for first, second in product(range(2), repeat=2):
            assert hands.pairs[first, second] == hands.can([first, second])


def test_hands_at_once_are_a_part_of_those_there_are(slim: Hand, small: Hand) -> None:
    hands = HandSet.of([slim, small, slim])
    assert hands.can([]) and hands.can([1]) and hands.can([0, 1, 0])
    assert not hands.can([0, 0, 0]) and not hands.can([1, 1])


def test_further_hands_are_like_the_first_in_turn(slim: Hand, small: Hand) -> None:
    hands = HandSet.of([slim, small])
    assert hands.at_least(5).arms == (0, 1, 0, 1, 0)
    assert hands.at_least(1).arms == hands.at_least(2).arms == (0, 1)


def test_a_kind_without_an_arm_is_refused(slim: Hand, small: Hand) -> None:
    with pytest.raises(InputError, match="hands"):
        HandSet((slim, small), (0, 0))
    with pytest.raises(InputError, match="hands"):
        HandSet.of([])


def test_a_cell_tells_the_hands_of_its_arms() -> None:
    assert load_cell(MIXED).hands.names == ("slim_hand", "small_hand")
    assert load_cell("ur5e_pair").hands.arms == (0, 0)
