"""What rests is left alone until it is touched."""

from __future__ import annotations

import numpy as np
import pytest

from soma_bullet.bullet.quiet import pybullet as p
from soma_bullet.frames import (
    Array,
    make_transform,
)
from soma_bullet.robot.kinematics import Robot
from soma_bullet.robot.model import Cell
from soma_bullet.world.options import Physics
from tests.blocks import SIDE, assembly, box
from tests.bullet.hand_world import GRAVITY, grip, run, running


def knocked(cell: Cell, asleep: float) -> tuple[Array, Array]:
    """Where the centres (3, 3) of a low block, of one on top of it and of one beside them are, after a rest
    and at the end.

    The one beside, which never sleeps, is kicked: it knocks the low one out from under the other.
    """
    names = ("low", "top", "beside")
    blocks = [box((SIDE,) * 3, name) for name in names]
    whole = assembly(blocks, [(0, 0, SIDE / 2), (0, 0, SIDE * 1.5), (-4 * SIDE, 0, SIDE / 2)])
    poses = {
        b.name: make_transform(translation=(0, 0.25, 0)) @ goal
        for b, goal in zip(blocks, whole.goals, strict=True)
    }
    with running(cell, whole, poses, Physics(asleep=asleep, substeps=1)) as world:
        kicked = world.pieces["beside"]
        p.changeDynamics(
            kicked, -1, activationState=p.ACTIVATION_STATE_DISABLE_SLEEPING, physicsClientId=world.client
        )  # fmt: skip
        run(world, 3.0)
        before = world.piece_poses()
        run(world, 0.5)
        rested = world.piece_poses()
        if asleep:  # that it has not moved at all is how sleep shows
            assert all(np.array_equal(before[name], rested[name]) for name in names[:2])
        p.resetBaseVelocity(kicked, [2.0, 0, 0], [0, 0, 0], physicsClientId=world.client)
        run(world, 0.5)
        first, last = (
            np.array([poses[name][:3, 3] for name in names]) for poses in (rested, world.piece_poses())
        )
        return first, last


def test_what_sleeps_wakes_when_it_is_touched(cell: Cell) -> None:
    (rested, end), (rested_awake, end_awake) = knocked(cell, Physics().asleep), knocked(cell, 0.0)
    np.testing.assert_allclose(rested, rested_awake, atol=5e-6)
    assert end_awake[0, 0] > 1.5 * SIDE  # as far as it slides from under the one on top
    assert np.ptp(end_awake[:2, 2]) > SIDE / 2
    np.testing.assert_allclose(end, end_awake, atol=3e-3)


def test_what_a_hand_holds_does_not_sleep(cell: Cell, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor does what is stacked on it, unlike blocks on the table: alone, or on each other."""
    names = ("held", "on it", "low", "top")
    blocks = [box((SIDE, SIDE, 3 * SIDE), "held"), *(box((SIDE,) * 3, name) for name in names[1:])]
    T = robot.tcp(0, cell.arms[0].q_home)
    on_it = make_transform(translation=(0, 0, 2 * SIDE)) @ T
    table = [make_transform(translation=(0.0, 0.25, SIDE * (k + 0.5))) for k in range(2)]
    with running(
        cell,
        assembly(blocks, [(0, 0, 0)] * 4),
        dict(zip(names, [T, on_it, *table], strict=True)),
        opening=SIDE + 2e-3,
    ) as world:
        p.setGravity(0, 0, 0, physicsClientId=world.client)
        grip(world)
        p.setGravity(0, 0, -GRAVITY, physicsClientId=world.client)
        told = set[int]()
        real = p.changeDynamics
        monkeypatch.setattr(
            p, "changeDynamics", lambda body, *args, **named: (told.add(body), real(body, *args, **named))
        )
        run(world, 2.0)
        assert world.piece_poses()["on it"][2, 3] > 0.2  # still there
    assert told == {world.pieces["low"], world.pieces["top"]}
