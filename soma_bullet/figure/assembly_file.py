"""Assembly files of Soma pieces (.toml), as those of meshes/soma, from the cells that each piece fills."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from soma_bullet.assembly.polycubes import Cell, cell_poses
from soma_bullet.figure.pieces import COLORS, PIECES, SIDE
from soma_bullet.frames import Array

HEADER = """\
# {about}
# Cells are cubes of {side} mm. A goal is the pose of the cell at the origin of the piece's mesh: position,
# and roll, pitch and yaw about the fixed axes x, y, z. Written by {author}.

name = {name}
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


@dataclass(frozen=True)
class Scene:
    """An assembly: cells that each piece fills, by the piece's name in the file and its shape."""

    name: str
    about: str
    goals: tuple[tuple[str, str, tuple[Cell, ...]], ...]


@cache
def _rotations() -> list[tuple[tuple[int, int, int], Array]]:
    """Roll, pitch and yaw [deg] in right angles, each with its rotation (3, 3); what turns least is first."""
    angles = sorted(
        product((0, 90, -90, 180), repeat=3),
        key=lambda a: (sum(map(abs, a)), np.count_nonzero(a), tuple(-v for v in a)),
    )
    return [(a, Rotation.from_euler("xyz", a, degrees=True).as_matrix()) for a in angles]  # type: ignore[misc]


def plain_angles(rotation: Array) -> tuple[int, int, int]:
    """Roll, pitch, yaw [deg] about the fixed axes x, y, z: the multiples of 90 that turn least."""
    return next(angles for angles, matrix in _rotations() if np.abs(matrix - rotation).max() < 1e-6)


def least_turned(shape: str, cells: tuple[Cell, ...]) -> tuple[tuple[int, int, int], Array]:
    """Roll, pitch and yaw [deg] and shift (3,) [cells] of a piece that fills some cells. Of a symmetric
    piece's equivalent poses, the one that turns least."""
    poses = [(plain_angles(rotation), shift) for rotation, shift in cell_poses(PIECES[shape], cells)]
    return min(poses, key=lambda pose: (sum(map(abs, pose[0])), tuple(-v for v in pose[0])))


def scene_text(scene: Scene, author: str) -> str:
    """The assembly file of a scene; `author` is what wrote it."""
    about = scene.about.replace("\n", "\n# ")
    name = '"' + scene.name.replace("\\", "\\\\").replace('"', '\\"') + '"'
    text = HEADER.format(about=about, side=SIDE, name=name, author=author)
    for piece, shape, cells in scene.goals:
        rpy, shift = least_turned(shape, cells)
        position = (shift + (0, 0, 0.5)) * SIDE  # cells z = 0 stand on the support at 0
        text += PIECE.format(
            name=piece,
            shape=shape,
            color=COLORS[shape],
            position=", ".join(str(float(v) + 0.0) for v in position),
            rpy=", ".join(str(float(v)) for v in rpy),
        )
    return text
