"""Packings of boxes by polycubes, and the Soma cubes."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from soma_bullet.assembly.checks import goal_faults
from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.assembly.packings import (
    CUBE,
    SIDE,
    Packing,
    box_symmetries,
    distinct_packings,
    draw_soma_cubes,
    packings,
    piece_cells,
    placements,
    sides_down,
    soma_cube,
    soma_cubes,
    turned_packing,
)
from soma_bullet.assembly.polycubes import cube_rotations

DOMINO = ((0, 0, 0), (1, 0, 0))
FULL = set(product(range(3), repeat=3))


@pytest.fixture(scope="module")
def cube() -> Assembly:
    return load_assembly("cube")


def filled(assembly: Assembly) -> Packing:
    """The cells of the cube whose centres lie inside each piece at its goal."""
    found = []
    for parts in assembly.goal_parts:
        centres = (np.array(sorted(FULL)) + (0.0, 0.0, 0.5)) * SIDE
        inside = np.any([(centres @ part.normals.T < part.offsets).all(axis=1) for part in parts], axis=0)
        found.append(tuple(cell for cell, held in zip(sorted(FULL), inside, strict=True) if held))
    return tuple(found)


def test_dominoes_fill_a_square_and_a_strip() -> None:
    assert len(list(packings([DOMINO, DOMINO], (2, 2, 1)))) == 4  # two ways, either domino first
    assert len(distinct_packings([DOMINO, DOMINO], (2, 2, 1))) == 1
    assert len(list(packings([DOMINO] * 3, (3, 2, 1)))) == 3 * 6
    assert list(packings([DOMINO], (3, 1, 1))) == []
    assert list(packings([DOMINO, DOMINO], (2, 1, 1))) == []  # one is left over


def test_symmetries_of_boxes() -> None:
    assert [len(box_symmetries(box)) for box in ((3, 3, 3), (2, 2, 1), (3, 2, 1))] == [48, 16, 8]


def test_each_side_is_down_once() -> None:
    assert np.array_equal(sides_down()[0], np.eye(3))
    assert len({tuple(np.rint(turn[2]).astype(int)) for turn in sides_down()}) == len(sides_down()) == 6


def test_placements_of_the_soma_pieces(cube: Assembly) -> None:
    counts = {piece.name: len(placements(piece_cells(piece), CUBE)) for piece in cube.pieces}
    assert counts == {"V": 144, "L": 144, "T": 72, "Z": 72, "A": 96, "B": 96, "P": 64}


def test_there_are_240_soma_cubes() -> None:
    """J. H. Conway and M. J. T. Guy, 1961."""
    assert len(set(soma_cubes())) == 240
    for packing in soma_cubes():
        assert len(packing) == 7
        assert sorted(cell for cells in packing for cell in cells) == sorted(FULL)


def test_no_symmetry_takes_one_soma_cube_to_another() -> None:
    """Their images are all different; that there are no others, see below."""
    turned = {
        frozenset(turned_packing(packing, turn)) for packing in soma_cubes() for turn in box_symmetries(CUBE)
    }
    assert len(turned) == 240 * 48


@pytest.mark.slow
def test_all_packings_are_the_240_in_all_their_positions(cube: Assembly) -> None:
    every = list(packings([piece_cells(piece) for piece in cube.pieces]))
    assert len(every) == len(set(every)) == 240 * 48
    turned = {
        frozenset(turned_packing(packing, turn)) for packing in soma_cubes() for turn in box_symmetries(CUBE)
    }
    assert {frozenset(packing) for packing in every} == turned
    rotated = {turned_packing(packing, turn) for packing in soma_cubes() for turn in cube_rotations()}
    assert len(rotated & set(every)) == 240 * 24


def test_the_cube_of_the_examples_is_one_of_them(cube: Assembly) -> None:
    found = filled(cube)
    images = {frozenset(turned_packing(found, turn)) for turn in box_symmetries(CUBE)}
    assert sum(frozenset(packing) in images for packing in soma_cubes()) == 1


def test_an_assembly_fills_the_cells_of_its_packing() -> None:
    turn = cube_rotations()[17]
    for number in draw_soma_cubes(5, 1):
        upright, turned = soma_cube(number), soma_cube(number, turn)
        assert filled(upright) == soma_cubes()[number]
        assert filled(turned) == turned_packing(soma_cubes()[number], turn)
        assert goal_faults(turned, whole=True) == []
        assert len(turned.contacts) > 14
        assert len({upright.digest, turned.digest, load_assembly("cube").digest}) == 3


def test_mirrored_pieces_are_not_taken_for_each_other(cube: Assembly) -> None:
    """A and B are mirror images: a reflection makes one the other, a packing never does."""
    names = cube.names
    a, b = names.index("A"), names.index("B")
    places_a, places_b = (set(placements(piece_cells(cube.pieces[k]), CUBE)) for k in (a, b))
    assert places_a.isdisjoint(places_b)
    mirror = np.diag((-1, 1, 1))
    for packing in soma_cubes():
        assert packing[a] in places_a and packing[b] in places_b
        assert turned_packing(packing, mirror)[a] in places_b


def test_draws_depend_on_the_seed_alone() -> None:
    assert draw_soma_cubes(6, 0) == draw_soma_cubes(6, 0)
    assert draw_soma_cubes(6, 0) != draw_soma_cubes(6, 1)
    assert draw_soma_cubes(240, 5) == list(range(240))
    again = soma_cube(7)
    assert np.array_equal(again.goals, soma_cube(7).goals) and again.digest == soma_cube(7).digest
