"""Writes meshes/soma: the seven pieces of the Soma cube (.obj, in mm) and the assemblies made of them
(.toml). The goal poses follow from the cells that a piece fills."""

from __future__ import annotations

import argparse
from pathlib import Path

from soma_bullet.assembly.polycubes import Cell
from soma_bullet.figure.assembly_file import Scene, scene_text
from soma_bullet.figure.pieces import PIECES, obj_text

AUTHOR = "scripts/generate_meshes.py"


def digits(cells: str) -> tuple[Cell, ...]:
    """Cells written as digits x y z: "000 001"."""
    return tuple((int(c[0]), int(c[1]), int(c[2])) for c in cells.split())


def wall(cells: tuple[tuple[int, int], ...]) -> tuple[Cell, ...]:
    """Cells (y, z) of a wall in the plane x = 0, lifted so that the lowest stand at z = 0."""
    return tuple((0, y, z + 1) for y, z in cells)


SCENES = (
    Scene(
        "soma3",
        "Three pieces, a wall one cell thick that stands on a single cell:\n"
        "      S S\n      B S\n  B B B Z      B BigL, S smallL, Z; y to the right, z up\n      Z Z\n      Z",
        (
            ("BigL", "L", wall(((-3, 1), (-2, 1), (-1, 1), (-1, 2)))),
            ("smallL", "V", wall(((-1, 3), (0, 3), (0, 2)))),
            ("Z", "Z", wall(((-1, -1), (-1, 0), (0, 0), (0, 1)))),
        ),
    ),
    Scene(
        "soma4",
        "Four pieces in three layers.",
        (
            ("V", "V", digits("100 110 210")),
            ("Z", "Z", digits("011 021 101 111")),
            ("L", "L", digits("001 002 102 202")),
            ("A", "A", digits("112 121 122 212")),
        ),
    ),
    Scene(
        "cube",
        "The Soma cube: seven pieces, 3 x 3 x 3 cells.",
        (
            ("V", "V", digits("000 001 011")),
            ("L", "L", digits("002 012 021 022")),
            ("T", "T", digits("020 120 121 220")),
            ("Z", "Z", digits("010 100 110 200")),
            ("A", "A", digits("101 111 210 211")),
            ("B", "B", digits("102 112 201 202")),
            ("P", "P", digits("122 212 221 222")),
        ),
    ),
)


def main(folder: Path) -> None:
    """Write all pieces and scenes into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    for shape in PIECES:
        (folder / f"{shape}.obj").write_text(obj_text(shape))
    for scene in SCENES:
        (folder / f"{scene.name}.toml").write_text(scene_text(scene, AUTHOR))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "folder", nargs="?", type=Path, default=Path(__file__).resolve().parents[1] / "meshes" / "soma"
    )
    main(parser.parse_args().folder)
