"""The comparison of stability verdicts: what is drawn, what compas-cra answers, and that the table is the
seed's alone."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from blocks import assembly, box

from soma_bullet.bullet.standing import stands
from soma_bullet.errors import InputError
from soma_bullet.planner.equilibrium import classify, equilibrium_margin
from soma_bullet.records import read_json, to_tree
from soma_bullet.robot.cell import load_cell
from soma_bullet.robot.model import Cell
from soma_bullet.validation.comparison import (
    BAND,
    CLEARANCES,
    PULL,
    Blocks,
    Comparison,
    State,
    Trial,
    criteria,
    disagreements,
    examine,
    table,
)
from soma_bullet.validation.rigid_blocks import RigidBlocks, signed_margin, weakest_direction
from soma_bullet.validation.subassemblies import SIDE, Placement, assembly_of, random_placements

ROOT = Path(__file__).resolve().parents[1]
BOTH = frozenset({0, 1})


@pytest.fixture(scope="module")
def cell() -> Cell:
    return load_cell("ur5e_pair")


@pytest.mark.parametrize("draw", range(8))
def test_a_random_subassembly_touches_and_overlaps_nothing(draw: int) -> None:
    placements = random_placements(3, draw)
    whole = assembly_of(placements, 1e-4)
    assert 2 <= len(set(whole.names)) == len(placements) <= 6
    touched = {k for contact in whole.contacts for k in (contact.body_a, contact.body_b)}
    assert touched >= set(range(len(placements)))
    assert -1 in touched  # the support
    volume = sum(piece.mesh.volume for piece in whole.pieces)
    cells = {cell for placement in placements for cell in filled(placement)}
    assert min(z for _, _, z in cells) == 0
    assert len(cells) * SIDE**3 == pytest.approx(volume)
    assert random_placements(3, draw) == placements


def filled(placement: Placement) -> list[tuple[int, ...]]:
    """Cells of a placed piece, from its mesh: the grid points that its parts contain."""
    whole = assembly_of([placement], 0.0)
    around = np.stack(np.meshgrid(*[np.arange(-14, 15)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    points = (around + (0, 0, 0.5)) * SIDE
    inside = np.zeros(len(points), bool)
    for part in whole.goal_parts[0]:
        inside |= (points @ part.normals.T < part.offsets).all(axis=1)
    return [tuple(cell) for cell in around[inside].tolist()]


@pytest.mark.parametrize("shift", [-0.004, -0.0012, 0.0008, 0.002])
def test_the_signed_margin_of_a_beam_on_a_post(shift: float) -> None:
    """Its centre of mass is `shift` inside the post's edge and half the beam's height over its top."""
    post, beam = box((0.02, 0.02, 0.02), "post"), box((0.04, 0.02, 0.02), "beam")
    whole = assembly([post, beam], [(0, 0, 0.01), (0.01 - shift, 0, 0.03)])
    margin = signed_margin(whole, BOTH, "friction")
    assert margin == pytest.approx(shift / 0.01, abs=1e-6)
    judge = RigidBlocks(whole)
    assert (judge.pull() < PULL) == (margin > 0)
    # pushed off the post it falls past its margin; pushed onto the post it stands past what it lacks
    off = 0.0 if margin > 0 else np.pi
    assert (judge.pull(abs(margin) - BAND, off) < PULL) == (margin > 0)
    assert (judge.pull(abs(margin) + BAND, off) < PULL) == (margin < 0)
    if margin > 0:
        assert weakest_direction(whole, BOTH, "friction", margin) == pytest.approx(0.0)


def test_what_no_push_can_keep_up_is_infinitely_far_from_standing() -> None:
    whole = assembly(
        [box((0.02,) * 3, "post"), box((0.1, 0.02, 0.002), "plank")], [(0, 0, 0.01), (0.035, 0, 0.021)]
    )
    assert signed_margin(whole, BOTH, "friction") == -np.inf
    assert equilibrium_margin(whole, BOTH, frozenset(), "friction") == 0.0
    assert RigidBlocks(whole).pull() > PULL


def test_compas_cra_knows_one_coefficient_of_friction() -> None:
    pair = [box((0.02,) * 3, "post"), replace(box((0.02,) * 3, "cube"), friction=0.3)]
    with pytest.raises(InputError, match="coefficient of friction"):
        RigidBlocks(assembly(pair, [(0, 0, 0.01), (0, 0, 0.03)]))


def test_what_is_open_when_the_pieces_have_settled_may_not_carry(cell: Cell) -> None:
    """V overhangs B, carries Z, and is held down by P, which settles as far as V: the faces between them stay
    2c apart."""
    tower = [
        Placement("B", 10, (0, 0, 0)),
        Placement("P", 0, (-1, 0, 2)),
        Placement("V", 0, (0, -1, 1)),
        Placement("Z", 4, (0, -1, 3)),
    ]
    everything = frozenset(range(4))
    for clearance, verdict, falls in ((0.0, "robust", False), (1e-4, "clearance-dependent", True)):
        whole = assembly_of(tower, clearance)
        judged = classify(whole, everything)
        assert judged.verdict == verdict
        assert judged.margin == pytest.approx(0.0597, abs=1e-4)  # were all faces closed
        assert stands(whole, everything, cell).fell == falls


def state(
    verdict: str,
    margin: float,
    fell: bool = False,
    tie: bool = False,
    pulls: tuple[float, float] = (0.0, 0.0),
) -> State:
    """What a judgement might be; pulls are those of compas-cra, its cones alike and its own."""
    trials = tuple(
        Trial(c * 1e3, verdict, max(margin, 0.0), max(margin, 0.0), 0.1, fell, 0.0, 0.0) for c in CLEARANCES
    )
    return State(0, (Placement("V", 0, (0, 0, 0)),), tie, trials, Blocks(margin, *pulls, None, None, None))


def test_a_tie_counts_neither_as_standing_nor_as_falling() -> None:
    fell, stood = state("unstable", -0.5, True, pulls=(1.0, 1.0)), state("unstable", -0.5, pulls=(1.0, 1.0))
    robust, tie = state("robust", 0.3), state("unstable", 0.2, tie=True)
    comparison = Comparison(0, 9, (*[fell] * 4, stood, robust, tie, tie))
    lines = table(comparison).splitlines()
    for row in (
        "| robust | 1 | 0 | 1 | 0 |",
        "| unstable, beyond a tie | 1 | 4 | 1 | 4 |",
        "| exact ties | 2 | 0 | 2 | 0 |",
        "| all | 4 | 4 | 4 | 4 |",
        "| above 0.01 | 3 | 0 | 3 | 0 |",
        "| below -0.01 | 0 | 5 | 0 | 5 |",
    ):
        assert row in lines
    found = {c.asked: (c.measured, c.holds) for c in criteria(comparison)}
    assert found["c = 0 mm: unstable states beyond a tie that stand: at most 5%"] == ("1 of 5 (20.0%)", False)
    assert found["c = 0 mm: robust states that fall: none"] == ("0 of 1 (0.0%)", True)
    assert len(list(disagreements(comparison))) == len(CLEARANCES)  # the one that stood


def test_the_same_cones_decide_and_others_are_told() -> None:
    """A state that friction alone decides: compas-cra's own cones, which are wider, hold it."""
    comparison = Comparison(0, 1, (state("unstable", -0.02, True, pulls=(0.1, 1e-6)),))
    found = [c for c in criteria(comparison) if "cones alike" in c.asked]
    assert [c.holds for c in found] == [True]
    assert "| below -0.01 | 0 | 1 | 1 | 0 |" in table(comparison)
    (line,) = disagreements(comparison)
    assert "0.1 with cones alike, 1e-06 with its own" in line


@pytest.mark.slow
def test_eight_states_whatever_the_number_of_workers(tmp_path: Path) -> None:
    """No robust state falls, compas-cra agrees, and two workers write what one writes."""
    found = []
    for jobs in (1, 2):
        options = ["--states", "8", "--seed", "7", "--jobs", str(jobs), "--out", str(tmp_path / str(jobs))]
        command = ["scripts/compare_stability.py", *options]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        run = subprocess.run(
            [sys.executable, *command], cwd=ROOT, env=environment, capture_output=True, text=True, check=True
        )
        found.append((run.stdout, (tmp_path / str(jobs) / "states.json").read_bytes()))
    assert found[0] == found[1]
    comparison = read_json(Comparison, tmp_path / "1" / "states.json")
    assert table(comparison) == found[0][0]
    assert len(comparison.states) == 8
    for state in comparison.states:
        assert not [trial for trial in state.trials if trial.verdict == "robust" and trial.fell], state.draw
        if abs(state.blocks.margin) > BAND:
            assert (state.blocks.pull < PULL) == (state.blocks.margin > 0), state.draw
    assert to_tree(examine(7, comparison.states[3].draw)) == to_tree(comparison.states[3])
