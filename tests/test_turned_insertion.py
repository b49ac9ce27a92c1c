"""A bar in a slot, which comes turned: it bounces on the rim, finds the slot by searching, and yields to the
walls."""

from __future__ import annotations

from pathlib import Path

import pytest
import trimesh

from soma_bullet.control.options import ExecutionOptions
from soma_bullet.evaluation.line import run_line
from soma_bullet.evaluation.options import EvaluationOptions, Spread
from soma_bullet.options import EpisodeOptions
from soma_bullet.verdict.options import Tolerance

SEED = 402  # bar and slot end 2 deg apart, where 1.1 would fit
LENGTH, WIDTH, DEPTH = 60.0, 14.0, 18.0  # [mm] of the slot


def write_bar_and_slot(folder: Path) -> str:
    """The file of a bar that stands in the slot of a block, 0.3 mm a face."""
    block = trimesh.creation.box((90.0, 50.0, 30.0))
    slot = trimesh.creation.box((LENGTH, WIDTH, 2 * DEPTH))
    slot.apply_translation((0.0, 0.0, 15.0))
    trimesh.boolean.difference([block, slot]).export(folder / "block.stl")
    trimesh.creation.box((LENGTH, WIDTH, 45.0)).export(folder / "bar.stl")
    path = folder / "key.toml"
    path.write_text("""
name = "key"
unit = "mm"
support = { height = 0.0, friction = 0.5 }
defaults = { density = 700.0, friction = 0.5, clearance = 0.3 }
piece = [
  { name = "block", mesh = "block.stl", goal = { position = [0, 0, 15], rpy_deg = [0, 0, 0] } },
  { name = "bar", mesh = "bar.stl", goal = { position = [0, 0, 34.5], rpy_deg = [0, 0, 0] } },
]
""")
    return str(path)


@pytest.mark.slow
@pytest.mark.parametrize("compliant", (True, False))
def test_a_bar_that_comes_turned_goes_in_by_search_and_torque(tmp_path: Path, compliant: bool) -> None:
    """Without compliance it stops on the rim, whatever the friction; what a search needs is tested with the
    guide."""
    options = EvaluationOptions(
        write_bar_and_slot(tmp_path),
        1,
        SEED,
        ("perception",),
        Spread(mm=0.3, deg=2.0, errors="uniform", square=False),
        EpisodeOptions(
            execution=ExecutionOptions(recover=False, compliant=compliant), tolerance=Tolerance(deg=2.5)
        ),
    )
    line = run_line(SEED, options)
    assert line["success"] is compliant, line["causes"]
    assert compliant or line["cause"] == "jammed"
