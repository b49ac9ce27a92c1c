"""Packings of a box by polycubes, and the assemblies that they are: the 240 Soma cubes.

A packing is an exact cover of the box's cells, found by depth-first search: the first empty cell must be
filled by some placement of some body that is left (D. Knuth, "Dancing links", 2000, with bit masks in place
of links)."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from itertools import permutations, product

import numpy as np

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.assembly.polycubes import Cell, cell_poses, cube_rotations
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.frames import Array, make_transform, readonly

Box = tuple[int, int, int]
Cells = tuple[Cell, ...]  # sorted
Packing = tuple[Cells, ...]  # the cells that each body fills
CUBE: Box = (3, 3, 3)
SIDE = 0.0185  # [m] of a cell of the meshes of meshes/soma
INSIDE = 1e-6  # [m]


def placements(body: Sequence[Cell], box: Box) -> list[Cells]:
    """All ways to put a body into the box, turned but not mirrored, sorted."""
    found = set()
    for rotation in cube_rotations():
        turned = np.array(body) @ rotation.T.astype(int)
        turned -= turned.min(axis=0)
        for shift in product(
            *(range(size - reach) for size, reach in zip(box, turned.max(axis=0), strict=True))
        ):
            found.add(_sorted(turned + shift))
    return sorted(found)


def packings(bodies: Sequence[Sequence[Cell]], box: Box = CUBE) -> Iterator[Packing]:
    """Every packing of the box by all of the bodies, each used once; in the order of the search."""
    yield from _packings([placements(body, box) for body in bodies], box)


def distinct_packings(bodies: Sequence[Sequence[Cell]], box: Box = CUBE) -> list[Packing]:
    """One packing of each set that the box's rotations and reflections map onto each other, sorted.

    A reflection may take one body for another (A and B of the Soma cube), so that packings are compared as
    partitions."""
    choices, turns = [placements(body, box) for body in bodies], box_symmetries(box)
    images = [_images(turn, box) for turn in turns]
    proper = [image for image, turn in zip(images, turns, strict=True) if np.linalg.det(turn) > 0]
    # some rotation brings the body with the most placements into the first of their orbit: the others need no
    # look
    widest = max(range(len(bodies)), key=lambda k: len(choices[k]))
    choices[widest] = sorted({min(_moved(cells, image) for image in proper) for cells in choices[widest]})
    first: dict[Packing, Packing] = {}
    for packing in _packings(choices, box):
        same = min(tuple(sorted(_moved(cells, image) for cells in packing)) for image in images)
        first[same] = min(packing, first.get(same, packing))
    return sorted(first.values())


def box_symmetries(box: Box) -> list[Array]:
    """Signed permutation matrices (3, 3) that map the box onto itself: 48 for a cube."""
    found = []
    for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
        if all(box[axis] == size for axis, size in zip(order, box, strict=True)):
            matrix = np.zeros((3, 3), int)
            matrix[range(3), order] = signs
            found.append(matrix)
    return found


def turned_packing(packing: Packing, turn: Array, box: Box = CUBE) -> Packing:
    """The packing after a symmetry (3, 3) of the box."""
    image = _images(turn, box)
    return tuple(_moved(cells, image) for cells in packing)


def _images(turn: Array, box: Box) -> dict[Cell, Cell]:
    """Where a symmetry takes each cell of the box."""
    cells = box_cells(box)
    middle = np.array(box) - 1  # in half cells
    turned = ((2 * np.array(cells) - middle) @ np.rint(turn).astype(int).T + middle) // 2
    return {cell: (int(x), int(y), int(z)) for cell, (x, y, z) in zip(cells, turned, strict=True)}


def box_cells(box: Box) -> list[Cell]:
    """All cells of a box, sorted."""
    return list(product(range(box[0]), range(box[1]), range(box[2])))


def _moved(cells: Cells, image: dict[Cell, Cell]) -> Cells:
    return tuple(sorted(image[cell] for cell in cells))


def _sorted(cells: Array) -> Cells:
    return tuple(sorted((int(x), int(y), int(z)) for x, y, z in cells))


def _packings(choices: Sequence[Sequence[Cells]], box: Box) -> Iterator[Packing]:
    bit = {cell: 1 << k for k, cell in enumerate(box_cells(box))}
    full = (1 << len(bit)) - 1
    # by the lowest cell that a placement fills: body, mask, cells
    by_cell: dict[int, list[tuple[int, int, Cells]]] = {value: [] for value in bit.values()}
    for body, options in enumerate(choices):
        for cells in options:
            by_cell[bit[cells[0]]].append((body, sum(bit[cell] for cell in cells), cells))
    picked: list[Cells] = [()] * len(choices)

    def extend(filled: int, left: int) -> Iterator[Packing]:
        if filled == full:
            if not left:
                yield tuple(picked)
            return
        for body, mask, cells in by_cell[~filled & (filled + 1)]:
            if left >> body & 1 and not mask & filled:
                picked[body] = cells
                yield from extend(filled | mask, left & ~(1 << body))

    yield from extend(0, (1 << len(choices)) - 1)


def piece_cells(piece: Workpiece, side: float = SIDE) -> Cells:
    """The cells of a piece made of cubes of that side [m], with the centre of one at the origin of its
    mesh."""
    low, high = (
        np.rint(np.array(end) / side).astype(int)
        for end in (piece.vertices.min(axis=0), piece.vertices.max(axis=0))
    )
    lattice = np.array(list(product(*(range(a, b + 1) for a, b in zip(low, high, strict=True)))))
    held = [(lattice * side @ part.normals.T < part.offsets - INSIDE).all(axis=1) for part in piece.parts]
    return _sorted(lattice[np.any(held, axis=0)])


def packed_assembly(whole: Assembly, packing: Packing, side: float = SIDE) -> Assembly:
    """The pieces of an assembly, packed: goals on its support, with cell (0, 0, 0) above the origin."""
    goals = []
    for piece, cells in zip(whole.pieces, packing, strict=True):
        rotation, shift = cell_poses(piece_cells(piece, side), cells)[0]
        goals.append(
            make_transform(rotation, (shift + (0.0, 0.0, 0.5)) * side + (0.0, 0.0, whole.support.height))
        )
    digest = hashlib.sha256(f"{whole.digest} {packing} {side}".encode()).hexdigest()
    return replace(whole, goals=readonly(goals), digest=digest)


@cache
def _soma() -> Assembly:
    return load_assembly("cube")


@cache
def soma_cubes() -> tuple[Packing, ...]:
    """The 240 Soma cubes that differ by more than a rotation or a reflection, pieces in the order of
    meshes/soma/cube.toml."""
    return tuple(distinct_packings([piece_cells(piece) for piece in _soma().pieces]))


def soma_cube(number: int, turn: Array | None = None) -> Assembly:
    """One of the 240 as an assembly, turned by a rotation (3, 3) of the cube; all share their workpieces."""
    packing = soma_cubes()[number]
    packed = packed_assembly(_soma(), packing if turn is None else turned_packing(packing, turn))
    return replace(packed, name=f"cube{number:03d}")


def sides_down() -> list[Array]:
    """Rotations (3, 3) of the cube, one for each side that can be down; the first turns nothing."""
    found: dict[tuple[float, ...], Array] = {}
    for turn in sorted(cube_rotations(), key=lambda turn: -float(np.trace(turn))):
        found.setdefault(tuple(turn[2] + 0.0), turn)
    return list(found.values())


def draw_soma_cubes(count: int, seed: int) -> list[int]:
    """Numbers of `count` different ones of the 240, sorted."""
    return sorted(int(k) for k in np.random.default_rng(seed).choice(len(soma_cubes()), count, replace=False))
