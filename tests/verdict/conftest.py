"""The three-block task, the two-arm cell, and the log of a good episode."""

from __future__ import annotations

import pytest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.robot.cell import load_cell
from soma_bullet.robot.model import Cell
from soma_bullet.world.log import ExecutionLog
from tests.verdict.logs import good_log


@pytest.fixture(scope="session")
def assembly() -> Assembly:
    return load_assembly("soma3")


@pytest.fixture(scope="session")
def cell() -> Cell:
    return load_cell("ur5e_pair")


@pytest.fixture(scope="session")
def good(assembly: Assembly, cell: Cell) -> ExecutionLog:
    return good_log(assembly, cell)
