"""Packings of a figure by Soma pieces; those that a rotation maps onto each other count once."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

from soma_bullet.errors import InputError, NoSolutionError
from soma_bullet.figure.cover import Cover, NodesSpent, Placement
from soma_bullet.figure.pieces import (
    PIECES,
    TURNS,
    Cells,
    Turn,
    at_origin,
    lowest_corner,
    orientations,
    turned,
)

Packing = tuple[tuple[str, Cells], ...]  # letter and cells of every piece, sorted
UPRIGHT = tuple(turn for turn in TURNS if turn[2] == (0, 0, 1))  # rotations about the vertical


class NoPackingError(NoSolutionError):
    """The pieces do not fill the figure; the search was complete unless it says otherwise."""

    def __init__(self, summary: str):
        super().__init__("packing", summary)


@dataclass(frozen=True)
class Packings:
    """What a search for packings found.

    Attributes:
        placed: how many there are, as placed.
        found: one of each set that the figure's rotations about the vertical map onto each other, in the
            order of the search.
        distinct: number of sets that all rotations of the figure map onto each other.
        complete: the search came to its end.
        nodes: that it visited.
    """

    placed: int
    found: tuple[Packing, ...] = field(repr=False)
    distinct: int
    complete: bool
    nodes: int


def supply_of(letters: str) -> dict[str, int]:
    """How often each piece is there. Raises InputError."""
    given = [letter.upper() for letter in letters if letter not in ", "]
    strange = sorted({letter for letter in given if letter not in PIECES})
    if strange or not given:
        what = f"there is no piece {', '.join(strange)}" if strange else "names no piece"
        raise InputError("--pieces", f"{letters!r}: {what}; there are {', '.join(PIECES)}")
    return {letter: given.count(letter) for letter in PIECES if letter in given}


def possible_counts(supply: dict[str, int]) -> tuple[int, ...]:
    """Numbers of cells that some of the pieces have together, sorted."""
    sums = {0}
    for letter, count in supply.items():
        for _ in range(count):
            sums |= {total + len(PIECES[letter]) for total in sums}
    return tuple(sorted(sums - {0}))


def check_count(name: str, cells: Cells, supply: dict[str, int]) -> None:
    """Refuse a figure that has as many cells as no choice of the pieces. Raises InputError."""
    counts = possible_counts(supply)
    if len(cells) in counts:
        return
    letters = ", ".join(letter for letter, count in supply.items() for _ in range(count))
    wanted = ", ".join(map(str, counts[:-1])) + (" or " if counts[1:] else "") + str(counts[-1])
    raise InputError(name, f"has {len(cells)} cells; some of the pieces {letters} have {wanted}")


def symmetries(cells: Cells, turns: tuple[Turn, ...] = TURNS) -> tuple[Turn, ...]:
    """Those of some rotations that map a figure onto itself, up to a shift."""
    shape = at_origin(cells)
    return tuple(turn for turn in turns if at_origin(turned(shape, turn)) == shape)


def turned_packing(packing: Packing, turn: Turn) -> Packing:
    """A packing after a rotation, with its lowest corner at the origin."""
    pieces = [(letter, turned(cells, turn)) for letter, cells in packing]
    i, j, k = lowest_corner(tuple(cell for _, cells in pieces for cell in cells))
    return tuple(
        sorted(
            (letter, tuple(sorted((x - i, y - j, z - k) for x, y, z in cells))) for letter, cells in pieces
        )
    )


def first_image(packing: Packing, turns: tuple[Turn, ...]) -> Packing:
    """The first of all images of a packing: the same for all that the rotations map onto each other."""
    return min((turned_packing(packing, turn) for turn in turns), default=packing)


def find_packings(cells: Cells, supply: dict[str, int], nodes: int, most: int | None = None) -> Packings:
    """Packings of a figure at the origin by some or all of the pieces.

    Args:
        supply: how often each piece is there.
        nodes: that the search may visit.
        most: end after so many that no rotation about the vertical maps onto each other.
    """
    number = {cell: k for k, cell in enumerate(cells)}
    upright, every = symmetries(cells, UPRIGHT), symmetries(cells)
    choices = _reduced(cells, supply, upright)
    places = [(letter, put) for letter in supply for put in choices[letter]]
    placements = [Placement(letter, sum(1 << number[cell] for cell in put)) for letter, put in places]
    cover = Cover(len(cells), placements, supply, nodes)
    found: dict[Packing, Packing] = {}
    placed, complete = 0, True
    try:
        for numbers in cover.solutions():
            packing = tuple(sorted(places[k] for k in numbers))
            images = {turned_packing(packing, turn) for turn in upright}
            first = min(images)
            if first not in found:
                found[first] = packing
                placed += len(images)
            if most is not None and len(found) == most:
                complete = False
                break
    except NodesSpent:
        complete = False
    distinct = len(found) if len(every) == len(upright) else len({first_image(p, every) for p in found})
    return Packings(placed, tuple(found.values()), distinct, complete, cover.nodes)


def _reduced(cells: Cells, supply: dict[str, int], turns: tuple[Turn, ...]) -> dict[str, list[Cells]]:
    """The placements of each piece; of the one with the most only the first of those that the figure's
    rotations map onto each other: some rotation brings every packing to one of these."""
    choices = {letter: sorted(placements_in(cells, letter)) for letter in supply}
    single = [letter for letter, count in supply.items() if count == 1]
    if len(turns) > 1 and single:
        widest = max(single, key=lambda letter: len(choices[letter]))
        corners = {turn: lowest_corner(turned(cells, turn)) for turn in turns}

        def image(put: Cells, turn: Turn) -> Cells:
            i, j, k = corners[turn]
            return tuple(sorted((x - i, y - j, z - k) for x, y, z in turned(put, turn)))

        choices[widest] = [put for put in choices[widest] if put == min(image(put, turn) for turn in turns)]
    return choices


def placements_in(cells: Cells, letter: str) -> Iterator[Cells]:
    """All ways to put a piece into a figure, turned but not mirrored."""
    inside = set(cells)
    for shape in orientations(PIECES[letter]):
        (i, j, k) = shape[0]
        for x, y, z in cells:
            put = tuple((a + x - i, b + y - j, c + z - k) for a, b, c in shape)
            if inside.issuperset(put):
                yield tuple(sorted(put))


def layers_text(packing: Packing) -> str:
    """A packing as letters, layer by layer from the bottom up."""
    letter_at = {cell: letter for letter, cells in packing for cell in cells}
    wide, deep, high = (1 + max(cell[axis] for cell in letter_at) for axis in range(3))
    layers = [
        "\n".join("".join(letter_at.get((x, y, z), ".") for x in range(wide)) for y in range(deep))
        for z in range(high)
    ]
    return "\n\n".join(layers) + "\n"


def used(packing: Packing) -> str:
    """The letters of a packing's pieces, in the order of the pieces."""
    count = Counter(letter for letter, _ in packing)
    return "".join(letter * count[letter] for letter in PIECES)
