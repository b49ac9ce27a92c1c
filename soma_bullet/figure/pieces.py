"""The seven Soma pieces: cells, colours and meshes.

Every piece lies in its own frame with the centre of one of its cells at the origin: the cell that the others
hang on (the corner of V, L and P, the middle of T, an inner cell of Z, A and B)."""

from __future__ import annotations

from soma_bullet.assembly.polycubes import Cell, cell_mesh, cube_rotations

Cells = tuple[Cell, ...]  # sorted, unless said otherwise
Turn = tuple[Cell, Cell, Cell]  # rows of a rotation matrix of whole numbers
SIDE = 18.5  # [mm] of one cell

PIECES: dict[str, tuple[Cell, ...]] = {
    "V": ((0, 0, 0), (1, 0, 0), (0, 1, 0)),
    "L": ((0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 1, 0)),
    "T": ((0, 0, 0), (1, 0, 0), (-1, 0, 0), (0, 1, 0)),
    "Z": ((0, 0, 0), (-1, 0, 0), (0, 1, 0), (1, 1, 0)),
    "A": ((0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 0, 1)),
    "B": ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 1, 1)),
    "P": ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)),
}
COLORS = {
    "V": "#e88fae",
    "L": "#3a76c4",
    "T": "#5aa469",
    "Z": "#f2c14e",
    "A": "#e07a3f",
    "B": "#2f9c95",
    "P": "#8d6ab8",
}
TURNS: tuple[Turn, ...] = tuple(
    (
        (int(a[0]), int(a[1]), int(a[2])),
        (int(b[0]), int(b[1]), int(b[2])),
        (int(c[0]), int(c[1]), int(c[2])),
    )
    for a, b, c in cube_rotations()
)


def obj_text(shape: str) -> str:
    """The piece as Wavefront OBJ."""
    vertices, faces = cell_mesh(PIECES[shape], SIDE)
    lines = [
        f"# Soma piece {shape}, cells of {SIDE} mm, unit mm; the origin is the centre of a cell",
        f"o {shape}",
    ]
    lines += ["v " + " ".join(f"{value:g}" for value in vertex) for vertex in vertices]
    lines += ["f " + " ".join(str(corner + 1) for corner in face) for face in faces]
    return "\n".join(lines) + "\n"


def turned(cells: Cells, turn: Turn) -> Cells:
    """The cells after a rotation about the origin, each at its place in the sequence."""
    (a, b, c), (d, e, f), (g, h, i) = turn
    return tuple((a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z) for x, y, z in cells)


def lowest_corner(cells: Cells) -> Cell:
    """The smallest x, y and z of some cells."""
    return min(x for x, _, _ in cells), min(y for _, y, _ in cells), min(z for _, _, z in cells)


def at_origin(cells: Cells) -> Cells:
    """The same shape with its lowest corner at the origin, sorted."""
    i, j, k = lowest_corner(cells)
    return tuple(sorted((x - i, y - j, z - k) for x, y, z in cells))


def orientations(cells: Cells) -> tuple[Cells, ...]:
    """Every different way to turn a shape, at the origin, sorted."""
    return tuple(sorted({at_origin(turned(cells, turn)) for turn in TURNS}))


# every way to turn a piece -> its letter
SHAPES: dict[Cells, str] = {cells: letter for letter in PIECES for cells in orientations(PIECES[letter])}


def shape_of(cells: Cells) -> str | None:
    """The letter of the piece that some cells form, turned but not mirrored; None where they form none."""
    return SHAPES.get(at_origin(cells)) if cells else None
