"""The three blocks at other sizes: what is measured for Soma pieces follows the pieces' size, and light ones
are held in shorter time steps."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.bullet.stage import JERKED, substeps
from soma_bullet.episode import run_episode
from soma_bullet.options import EpisodeOptions
from soma_bullet.pipeline import cell_of
from soma_bullet.task.segment import DT
from soma_bullet.verdict.options import Tolerance
from soma_bullet.world.options import Physics

ROOT = Path(__file__).parents[1]
SMALL_HAND = str(ROOT / "tests/data/mixed_pair/hand.toml")


def scaled(factor: float, folder: Path) -> Path:
    """The three blocks, all lengths times a factor."""
    meshes = ROOT / "meshes/soma"
    for name in ("V", "L", "Z"):
        rows = [line.split() for line in (meshes / f"{name}.obj").read_text().splitlines()]
        for row in rows:
            if row[:1] == ["v"]:
                row[1:] = [f"{float(x) * factor:.9g}" for x in row[1:]]
        (folder / f"{name}.obj").write_text("\n".join(map(" ".join, rows)) + "\n")

    def times(found: re.Match[str]) -> str:
        return found[1] + re.sub(r"[\d.]+", lambda value: repr(float(value[0]) * factor), found[2])

    text = (meshes / "soma3.toml").read_text()
    text = re.sub(r"(position = |clearance = |chamfer = )(\[[^\]]*\]|[\d.]+)", times, text)
    (folder / "soma3.toml").write_text(text)
    return folder / "soma3.toml"


@pytest.mark.parametrize("force", [None, 30.0])
def test_no_step_of_a_grip_is_worth_more_than_is_held(tmp_path: Path, force: float | None) -> None:
    cell = cell_of(EpisodeOptions())
    for factor in (0.5, 0.6, 1.0, 2.0):
        whole = load_assembly(str(scaled(factor, tmp_path)))
        count = substeps(Physics(grip_force=force), cell, whole)
        worth = (force or cell.arms[0].hand.grip_force) * DT / min(piece.mass for piece in whole.pieces)
        assert worth / count <= JERKED
        assert count == 1 or worth / (count - 1) > JERKED  # no more than it takes
    assert substeps(Physics(substeps=4), cell, whole) == 4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("factor", "hand", "most"), [(2.0, None, 4.0), (0.6, SMALL_HAND, 2.0)], ids=["doubled", "small"]
)
def test_another_size_is_built(factor: float, hand: str | None, most: float, tmp_path: Path) -> None:
    """With a hand that fits: of two tries one at least."""
    file = str(scaled(factor, tmp_path))
    for seed in (2, 3):
        options = EpisodeOptions(hand=hand, seed=seed, tolerance=Tolerance(mm=most))
        report = run_episode(file, options)
        assert report is not None
        if report.success:
            return
    pytest.fail(str(report.judgement.causes))
