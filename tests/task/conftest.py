"""The three-block task in the two-arm cell: plan, feed, program and search, made once for all tests
of a process."""

from __future__ import annotations

import pytest

from soma_bullet.assembly.model import Assembly
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.robot.model import Cell
from soma_bullet.task.feed import Feed
from soma_bullet.task.program.program import Program
from soma_bullet.task.schedule import Schedule
from soma_bullet.task.search.scheduler import Scheduler
from soma_bullet.task.search.search import Search
from soma_bullet.task.state import CellState
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


@pytest.fixture
def search(workcell: Workcell, plan: AssemblyPlan, feed: Feed) -> Search:
    return Scheduler(workcell, plan, feed).feed_search


@pytest.fixture(scope="session")
def schedule(workcell: Workcell, plan: AssemblyPlan, feed: Feed) -> Schedule:
    return Scheduler(workcell, plan, feed).find()


@pytest.fixture(scope="session")
def held(workcell: Workcell, feed: Feed, schedule: Schedule) -> CellState:
    """The first piece stands, and is held."""
    state = workcell.idle({name: feed.pose(name) for name in feed.names})
    for action in schedule.assignments[0].actions:
        state = action.effects(workcell, state)
    return state.empty_handed(workcell.robot.home)
