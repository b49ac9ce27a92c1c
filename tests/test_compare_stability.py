"""The comparison of stability verdicts: what is drawn, what compas-cra answers, and that the table is the seed's alone."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from blocks import assembly, box

from soma_bullet.errors import InputError
from soma_bullet.planner.equilibrium import equilibrium_margin
from soma_bullet.records import read_json, to_tree
from soma_bullet.rigid_blocks import RigidBlocks, signed_margin, weakest_direction
from soma_bullet.subassemblies import SIDE, Placement, assembly_of, random_placements
from soma_bullet.validation import BAND, PULL, Comparison, examine, table

ROOT = Path(__file__).resolve().parents[1]
BOTH = frozenset({0, 1})


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
    whole = assembly([box((0.02,) * 3, "post"), box((0.1, 0.02, 0.002), "plank")], [(0, 0, 0.01), (0.035, 0, 0.021)])
    assert signed_margin(whole, BOTH, "friction") == -np.inf
    assert equilibrium_margin(whole, BOTH, frozenset(), "friction") == 0.0
    assert RigidBlocks(whole).pull() > PULL


def test_compas_cra_knows_one_coefficient_of_friction() -> None:
    pair = [box((0.02,) * 3, "post"), replace(box((0.02,) * 3, "cube"), friction=0.3)]
    with pytest.raises(InputError, match="coefficient of friction"):
        RigidBlocks(assembly(pair, [(0, 0, 0.01), (0, 0, 0.03)]))


@pytest.mark.slow
def test_twenty_states_whatever_the_number_of_workers(tmp_path: Path) -> None:
    """No robust state falls, compas-cra agrees, and two workers write what one writes."""
    found = []
    for jobs in (1, 2):
        options = ["--states", "20", "--seed", "7", "--jobs", str(jobs), "--out", str(tmp_path / str(jobs))]
        command = ["scripts/compare_stability.py", *options]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        run = subprocess.run([sys.executable, *command], cwd=ROOT, env=environment, capture_output=True, text=True, check=True)
        found.append((run.stdout, (tmp_path / str(jobs) / "states.json").read_bytes()))
    assert found[0] == found[1]
    comparison = read_json(Comparison, tmp_path / "1" / "states.json")
    assert table(comparison) == found[0][0]
    assert len(comparison.states) == 20
    for state in comparison.states:
        assert not [trial for trial in state.trials if trial.verdict == "robust" and trial.fell], state.draw
        if abs(state.blocks.margin) > BAND:
            assert (state.blocks.pull < PULL) == (state.blocks.margin > 0), state.draw
    assert to_tree(examine(7, comparison.states[3].draw)) == to_tree(comparison.states[3])
