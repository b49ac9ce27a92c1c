"""Bodies made of equal cubes: their surface as a mesh, and the rotations that map one onto another."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import permutations, product

import numpy as np

from soma_bullet.frames import Array

Cell = tuple[int, int, int]


def cell_mesh(cells: Iterable[Cell], side: float) -> tuple[Array, Array]:
    """The surface of a union of cells: vertices (v, 3) in the unit of `side`, outward triangles (f, 3).

    A cell (i, j, k) is the cube of that side about (i, j, k) * side. Faces that two cells share are left out
    and corners are merged, so the mesh is a closed manifold for every body whose cells hang together by
    faces."""
    filled = set(cells)
    index: dict[Cell, int] = {}
    faces = []
    for cell in sorted(filled):
        for axis, sign in product(range(3), (-1, 1)):
            neighbour = [c + sign * (k == axis) for k, c in enumerate(cell)]
            if (neighbour[0], neighbour[1], neighbour[2]) in filled:
                continue
            # (axis, right, up) is a right-handed frame, so this loop is outward where the face looks along
            # +axis
            right, up = (axis + 1) % 3, (axis + 2) % 3
            corners = []
            for along_right, along_up in ((-1, -1), (1, -1), (1, 1), (-1, 1))[::sign]:
                corner = [2 * c for c in cell]  # in half cells, so that corners are whole numbers
                corner[axis] += sign
                corner[right] += along_right
                corner[up] += along_up
                corners.append(index.setdefault((corner[0], corner[1], corner[2]), len(index)))
            faces += [[corners[0], corners[1], corners[2]], [corners[0], corners[2], corners[3]]]
    return np.array(list(index), float) * side / 2, np.array(faces, int)


def cube_rotations() -> list[Array]:
    """The 24 rotation matrices (3, 3) that map the axes onto themselves, entries exactly -1, 0, 1."""
    rotations = []
    for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
        matrix = np.zeros((3, 3))
        matrix[range(3), order] = signs
        if np.linalg.det(matrix) > 0:
            rotations.append(matrix)
    return rotations


def cell_poses(cells: Iterable[Cell], target: Iterable[Cell]) -> list[tuple[Array, Array]]:
    """All (rotation (3, 3), shift (3,) [cells]) that move `cells` onto `target`; empty where the two differ
    in shape."""
    source, goal = np.array(sorted(cells), float), np.array(sorted(target), float)
    found = []
    for rotation in cube_rotations():
        turned = source @ rotation.T
        shift = goal.min(axis=0) - turned.min(axis=0)
        if len(source) == len(goal) and {tuple(c) for c in turned + shift} == {tuple(c) for c in goal}:
            found.append((rotation, shift))
    return found
