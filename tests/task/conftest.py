"""The three-block task in the two-arm cell: plan, feed and program, made once for all tests of a process."""

from __future__ import annotations

import pytest

from soma_bullet.assembly.model import Assembly
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.robot.model import Cell
from soma_bullet.task.feed import Feed
from soma_bullet.task.program.program import Program
from soma_bullet.task.workcell import Workcell
from tests import soma3 as task


@pytest.fixture(scope="session")
def workcell() -> Workcell:
    return task.planned()[0]


@pytest.fixture(scope="session")
def soma3(workcell: Workcell) -> Assembly:
    return workcell.assembly


@pytest.fixture(scope="session")
def cell(workcell: Workcell) -> Cell:
    return workcell.cell


@pytest.fixture(scope="session")
def plan() -> AssemblyPlan:
    return task.planned()[1]


@pytest.fixture(scope="session")
def program() -> Program:
    return task.planned()[2]


@pytest.fixture(scope="session")
def feed(program: Program) -> Feed:
    return program.feed


@pytest.fixture(scope="session")
def loosened() -> Program:
    return task.loosened()
