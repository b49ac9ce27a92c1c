"""Writes meshes/soma: the seven pieces of the Soma cube (.obj, in mm) and the assemblies made of them
(.toml).

Every piece lies in its own frame with the centre of one of its cells at the origin: the cell that the others
hang on (the corner of V, L and P, the middle of T, an inner cell of Z, A and B). The goal poses follow from
the cells that a piece fills."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from soma_bullet.assembly.polycubes import Cell, cell_mesh, cell_poses
from soma_bullet.frames import Array

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


@dataclass(frozen=True)
class Scene:
    """An assembly: cells that each piece fills, by the piece's name in the file and its shape."""

    name: str
    about: str
    goals: tuple[tuple[str, str, tuple[Cell, ...]], ...]


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

HEADER = """\
# {about}
# Cells are cubes of {side} mm. A goal is the pose of the cell at the origin of the piece's mesh: position,
# and roll, pitch and yaw about the fixed axes x, y, z. Written by scripts/generate_meshes.py.

name = "{name}"
unit = "mm"  # of every length in this file, and of the meshes unless they say otherwise

[support]  # the table that the assembly stands on
height = 0.0
friction = 0.5

[defaults]  # of every piece; a piece may say otherwise
density = 700.0  # kg/m3, beech
friction = 0.5
clearance = 0.1  # by how much every face of the real piece stands back from its mesh
"""
PIECE = """
[[piece]]
name = "{name}"
mesh = "{shape}.obj"
color = "{color}"
goal = {{ position = [{position}], rpy_deg = [{rpy}] }}
"""


def plain_angles(rotation: Array) -> tuple[int, int, int]:
    """Roll, pitch, yaw [deg] about the fixed axes x, y, z: the multiples of 90 that turn least."""
    angles = ((r, p, y) for r in (0, 90, -90, 180) for p in (0, 90, -90, 180) for y in (0, 90, -90, 180))
    same = (
        a for a in angles if np.allclose(Rotation.from_euler("xyz", a, degrees=True).as_matrix(), rotation)
    )
    return min(same, key=lambda a: (sum(map(abs, a)), np.count_nonzero(a), tuple(-v for v in a)))


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


def scene_text(scene: Scene) -> str:
    """The assembly file of a scene. Of a symmetric piece's equivalent poses, the one that turns least."""
    text = HEADER.format(about=scene.about.replace("\n", "\n# "), side=SIDE, name=scene.name)
    for name, shape, cells in scene.goals:
        poses = [(plain_angles(rotation), shift) for rotation, shift in cell_poses(PIECES[shape], cells)]
        rpy, shift = min(poses, key=lambda pose: (sum(map(abs, pose[0])), tuple(-v for v in pose[0])))
        position = (shift + (0, 0, 0.5)) * SIDE  # cells z = 0 stand on the support at 0
        text += PIECE.format(
            name=name,
            shape=shape,
            color=COLORS[shape],
            position=", ".join(str(float(v) + 0.0) for v in position),
            rpy=", ".join(str(float(v)) for v in rpy),
        )
    return text


def main(folder: Path) -> None:
    """Write all pieces and scenes into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    for shape in PIECES:
        (folder / f"{shape}.obj").write_text(obj_text(shape))
    for scene in SCENES:
        (folder / f"{scene.name}.toml").write_text(scene_text(scene))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "folder", nargs="?", type=Path, default=Path(__file__).resolve().parents[1] / "meshes" / "soma"
    )
    main(parser.parse_args().folder)
