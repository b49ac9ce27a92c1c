"""Packings: every one, once, against a search that is too simple to be wrong; and sides that stand."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import pytest

from soma_bullet.errors import InputError
from soma_bullet.figure.cover import Cover, NodesSpent, Placement
from soma_bullet.figure.drawing import drawing_of
from soma_bullet.figure.packing import (
    check_count,
    find_packings,
    layers_text,
    placements_in,
    possible_counts,
    supply_of,
    symmetries,
)
from soma_bullet.figure.pieces import PIECES, Cells
from soma_bullet.figure.rank import apart_price, stands_on
from soma_bullet.figure.sides import connected_parts, firmness_of, sides_of

MANY = 1_000_000
DOG = [
    ["......", ".##..."],
    ["......", "###..."],
    [".#....", ".#####", ".#...."],
    ["##.###", ".#####", "##.###"],
]
DOG[0] += ["......"]
DOG[1] += ["......"]
ARCH = [
    ["##...##", "##...##", "#######", ".#####.", "..###..", "...#..."],
    ["#.....#", ".......", ".......", ".......", "...#...", "......."],
]
CRUCIFORM = [[".#.", "...", ".#."], *[[".#.", "###", ".#."]] * 5]
CHURCH = [
    [".....", "..#.."], [".....", ".###."], [".....", "#####"], [".....", "#####"], [".....", "#####"],
    [".###.", "#####"],
]  # fmt: skip
CUBE = [["###"] * 3] * 3


def cells_of(layers: list[list[str]]) -> Cells:
    return drawing_of(layers, "x").cells


def box(x: int, y: int, z: int) -> Cells:
    return tuple(itertools.product(range(x), range(y), range(z)))


def simple(cells: Cells, letters: tuple[str, ...]) -> Iterator[frozenset[tuple[str, Cells]]]:
    """Packings by all of some pieces: one piece after the other is put wherever there is room."""
    if not letters:
        if not cells:
            yield frozenset()
        return
    for put in placements_in(cells, letters[0]):
        rest = tuple(cell for cell in cells if cell not in put)
        for others in simple(rest, letters[1:]):
            yield others | {(letters[0], put)}


def counted(cells: Cells, supply: dict[str, int]) -> int:
    """Packings by any choice of the pieces."""
    every = [letter for letter, count in supply.items() for _ in range(count)]
    choices = {c for size in range(len(every) + 1) for c in itertools.combinations(every, size)}
    fitting = [c for c in choices if sum(len(PIECES[letter]) for letter in c) == len(cells)]
    return len({packing for letters in fitting for packing in simple(cells, letters)})


@pytest.mark.parametrize(
    ("cells", "pieces"),
    [
        (box(2, 2, 2), "VLTZABP"),
        (box(3, 2, 2), "VLTZABP"),
        (box(4, 2, 1), "VLTZABP"),
        (box(4, 2, 1), "LL"),
        (box(3, 2, 1), "VV"),
        (cells_of([["####", "#..#"], ["#..#", "...."]]), "VLTZABP"),
        (cells_of([["#####", "#.#.#"], ["#...#", "....."]]), "VLLTZ"),
        (cells_of([["##.##", "#...#"]]), "VVL"),
    ],
)
def test_all_packings_are_found_with_some_of_the_pieces(cells: Cells, pieces: str) -> None:
    found = find_packings(cells, supply_of(pieces), MANY)
    assert found.complete and found.placed == counted(cells, supply_of(pieces))
    for packing in found.found:
        assert sorted(cell for _, part in packing for cell in part) == list(cells)


@pytest.mark.parametrize(
    ("layers", "count"),
    [(DOG, 20), (ARCH, 8), (CHURCH, 14), (CRUCIFORM, 0)],
    ids=("dog", "arch", "church", "x"),
)
def test_known_figures_have_as_many_packings_as_are_known(layers: list[list[str]], count: int) -> None:
    assert find_packings(cells_of(layers), supply_of("VLTZABP"), MANY).placed == count


def test_the_cube_has_480_that_no_rotation_maps_onto_each_other() -> None:
    found = find_packings(cells_of(CUBE), supply_of("VLTZABP"), MANY)
    assert (found.placed, len(found.found), found.distinct) == (11520, 2880, 480)


def test_the_search_ends_at_its_limits_and_says_so() -> None:
    few = find_packings(cells_of(CUBE), supply_of("VLTZABP"), MANY, most=3)
    assert len(few.found) == 3 and not few.complete
    stopped = find_packings(cells_of(CUBE), supply_of("VLTZABP"), 200)
    assert not stopped.complete and stopped.nodes == 201


def test_a_cover_tells_when_its_nodes_are_spent() -> None:
    cover = Cover(2, [Placement("a", 1), Placement("a", 2)], {"a": 2}, 2)
    with pytest.raises(NodesSpent):
        list(cover.solutions())
    assert list(Cover(2, cover.placements, {"a": 2}, 9).solutions()) == [(0, 1)]
    assert list(Cover(2, cover.placements, {"a": 1}, 9).solutions()) == []


def test_counts_of_cells_that_are_possible_are_told() -> None:
    assert possible_counts(supply_of("VLT")) == (3, 4, 7, 8, 11)
    with pytest.raises(InputError, match="x: has 5 cells; some of the pieces V, L have 3, 4 or 7"):
        check_count("x", box(5, 1, 1), supply_of("VL"))
    with pytest.raises(
        InputError, match="--pieces: 'VX': there is no piece X; there are V, L, T, Z, A, B, P"
    ):
        supply_of("VX")


def test_symmetries_and_letters() -> None:
    assert len(symmetries(box(3, 3, 3))) == 24 and len(symmetries(box(3, 2, 1))) == 4
    (packing,) = find_packings(cells_of([["###", "#.."]]), supply_of("L"), MANY).found
    assert layers_text(packing) == "LLL\nL..\n"


def test_sides_come_once_as_drawn_first_and_the_firmest_next() -> None:
    assert [side.side for side in sides_of(box(3, 3, 3))] == ["as-drawn"]
    flat = sides_of(box(4, 3, 1))
    assert [side.side for side in flat] == ["as-drawn", "front", "left"]
    assert flat[1].cells == box(4, 1, 3)
    assert [side.side for side in sides_of(box(4, 3, 1), "back")] == ["back"]
    assert not any(side.falls for side in flat) and flat[0].firmness == pytest.approx(3.0)


def test_what_falls_as_one_piece_is_told() -> None:
    assert "outside what they stand on" in firmness_of(cells_of([["#..."], ["####"]]))[0]
    assert "on the rim of" in firmness_of(cells_of([["#.", ".."], ["##", ".."], [".#", ".."]]))[0]
    assert "2 of its cells hang in the air" in firmness_of(cells_of([["##..."], ["...##"]]))[0]
    assert len(connected_parts(cells_of([["##.#"]]))) == 2


def test_what_comes_straight_up_is_the_cheapest() -> None:
    flat, bridge = [["LLL.VV", "L...V."]], [["L..", "..."], ["LLL", "..."], [".VV", "..V"]]
    drawn = [drawing_of(layers, "x").packing for layers in (flat, bridge)]
    assert drawn[0] and drawn[1]
    price, order = apart_price(drawn[0])
    assert price == 0.0 and sorted(order) == [0, 1]
    assert apart_price(drawn[1])[0] > 0.0
    assert stands_on(box(2, 1, 1), (True, True)) and not stands_on(box(3, 1, 1), (True, False, False))
