"""The three-block case and the slim hand."""

from __future__ import annotations

from pathlib import Path

import pytest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.grasp.hand import Hand, load_hand

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def soma3() -> Assembly:
    return load_assembly("soma3")


@pytest.fixture(scope="session")
def hand() -> Hand:
    return load_hand(ROOT / "robots/ur5e_pair/hand.toml")
