"""Small bodies and assemblies to test with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import manifold3d
import numpy as np
import trimesh

from soma_bullet.assembly.model import Assembly, Support
from soma_bullet.assembly.polycubes import Cell, cell_mesh
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.frames import Array, make_transform, readonly

SIDE = 0.0185  # [m] of a cell


def box(size: Sequence[float], name: str = "box", **options: float) -> Workpiece:
    """A box about its origin, size (3,) [m]."""
    mesh = trimesh.creation.box(size)
    return Workpiece(name, readonly(mesh.vertices), readonly(mesh.faces, int), **options)


def cells(body: Sequence[Cell], name: str = "cells", side: float = SIDE) -> Workpiece:
    """A body made of cells."""
    vertices, faces = cell_mesh(body, side)
    return Workpiece(name, readonly(vertices), readonly(faces, int))


def solid(body: manifold3d.Manifold, name: str = "solid", **options: float) -> Workpiece:
    """A body of manifold3d, in mm."""
    raw = body.to_mesh64()
    return Workpiece(
        name, readonly(raw.vert_properties[:, :3] / 1e3), readonly(raw.tri_verts, int), **options
    )


def cup(radius: float, sections: int = 24) -> trimesh.Trimesh:
    """Half a hollow sphere, open upwards: curved inwards in two directions."""
    shell = manifold3d.Manifold.sphere(radius, sections) - manifold3d.Manifold.sphere(0.8 * radius, sections)
    raw = (
        shell - manifold3d.Manifold.cube([5 * radius] * 3, True).translate([0, 0, 2.5 * radius])
    ).to_mesh64()
    return trimesh.Trimesh(raw.vert_properties[:, :3], raw.tri_verts, process=False)


def assembly(
    pieces: Sequence[Workpiece], places: Sequence[Sequence[float]], height: float = 0.0, friction: float = 0.5
) -> Assembly:
    """Pieces with their origins at `places` (n, 3) [m], unturned."""
    goals = readonly([make_transform(None, place) for place in places])
    return Assembly("test", tuple(pieces), goals, Support(height, friction))


def moved(whole: Assembly, motion: Array) -> Assembly:
    """The assembly after a motion (4, 4) that keeps z upright; the support's height follows."""
    support = replace(whole.support, height=whole.support.height + motion[2, 3])
    return replace(whole, goals=readonly(motion @ whole.goals), support=support)


def refined(whole: Assembly, seed: int) -> Assembly:
    """The same bodies with some of their triangles split."""
    rng = np.random.default_rng(seed)
    pieces = []
    for piece in whole.pieces:
        chosen = np.flatnonzero(rng.random(len(piece.faces)) < 0.6)
        vertices, faces = trimesh.remesh.subdivide(piece.vertices, piece.faces, face_index=chosen)
        pieces.append(replace(piece, vertices=readonly(vertices), faces=readonly(faces, int)))
    return replace(whole, pieces=tuple(pieces))


def scaled(whole: Assembly, factor: float) -> Assembly:
    """Everything larger by a factor."""
    pieces = tuple(
        replace(p, vertices=readonly(p.vertices * factor), clearance=p.clearance * factor)
        for p in whole.pieces
    )
    goals = np.array(whole.goals)
    goals[:, :3, 3] *= factor
    support = replace(whole.support, height=whole.support.height * factor)
    return replace(whole, pieces=pieces, goals=readonly(goals), support=support)


def write_two_blocks(folder: Path) -> str:
    """The file of two blocks, one on the other."""
    trimesh.creation.box((0.03, 0.03, 0.03)).export(folder / "block.stl")
    piece = (
        '[[piece]]\nname = "{}"\nmesh = "block.stl"\ngoal = '
        "{{ position = [0, 0, {}], rpy_deg = [0, 0, 0] }}\n"
    )
    head = (
        'name = "two"\nunit = "m"\n[support]\nheight = 0.0\nfriction = 0.5\n[defaults]\ndensity = 700.0\n'
        "friction = 0.5\n"
    )
    (folder / "two.toml").write_text(head + piece.format("lower", 0.015) + piece.format("upper", 0.045))
    return str(folder / "two.toml")
