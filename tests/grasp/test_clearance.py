"""Clearance of hands: what the boxes of the very hand, opened to the very width, leave free."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from manifold3d import Manifold

from soma_bullet.assembly.hulls import Hull, box_hull
from soma_bullet.frames import Array, Indices, make_transform, readonly, rotation_about
from soma_bullet.grasp.clearance import (
    MARGIN,
    clear_of_piece,
    clear_of_scene,
    hand_hulls,
    hands_clear,
    sweep_hand,
    sweep_hands,
)
from soma_bullet.grasp.hand import Box, load_hand
from soma_bullet.grasp.hand_set import HandSet

ROOT = Path(__file__).resolve().parents[2]
SLIM = load_hand(ROOT / "robots/ur5e_pair/hand.toml")
SMALL = load_hand(ROOT / "tests/data/mixed_pair/hand.toml")
HANDS = HandSet.of([SLIM, SMALL])
CORNERS = np.sqrt(3)  # a gap along the best axis is at most this much smaller than the distance


def drawn(count: int, seed: int, reach: float = 0.06) -> tuple[Indices, Array, Array]:
    """Kinds (n,), TCP poses (n, 4, 4) and widths (n,) of hands about the origin, in no order of kinds."""
    rng = np.random.default_rng(seed)
    poses = [
        make_transform(
            rotation_about(rng.normal(size=3), rng.uniform(0, np.pi)), rng.uniform(-reach, reach, 3)
        )
        for _ in range(count)
    ]
    kinds = rng.integers(0, 2, count)
    widest = np.array([SLIM.opening, SMALL.opening])[kinds] - 0.008
    return kinds, np.array(poses), rng.uniform(0.002, widest)


def scene() -> list[Hull]:
    return [
        box_hull(np.array(place), np.eye(3), np.full(3, 0.012)) for place in ((0, 0, 0), (0.05, 0.02, 0.03))
    ]


def distance(first: list[Hull], second: list[Hull]) -> float:
    """Distance of two bodies of polytopes [m], up to 20 mm; 0 where they meet."""
    solids = [[Manifold.hull_points(hull.vertices * 1e3) for hull in hulls] for hulls in (first, second)]
    return min(one.min_gap(other, 20.0) for one in solids[0] for other in solids[1]) * 1e-3


@pytest.mark.parametrize("sweep", [None, np.array((0.01, -0.02, 0.04))], ids=["still", "swept"])
def test_hands_together_are_what_they_are_apart(sweep: Array | None) -> None:
    kinds, poses, widths = drawn(40, 1)
    together = sweep_hands(HANDS, kinds, poses, widths, sweep=sweep)
    assert len(together) == 40
    alone = [
        sweep_hand(HANDS.kinds[kinds[k]], poses[[k]], widths[[k]], sweep=sweep) for k in range(len(kinds))
    ]
    np.testing.assert_allclose(
        together.separation(scene()), [one.separation(scene())[0] for one in alone], atol=1e-12
    )
    np.testing.assert_allclose(together.above(-0.05), [one.above(-0.05)[0] for one in alone], atol=1e-12)
    others = sweep_hands(HANDS, *drawn(30, 2, reach=0.12))
    clear = hands_clear(together, others)
    assert clear.shape == (40, 30) and 0.1 < clear.mean() < 0.9
    np.testing.assert_array_equal(clear, np.vstack([hands_clear(one, others) for one in alone]))
    np.testing.assert_array_equal(clear.T, hands_clear(others, together))


def test_one_kind_is_the_hand_itself() -> None:
    _, poses, widths = drawn(25, 3)
    one, kind = sweep_hand(SLIM, poses, widths), np.zeros(25, int)
    other = sweep_hands(HandSet.alike(SLIM), kind, poses, widths)
    (first,), (second,) = one.groups, other.groups
    np.testing.assert_array_equal(first.centres, second.centres)
    np.testing.assert_array_equal(first.generators, second.generators)


def test_no_hands_are_clear_of_everything() -> None:
    none = sweep_hands(HANDS, np.zeros(0, int), np.zeros((0, 4, 4)), np.zeros(0))
    some = sweep_hands(HANDS, *drawn(3, 4))
    assert none.separation(scene()).shape == none.above(0.0).shape == (0,)
    assert hands_clear(none, some).shape == (0, 3)
    assert clear_of_scene(some, (), None).all()


def test_two_hands_are_clear_where_their_boxes_are_apart() -> None:
    """Against the distance of the two bodies with the pads at their widths, each of its own kind."""
    first, second = drawn(25, 5, reach=0.02), drawn(25, 6, reach=0.08)
    sweeps = [sweep_hands(HANDS, *hands, opening=0.0, way_out=0.0) for hands in (first, second)]
    clear = hands_clear(*sweeps)
    bodies = [
        [hand_hulls(HANDS.kinds[kind], T, float(width)) for kind, T, width in zip(*hands, strict=True)]
        for hands in (first, second)
    ]
    gaps = np.array([[distance(one, other) for other in bodies[1]] for one in bodies[0]])
    assert gaps[clear].min() > MARGIN - 1e-6
    assert gaps[~clear].max() < CORNERS * MARGIN
    assert 0.1 < clear.mean() < 0.9


@pytest.mark.parametrize(("holder", "width"), [(0, 0.01), (0, 0.06), (1, 0.01), (1, 0.022)])
def test_a_finger_reaches_as_far_as_it_is_open(holder: int, width: float) -> None:
    """Two hands from opposite sides, finger beside finger: clear at a little more than the margin."""
    outer = [max(float(box.T[0, 3] + box.half[0]) for box in hand.left_boxes) for hand in HANDS.kinds]
    reach = width / 2 + outer[holder] + outer[0]  # the other hand, the slim one, is shut
    pose = make_transform()[None]
    hold = sweep_hands(HANDS, np.array([holder]), pose, np.array([width]), opening=0.0, way_out=0.0)
    for gap, clear in ((0.9 * MARGIN, False), (1.1 * MARGIN, True)):
        opposite = make_transform(np.diag((1.0, -1.0, -1.0)), (reach + gap, 0.0, 0.0))[None]
        other = sweep_hands(HANDS, np.array([0]), opposite, np.zeros(1), opening=0.0, way_out=0.0)
        assert hands_clear(hold, other).item() == clear
        assert hands_clear(other, hold).item() == clear


def test_a_hand_has_the_room_on_a_piece_that_its_own_fingers_need() -> None:
    """A wall 6.5 mm beside the middle of the pads: the slim hand's are 14 mm wide, the small one's 10 mm."""
    foot = box_hull(np.zeros(3), np.eye(3), np.array((0.005, 0.02, 0.02)))
    wall = box_hull(np.array((0.01, 0.0115, 0.0)), np.eye(3), np.array((0.005, 0.005, 0.02)))
    kinds, T, widths = np.array([1, 0, 1]), np.eye(4)[None].repeat(3, axis=0), np.full(3, 0.01)
    assert clear_of_piece(HANDS, kinds, T, widths, [foot]).all()
    assert clear_of_piece(HANDS, kinds, T, widths, [foot, wall]).tolist() == [True, False, True]


def test_a_turned_box_goes_with_straight_ones() -> None:
    """A box of a hand may stand askew: it is swept as what it is."""
    askew = Box(
        readonly(make_transform(rotation_about((0, 1, 0), 0.5), (0.0, 0.03, -0.05))),
        readonly(np.array((0.01, 0.004, 0.02))),
    )
    hand = replace(SLIM, palm_boxes=(*SLIM.palm_boxes, askew))
    _, poses, widths = drawn(20, 8)
    sweep = sweep_hand(hand, poses, widths, opening=0.0, way_out=0.0)
    gaps = sweep.separation(scene())
    for T, width, gap in zip(poses, widths, gaps, strict=True):
        far = distance(hand_hulls(hand, T, float(width)), scene())
        assert far >= min(gap, 0.02) - 1e-6
        assert gap <= 0 or far <= CORNERS * gap + 1e-6 or gap > 0.005
