"""The three-block case, the slim hand, and its plan."""

from __future__ import annotations

from pathlib import Path

import pytest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.grasp.hand import Hand, load_hand
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.plan import make_plan

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
