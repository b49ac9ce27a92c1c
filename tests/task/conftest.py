"""The three-block task in the two-arm cell: plan, feed, schedule and program, made once."""

from __future__ import annotations

import pytest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.plan import make_plan
from soma_bullet.robot.cell import load_cell
from soma_bullet.robot.model import Cell
from soma_bullet.task.feed import Feed, draw_feed
from soma_bullet.task.feed_options import FeedOptions
from soma_bullet.task.program.make import make_program
from soma_bullet.task.program.program import Program
from soma_bullet.task.workcell import Workcell


@pytest.fixture(scope="session")
def soma3() -> Assembly:
    return load_assembly("soma3")


@pytest.fixture(scope="session")
def cell() -> Cell:
    return load_cell("ur5e_pair")


@pytest.fixture(scope="session")
def workcell(soma3: Assembly, cell: Cell) -> Workcell:
    return Workcell(soma3, cell)


@pytest.fixture(scope="session")
def plan(soma3: Assembly, cell: Cell) -> AssemblyPlan:
    return make_plan(soma3, cell.hands)


@pytest.fixture(scope="session")
def feed(soma3: Assembly, plan: AssemblyPlan, cell: Cell) -> Feed:
    return draw_feed(soma3, plan, cell, 0, FeedOptions(poses="preferred"))


@pytest.fixture(scope="session")
def program(workcell: Workcell, plan: AssemblyPlan, feed: Feed) -> Program:
    return make_program(workcell, plan, feed, 0)
