"""One arm of a cell as a URDF of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from soma_bullet.robot.cell import load_cell, parse_urdf
from soma_bullet.robot.compose import compose_urdf

ROOT = Path(__file__).resolve().parents[2]
STAND = (0.03, 0.03)


def test_arms_apart_are_the_arms_of_the_whole(tmp_path: Path) -> None:
    cell = load_cell("ur5e_pair")
    whole = parse_urdf(compose_urdf(cell, STAND, tmp_path / "cell.urdf", visuals=False, fixtures=False))
    apart = [
        parse_urdf(
            compose_urdf(
                cell, STAND, tmp_path / f"{arm.name}.urdf", visuals=False, fixtures=False, arms=[arm]
            )
        )
        for arm in cell.arms
    ]
    assert [link.name for link in whole.links] == [
        "world",
        *(link.name for one in apart for link in one.links[1:]),
    ]
    joints = [joint for one in apart for joint in one.joints]
    for expected, found in zip(whole.joints, joints, strict=True):
        assert (expected.name, expected.parent, expected.child) == (found.name, found.parent, found.child)
        np.testing.assert_array_equal(expected.origin, found.origin)


@pytest.mark.parametrize("name", sorted(path.parent.name for path in ROOT.glob("robots/*/cell.toml")))
def test_without_frames_everything_with_mass_or_shape_stays_where_it_is(name: str, tmp_path: Path) -> None:
    cell = load_cell(name)
    whole = compose_urdf(cell, STAND, tmp_path / "whole.urdf", visuals=False)
    bare = compose_urdf(cell, STAND, tmp_path / "bare.urdf", visuals=False, frames={cell.arms[0].tcp_link})
    solid = [link.name for link in parse_urdf(whole).links if link.collisions or link.inertial.mass > 1e-3]
    left = {link.name for link in parse_urdf(bare).links}
    assert left == {"world", cell.arms[0].tcp_link, *solid}
    models = [pin.buildModelFromUrdf(str(file)) for file in (whole, bare)]
    assert list(models[0].names) == list(models[1].names)
    pin.seed(0)
    q = pin.randomConfiguration(models[0], models[0].lowerPositionLimit, models[0].upperPositionLimit)
    placed = []
    for model in models:
        data = model.createData()
        pin.framesForwardKinematics(model, data, q)
        placed.append([data.oMf[model.getFrameId(link)].homogeneous for link in sorted(left - {"world"})])
    np.testing.assert_allclose(placed[1], placed[0], atol=1e-9)
