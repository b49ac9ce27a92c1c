"""The three-block case, the slim hand, its plan, the log of an episode made by hand, and its film's shots."""

from __future__ import annotations

from pathlib import Path

import pytest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.grasp.hand import Hand, load_hand
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.pictures.crew import Shot
from soma_bullet.pictures.film import storyboard
from soma_bullet.pictures.options import FilmOptions
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.plan import make_plan
from soma_bullet.robot.cell import load_cell
from soma_bullet.robot.model import Cell
from soma_bullet.world.log import ExecutionLog
from tests.pictures.logs import made_log

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def soma3() -> Assembly:
    return load_assembly("soma3")


@pytest.fixture(scope="session")
def hand() -> Hand:
    return load_hand(ROOT / "robots/ur5e_pair/hand.toml")


@pytest.fixture(scope="session")
def plan(soma3: Assembly, hand: Hand) -> AssemblyPlan:
    return make_plan(soma3, HandSet.alike(hand), PlannerOptions(stability="paper"))


@pytest.fixture(scope="session")
def assembly() -> Assembly:
    return load_assembly("soma3")


@pytest.fixture(scope="session")
def cell() -> Cell:
    return load_cell("ur5e_pair")


@pytest.fixture(scope="session")
def log(cell: Cell, assembly: Assembly) -> ExecutionLog:
    return made_log(cell, assembly)


@pytest.fixture(scope="session")
def board(log: ExecutionLog, assembly: Assembly, cell: Cell) -> list[Shot]:
    return storyboard(log, assembly, cell, FilmOptions(), "every piece is in place")
