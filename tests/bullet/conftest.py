"""The two-arm cell and its robot."""

from __future__ import annotations

import pytest

from soma_bullet.robot.cell import load_cell
from soma_bullet.robot.kinematics import Robot
from soma_bullet.robot.model import Cell
from tests.bullet.hand_world import STAND


@pytest.fixture(scope="session")
def cell() -> Cell:
    return load_cell("ur5e_pair")


@pytest.fixture(scope="session")
def robot(cell: Cell) -> Robot:
    return Robot(cell, STAND)
