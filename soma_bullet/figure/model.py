"""A packing as an assembly: the pieces of the Soma cube, at the goals that their cells give."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.figure.assembly_file import Scene, least_turned, scene_text
from soma_bullet.figure.packing import Packing, layers_text
from soma_bullet.figure.pieces import SIDE, obj_text
from soma_bullet.frames import make_transform, readonly
from soma_bullet.records import write_text

AUTHOR = "soma-figure"
MM = 1e-3  # [m]


def piece_names(packing: Packing) -> tuple[str, ...]:
    """A name for every piece: its letter, and a number where there are several of it."""
    seen: dict[str, int] = {}
    names = []
    for letter, _ in packing:
        seen[letter] = seen.get(letter, 0) + 1
        names.append(letter if seen[letter] == 1 else f"{letter}{seen[letter]}")
    return tuple(names)


def packed(name: str, packing: Packing) -> Assembly:
    """The assembly of a packing whose lowest cells stand on the table."""
    goals = []
    for letter, cells in packing:
        rpy, shift = least_turned(letter, cells)
        rotation = np.rint(Rotation.from_euler("xyz", rpy, degrees=True).as_matrix())
        goals.append(make_transform(rotation, (shift + (0.0, 0.0, 0.5)) * SIDE * MM))
    pieces = tuple(
        replace(workpiece(letter), name=called)
        for (letter, _), called in zip(packing, piece_names(packing), strict=True)
    )
    support = load_soma().support
    digest = hashlib.sha256(f"{load_soma().digest} {name} {packing}".encode()).hexdigest()
    return Assembly(name, pieces, readonly(goals), support, digest)


@cache
def load_soma() -> Assembly:
    """The Soma cube, whose pieces these are."""
    return load_assembly("cube")


def workpiece(letter: str) -> Workpiece:
    """The Soma piece of a letter."""
    return load_soma().pieces[load_soma().index(letter)]


def write_assembly(name: str, packing: Packing, about: str, folder: Path) -> Path:
    """Write the assembly file of a packing and the meshes of its pieces; returns the path of the file."""
    for letter in sorted({letter for letter, _ in packing}):
        write_text(obj_text(letter), folder / f"{letter}.obj")
    goals = tuple(
        (called, letter, cells) for (letter, cells), called in zip(packing, piece_names(packing), strict=True)
    )
    told = f"{about}\nIts packing, layer by layer from the bottom up:\n{layers_text(packing).rstrip()}"
    text = scene_text(Scene(name, told, goals), AUTHOR)
    path = folder / f"{name}.toml"
    write_text("\n".join(line.rstrip() for line in text.split("\n")), path)
    return path
