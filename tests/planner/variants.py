"""Assemblies made from a seed, and the same ones elsewhere, with other names, triangles and units."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import manifold3d
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import Array, make_transform, readonly, rotation_about
from soma_bullet.validation.subassemblies import assembly_of, random_placements
from tests.blocks import assembly, box, moved, solid

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}  # [m]

# --- assemblies ---------------------------------------------------------------------------------------------


def soma(seed: int) -> Assembly:
    """Two or three different Soma pieces on a grid of cells."""
    draws = (random_placements(seed, draw) for draw in range(100))
    return assembly_of(next(p for p in draws if len(p) <= 3), 1e-4)


def boxes(seed: int) -> Assembly:
    """Two boxes side by side, one or two on top, and everything turned, so that no face looks along an axis
    of the frame."""
    rng = np.random.default_rng(seed)
    height, depth = rng.uniform(0.01, 0.04), rng.uniform(0.015, 0.03)
    left, right = rng.uniform(0.015, 0.04, 2)
    shift = rng.uniform(-0.4, 0.4) * depth
    found = [
        ((left, depth, height), (-left / 2, 0, height / 2)),
        ((right, depth, height), (right / 2, shift, height / 2)),
    ]
    below, under = np.zeros(2), np.array((left + right, depth))  # middle and size of what carries the next
    for _ in range(rng.integers(1, 3)):
        size = rng.uniform(0.015, 0.03, 3)
        place = below + rng.uniform(-0.3, 0.3, 2) * under
        found.append((tuple(size), (*place, height + size[2] / 2)))
        height += size[2]
        below, under = place, size[:2]
    whole = assembly(
        [box(size, f"box{k}") for k, (size, _) in enumerate(found)], [place for _, place in found]
    )
    return moved(whole, make_transform(rotation_about((0, 0, 1), rng.uniform(-3, 3))))


def dowel(seed: int) -> Assembly:
    """A dowel in a blind hole of a block, and a plate on the higher of the two."""
    rng = np.random.default_rng(seed)
    radius, sections = rng.uniform(4.0, 8.0), int(rng.choice([16, 24, 32]))
    bottom, size = rng.uniform(4.0, 10.0), rng.uniform(24.0, 40.0, 2)
    top, length = bottom + rng.uniform(8.0, 15.0), rng.uniform(18.0, 30.0)
    x, y = rng.uniform(-2.0, 2.0, 2)
    hole = manifold3d.Manifold.cylinder(top, radius, radius, sections).translate([x, y, bottom])
    block = manifold3d.Manifold.cube([*size, top], True).translate([0, 0, top / 2]) - hole
    pin = manifold3d.Manifold.cylinder(length, radius, radius, sections)
    plate = box((0.03, 0.02, 0.01), "plate")
    places = [
        (0, 0, 0),
        (x / 1e3, y / 1e3, bottom / 1e3),
        (x / 1e3, y / 1e3, max(top, bottom + length) / 1e3 + 0.005),
    ]
    return assembly([solid(block, "block"), solid(pin, "dowel"), plate], places)


KINDS: dict[str, Callable[[int], Assembly]] = {"soma": soma, "boxes": boxes, "dowel": dowel}

# --- variants of an assembly --------------------------------------------------------------------------------


def yawed(whole: Assembly, angle: float) -> tuple[Assembly, Array]:
    """Everything turned about a vertical axis far from the origin."""
    motion = make_transform(rotation_about((0, 0, 1), angle), (0.3, -0.2, 0.0))
    return moved(whole, motion), motion


def shuffled(whole: Assembly, order: Sequence[int]) -> tuple[Assembly, list[int]]:
    """The pieces in another order with other names, and the new index of each."""
    pieces = tuple(replace(whole.pieces[k], name=f"{chr(ord('z') - k)}{k}") for k in order)
    return replace(whole, pieces=pieces, goals=readonly(whole.goals[list(order)])), [
        list(order).index(k) for k in range(len(order))
    ]


def remeshed(whole: Assembly, seed: int) -> Assembly:
    """The same bodies: every triangle in four or not, vertices and triangles in another order."""
    rng = np.random.default_rng(seed)
    pieces = []
    for piece in whole.pieces:
        vertices, faces = piece.vertices, piece.faces
        if rng.random() < 0.7:
            vertices, faces = trimesh.remesh.subdivide(vertices, faces)
        names = rng.permutation(len(vertices))
        faces = names[np.array(faces)][rng.permutation(len(faces))]
        faces = faces[
            np.arange(len(faces))[:, None], (rng.integers(3, size=len(faces))[:, None] + np.arange(3)) % 3
        ]
        pieces.append(
            replace(piece, vertices=readonly(vertices[np.argsort(names)]), faces=readonly(faces, int))
        )
    return replace(whole, pieces=tuple(pieces))


def through_a_file(whole: Assembly, folder: Path, unit: str, size: float) -> Assembly:
    """Written in another unit, and loaded."""
    lines = [f'name = "test"\nunit = "{unit}"\n[support]\nheight = {float(whole.support.height / size)!r}']
    for piece, goal in zip(whole.pieces, whole.goals, strict=True):
        mesh = trimesh.Trimesh(piece.vertices / size, piece.faces, process=False)
        (folder / f"{piece.name}.obj").write_text(
            trimesh.exchange.obj.export_obj(mesh, include_normals=False, digits=15)
        )
        quaternion = Rotation.from_matrix(goal[:3, :3]).as_quat(scalar_first=True).tolist()
        lines += [
            f'[[piece]]\nname = "{piece.name}"\nmesh = "{piece.name}.obj"\nclearance = '
            f"{float(piece.clearance / size)!r}"
        ]
        lines += [f"goal = {{ position = {(goal[:3, 3] / size).tolist()}, quat_wxyz = {quaternion} }}"]
    (folder / "test.toml").write_text("\n".join(lines))
    return load_assembly(folder / "test.toml")
