"""What stands and what falls, in the physics of an episode without a robot."""

from __future__ import annotations

from dataclasses import replace

import pytest
from blocks import SIDE, assembly, box, cells

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.bullet.standing import FALLEN_DEG, FALLEN_MM, Standing, stands
from soma_bullet.robot.cell import load_cell
from soma_bullet.robot.model import Cell


@pytest.fixture(scope="module")
def cell() -> Cell:
    return load_cell("ur5e_pair")


def with_clearance(whole: Assembly, clearance: float) -> Assembly:
    return replace(whole, pieces=tuple(replace(piece, clearance=clearance) for piece in whole.pieces))


def tower(shift: float) -> Assembly:
    """Three cubes on each other, each shifted by as much against the one below; they fall beyond a third of a
    side."""
    cube = [box((SIDE,) * 3, str(k)) for k in range(3)]
    return assembly(cube, [(shift * k, 0, SIDE * (k + 0.5)) for k in range(3)])


@pytest.mark.parametrize("clearance", [0.0, 1e-4])
@pytest.mark.parametrize(("shift", "falls"), [(0.0, False), (0.3, False), (0.37, True)])
def test_a_tower_falls_where_its_upper_part_is_past_the_edge(
    cell: Cell, clearance: float, shift: float, falls: bool
) -> None:
    found = stands(with_clearance(tower(shift * SIDE), clearance), range(3), cell)
    assert found.fell == falls
    if not falls:
        assert max(found.moved_mm) < 0.1
        assert max(found.turned_deg) < 0.1


def test_a_lean_closes_its_gap_and_no_more(cell: Cell) -> None:
    """A hook on the edge of a post tips until its lower half meets the post's side, 0.2 mm away; without that
    half it falls."""
    post = cells(
        [(0, 0, k) for k in range(1, 4)] + [(i, j, 0) for i in range(-3, 1) for j in range(-1, 2)], "post"
    )
    beam = [(0, 0, 4), (1, 0, 4), (2, 0, 4)]
    hook = cells([*beam, (1, 0, 3), (1, 0, 2)], "hook")
    leaning = stands(assembly([post, hook], [(0, 0, SIDE / 2)] * 2), range(2), cell)
    assert not leaning.fell
    assert 0.1 < leaning.turned_deg[1] < 2.0
    assert stands(assembly([post, cells(beam, "beam")], [(0, 0, SIDE / 2)] * 2), range(2), cell).fell


def test_pieces_that_are_not_placed_carry_nothing(cell: Cell) -> None:
    whole = tower(0.0)
    assert stands(whole, {0}, cell).names == ("0",)
    assert stands(whole, {0, 2}, cell, seconds=0.5).moved_mm[1] > FALLEN_MM


def test_falling_is_far_or_turned() -> None:
    assert not Standing(("a",), (FALLEN_MM,), (FALLEN_DEG,)).fell
    assert Standing(("a", "b"), (0.0, 0.0), (0.0, FALLEN_DEG + 0.1)).fell
    assert Standing(("a", "b"), (FALLEN_MM + 0.1, 0.0), (0.0, 0.0)).fell


def test_the_same_state_falls_the_same_way(cell: Cell) -> None:
    falling = tower(0.37 * SIDE)
    assert stands(falling, range(3), cell) == stands(falling, range(3), cell)


@pytest.mark.parametrize("name", ["dominoes", "leonardo"])
def test_what_leans_on_edges_stays(cell: Cell, name: str) -> None:
    """The simulator's edges are round by a millimetre: pieces settle by less than that."""
    whole = load_assembly(name)
    found = stands(whole, range(len(whole.pieces)), cell, seconds=2.0)
    assert max(found.moved_mm) < 1.0
    assert max(found.turned_deg) < 1.0
    assert stands(whole, range(1, len(whole.pieces)), cell, seconds=1.0).fell
