"""One arm of a cell as a URDF of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from soma_bullet.robot.cell import load_cell, parse_urdf
from soma_bullet.robot.compose import compose_urdf

STAND = (0.03, 0.03)


def test_arms_apart_are_the_arms_of_the_whole(tmp_path: Path) -> None:
    cell = load_cell("ur5e_pair")
    whole = parse_urdf(compose_urdf(cell, STAND, tmp_path / "cell.urdf", visuals=False, fixtures=False))
    apart = [
        parse_urdf(compose_urdf(cell, STAND, tmp_path / f"{arm.name}.urdf", visuals=False, fixtures=False, arms=[arm]))
        for arm in cell.arms
    ]
    assert [link.name for link in whole.links] == ["world", *(link.name for one in apart for link in one.links[1:])]
    joints = [joint for one in apart for joint in one.joints]
    for expected, found in zip(whole.joints, joints, strict=True):
        assert (expected.name, expected.parent, expected.child) == (found.name, found.parent, found.child)
        np.testing.assert_array_equal(expected.origin, found.origin)
