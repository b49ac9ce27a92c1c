"""A world whose left hand stands open, and may grip what lies between its pads."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from soma_bullet.assembly.model import Assembly
from soma_bullet.bullet.quiet import pybullet as p
from soma_bullet.bullet.simulator import BulletSimulator
from soma_bullet.frames import (
    Array,
)
from soma_bullet.robot.model import Cell
from soma_bullet.world.options import Physics

STAND = (0.03, 0.03)
GRAVITY = 9.81  # [m/s2]
GRIP = 20.0  # [N]


def home(cell: Cell) -> Array:
    return np.array([arm.q_home for arm in cell.arms])


@contextmanager
def running(
    cell: Cell,
    whole: Assembly,
    poses: dict[str, Array],
    physics: Physics | None = None,
    opening: float = 0.0,
    q: Array | None = None,
) -> Iterator[BulletSimulator]:
    """A world whose left hand stands open from the start."""
    qs = home(cell)
    qs[0] = qs[0] if q is None else q
    world = BulletSimulator(cell, whole, STAND, poses, qs, physics or Physics())
    try:
        for joint in world.finger_joints[0]:
            p.resetJointState(world.robots[0], joint, opening / 2, physicsClientId=world.client)
        world.open_hand(0, opening)
        yield world
    finally:
        world.close()


def run(world: BulletSimulator, seconds: float) -> None:
    for _ in range(round(seconds / world.time_step)):
        world.step()


def grip(world: BulletSimulator, force: float = GRIP) -> None:
    """Close the left hand as the executor does: gently, then harder and harder."""
    world.squeeze(0, 5.0)
    run(world, 0.25)
    for part in np.linspace(5.0, force, 72):
        world.squeeze(0, part)
        world.step()
