"""Upkeep of a grip: the pads touch anew, one after the other, where the hand has turned, and before the path
ends."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from soma_bullet.bullet.upkeep import EVERY, STALE, STALE_POINTS, GripUpkeep
from soma_bullet.frames import make_transform, rotation_about

PADS = 2


def renewed(turns: list[float], flat: bool = True) -> list[tuple[int, int]]:
    """At which samples of a path which pad's contacts form anew.

    Args:
        turns: of the hand [rad], at every sample.
    """
    at, found = [0.0], list[tuple[int, int]]()
    world: Any = SimpleNamespace(
        pieces={"piece": 0},
        finger_links={0: [(0, k) for k in range(PADS)]},
        touches_flat=lambda piece: flat,
        tcp_pose=lambda arm: make_transform(rotation_about((0, 0, 1), at[0])),
        renew_contacts=lambda arm, finger: found.append((sample, finger)),
    )
    upkeep = GripUpkeep(world, 0, "piece", len(turns))
    for sample, turn in enumerate(turns):
        at[0] = turn
        if sample:
            upkeep.at(sample)
    return found


@pytest.mark.parametrize("samples", [40, 101, 480])
def test_both_pads_touch_anew_before_the_path_ends(samples: int) -> None:
    """However little the hand has turned, and neither in the last samples, when it comes to rest."""
    found = renewed([0.0] * samples)
    assert [pad for _, pad in found] == [1, 0]
    first, second = (sample for sample, _ in found)
    assert second - first == EVERY and first == samples - 1 - PADS * EVERY


@pytest.mark.parametrize(("flat", "lasting"), [(True, STALE), (False, STALE_POINTS)])
def test_pads_touch_anew_whenever_the_hand_has_turned(flat: bool, lasting: float) -> None:
    turns = np.linspace(0.0, 3.5 * lasting, 701).tolist()
    found = renewed(turns, flat)
    before_the_end = [entry for entry in found if entry[0] < len(turns) - 1 - PADS * EVERY]
    assert [pad for _, pad in before_the_end] == [1, 0] * 3
    looks = np.diff([0.0, *(turns[sample] for sample, _ in before_the_end[::2])])
    assert (looks > lasting - 1e-9).all() and (looks <= lasting + turns[EVERY] + 1e-9).all()
    times = [sample for sample, _ in found]
    assert min(np.diff(times)) >= EVERY  # the other pad keeps the piece where it is


def test_a_hand_that_turns_less_is_left_alone_until_then() -> None:
    found = renewed(np.linspace(0.0, 0.9 * STALE, 300).tolist())
    assert len(found) == PADS
