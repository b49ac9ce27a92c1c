"""Mesh files: read, merged, scaled, and refused unless they bound one solid."""

from __future__ import annotations

import difflib
import hashlib
from pathlib import Path

import numpy as np
import trimesh

from soma_bullet.assembly.entries import Faults
from soma_bullet.frames import Array, readonly


def read_mesh(folder: Path, name: str, scale: float, where: str) -> tuple[Array, Array, str]:
    """Vertices (v, 3) [m], outward triangles (f, 3) and the hash of the bytes of a mesh file (obj, stl, ply,
    glb).

    Args:
        folder: what `name` is relative to.
        name: path of the mesh.
        scale: the mesh's unit [m].
        where: what to call the mesh in faults.

    Raises:
        Faults: no such file, unreadable, or not the surface of one solid.
    """
    path = folder / name
    if not path.is_file():
        near = difflib.get_close_matches(path.name, [file.name for file in path.parent.glob("*.*")], 1)
        hint = "".join(f"; did you mean {word!r}?" for word in near)
        raise Faults(f"{where}: mesh {name!r} is no file; tried {path.absolute()}{hint}")
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except Exception as error:  # trimesh's readers raise whatever they stumble over
        raise Faults(f"{where}: mesh {name!r} cannot be read: {type(error).__name__}: {error}") from error
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        raise Faults(f"{where}: mesh {name!r} has no triangles")
    if not np.isfinite(mesh.vertices).all():
        count = int((~np.isfinite(mesh.vertices)).any(axis=1).sum())
        raise Faults(f"{where}: mesh {name!r} has {count} corners that are not finite")
    # formats that store a normal or a texture coordinate by corner split the vertices that close the surface
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    faces = np.asarray(mesh.faces)
    mesh.update_faces((faces != np.roll(faces, 1, axis=1)).all(axis=1))
    mesh.remove_unreferenced_vertices()
    fault = _solid_fault(mesh)
    if fault:
        raise Faults(f"{where}: mesh {name!r} {fault}")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return readonly(mesh.vertices * scale), readonly(mesh.faces, int), digest


def _solid_fault(mesh: trimesh.Trimesh) -> str:
    """Why the mesh is not the outward surface of one solid; empty if it is."""
    _, count = np.unique(np.sort(mesh.edges, axis=1), axis=0, return_counts=True)
    if (count != 2).any():
        open_edges, crowded = int((count == 1).sum()), int((count > 2).sum())
        return (
            f"is not watertight: of {len(count)} edges {open_edges} are open, {crowded} have more than two "
            f"triangles"
        )
    if not mesh.is_winding_consistent:
        return "has triangles wound both ways; all must be counter-clockwise seen from outside"
    if mesh.body_count > 1:
        return f"has {mesh.body_count} separate bodies (or a cavity); a piece is one solid"
    if mesh.volume <= 0:
        return (
            f"is inside out: its volume is {mesh.volume:g}; triangles must be counter-clockwise seen from "
            f"outside"
        )
    return ""
