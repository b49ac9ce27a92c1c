"""What the renderer shows: lean, coloured copies of the robot's visual meshes, flat-shaded pieces, an arrow.

PyBullet's OpenGL renderer ignores the materials of a mesh file, so a mesh is split: one visual per material,
coloured as the material says. Its software OpenGL is bound by triangles, so each part is thinned by
clustering its vertices."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from soma_bullet.frames import Array

Faces = NDArray[np.int64]
Colour = tuple[float, float, float]

ARROW: Colour = (0.86, 0.11, 0.22)
NEUTRAL: Colour = (0.62, 0.66, 0.72)
# Distinct for the colour-blind as well, in the order in which pieces are listed.
PIECES: tuple[Colour, ...] = (
    (0.13, 0.45, 0.78), (0.93, 0.49, 0.13), (0.20, 0.62, 0.38), (0.80, 0.25, 0.28),
    (0.53, 0.38, 0.71), (0.95, 0.76, 0.20), (0.16, 0.65, 0.69), (0.85, 0.47, 0.65),
)  # fmt: skip

_CLUSTER = 0.0012  # [m] coarser tears the seams between materials; finer only costs time
_CREASE = np.deg2rad(35.0)  # sharper edges stay sharp
_VERSION = "1"  # of the thinning: part of the cache's key


def cache_folder() -> Path:
    """Where thinned meshes are kept between runs."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "soma_bullet" / "meshes"


def obj_text(corners: Array, normals: Array) -> str:
    """OBJ of triangles (n, 3, 3) [m] with a normal for each corner (n, 3, 3): nothing is shared, so nothing
    is smoothed."""
    count = 3 * len(corners)
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in corners.reshape(-1, 3).tolist()]
    lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in normals.reshape(-1, 3).tolist()]
    lines += [f"f {i}//{i} {i + 1}//{i + 1} {i + 2}//{i + 2}" for i in range(1, count, 3)]
    return "\n".join(lines) + "\n"


def flat_obj(vertices: Array, faces: Faces) -> str:
    """OBJ of a mesh, vertices (v, 3) [m] and faces (f, 3), with one normal a face."""
    corners = np.asarray(vertices, float)[np.asarray(faces)]
    return obj_text(corners, np.repeat(_face_normals(corners)[:, None], 3, axis=1))


def _face_normals(corners: Array) -> Array:
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


def arrow(length: float, radius: float, sections: int = 32) -> tuple[Array, Faces]:
    """Vertices and faces of an arrow from the origin along +z, `length` long [m]; the shaft has `radius`
    [m]."""
    head = min(4.0 * radius, 0.6 * length)
    profile = (
        (0.0, 0.0),
        (radius, 0.0),
        (radius, length - head),
        (2.4 * radius, length - head),
        (0.0, length),
    )
    angles = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    vertices = np.array([(r * np.cos(a), r * np.sin(a), z) for r, z in profile for a in angles])
    i, j = np.arange(sections), (np.arange(sections) + 1) % sections
    faces = [quad for ring in range(len(profile) - 1) for quad in (
        np.stack((ring * sections + i, ring * sections + j, (ring + 1) * sections + j), 1),
        np.stack((ring * sections + i, (ring + 1) * sections + j, (ring + 1) * sections + i), 1),
    )]  # fmt: skip
    return vertices, np.concatenate(faces)


_CUBE = np.array([(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_CUBE_FACES = np.array([(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
                        (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)])  # fmt: skip


# --- the robot's meshes -------------------------------------------------------------------------------------


def _read_obj(file: Path) -> tuple[Array, dict[str, Faces], dict[str, Colour]]:
    """Vertices, faces by material and the materials' diffuse colours of an OBJ file."""
    vertices: list[list[float]] = []
    groups: dict[str, list[tuple[int, int, int]]] = {}
    colours: dict[str, Colour] = {}
    current = groups.setdefault("", [])
    for line in file.read_text().splitlines():
        key, _, rest = line.partition(" ")
        if key == "v":
            vertices.append([float(x) for x in rest.split()[:3]])
        elif key == "f":
            corner = [int(token.split("/")[0]) for token in rest.split()]
            corner = [i - 1 if i > 0 else len(vertices) + i for i in corner]
            current += [(corner[0], corner[k], corner[k + 1]) for k in range(1, len(corner) - 1)]
        elif key == "usemtl":
            current = groups.setdefault(rest.strip(), [])
        elif key == "mtllib" and (file.parent / rest.strip()).is_file():
            colours |= _read_mtl(file.parent / rest.strip())
    return np.array(vertices), {k: np.array(v) for k, v in groups.items() if v}, colours


def _read_mtl(file: Path) -> dict[str, Colour]:
    colours: dict[str, Colour] = {}
    name = ""
    for line in file.read_text().splitlines():
        key, _, rest = line.strip().partition(" ")
        if key == "newmtl":
            name = rest.strip()
        elif key == "Kd":
            red, green, blue = (float(x) for x in rest.split()[:3])
            colours[name] = (red, green, blue)
    return colours


def thinned(vertices: Array, faces: Faces, cluster: float = _CLUSTER) -> Array:
    """The triangles (n, 3, 3) that remain when all vertices within one cell of a grid become their mean."""
    _, inverse = np.unique(np.round(vertices / cluster).astype(np.int64), axis=0, return_inverse=True)
    inverse = inverse.ravel()
    used = np.zeros(len(vertices), bool)
    used[faces.ravel()] = True  # vertices of the other materials must not pull
    counts = np.maximum(np.bincount(inverse, weights=used), 1)
    means = np.stack([np.bincount(inverse, weights=vertices[:, k] * used) / counts for k in range(3)], axis=1)
    new = inverse[faces]
    new = new[(new[:, 0] != new[:, 1]) & (new[:, 1] != new[:, 2]) & (new[:, 2] != new[:, 0])]
    _, first = np.unique(np.sort(new, axis=1), axis=0, return_index=True)
    return means[new[np.sort(first)]]


def _creased_normals(corners: Array) -> Array:
    """Normals (n, 3, 3): at each corner the mean over the faces around that vertex that are not across a
    crease."""
    faces = _face_normals(corners)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    _, vertex = np.unique(np.round(corners.reshape(-1, 3), 7), axis=0, return_inverse=True)
    vertex = vertex.ravel()
    order = np.argsort(vertex, kind="stable")
    starts = np.searchsorted(vertex[order], np.arange(vertex.max() + 2))
    normals = np.empty((len(vertex), 3))
    for begin, end in zip(starts[:-1], starts[1:], strict=True):
        corner = order[begin:end]
        around = faces[corner // 3]
        near = around @ around.T > np.cos(_CREASE)
        normals[corner] = near @ (around * areas[corner // 3, None]) + 1e-12 * around
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    return normals.reshape(-1, 3, 3)


def split_mesh(file: Path, cache: Path | None = None) -> list[tuple[Path, Colour | None]]:
    """Thinned parts of an OBJ mesh, one per material, with the material's colour; kept in `cache` by content.

    A mesh without materials is one part without a colour.
    """
    cache = cache or cache_folder()
    vertices, groups, colours = _read_obj(file)
    key = hashlib.sha256(f"{_VERSION} {_CLUSTER} {_CREASE}".encode() + file.read_bytes()).hexdigest()[:24]
    parts = []
    for number, (material, faces) in enumerate(groups.items()):
        part = cache / f"{file.stem}_{key}_{number}.obj"
        if not part.is_file():
            corners = thinned(vertices, faces) if len(faces) > 500 else vertices[faces]
            part.parent.mkdir(parents=True, exist_ok=True)
            partial = part.with_suffix(f".{os.getpid()}")
            partial.write_text(obj_text(corners, _creased_normals(corners)))
            partial.replace(part)  # other processes must never see half a file
        parts.append((part, colours.get(material)))
    return parts


def lean_urdf(urdf: Path, path_out: Path, cache: Path | None = None) -> Path:
    """Writes a copy of a URDF to look at: thinned coloured visuals, no collision geometry. Mesh paths must be
    absolute."""
    from lxml import etree

    tree = etree.parse(str(urdf), etree.XMLParser(remove_blank_text=True))
    for link in tree.getroot().iter("link"):
        for collision in link.findall("collision"):
            link.remove(collision)
        for number, visual in enumerate(link.findall("visual")):
            box = visual.find("geometry/box")
            if box is not None:  # PyBullet shades its own boxes as if they were round
                half = np.array([float(x) for x in box.get("size").split()]) / 2
                part = path_out.with_name(f"{path_out.stem}_box_{link.get('name')}_{number}.obj")
                part.write_text(flat_obj(half * _CUBE, _CUBE_FACES))
                box.getparent().replace(box, etree.Element("mesh", filename=str(part)))
            mesh = visual.find("geometry/mesh")
            if box is not None or mesh is None or not mesh.get("filename", "").endswith(".obj"):
                continue
            at = link.index(visual)
            link.remove(visual)
            for k, (part, rgb) in enumerate(split_mesh(Path(mesh.get("filename")), cache)):
                new = etree.fromstring(etree.tostring(visual))
                new.find("geometry/mesh").set("filename", str(part))
                if rgb is not None:
                    for material in new.findall("material"):
                        new.remove(material)
                    material = etree.SubElement(new, "material", name=part.stem)
                    etree.SubElement(material, "color", rgba=" ".join(f"{c:.4g}" for c in (*rgb, 1.0)))
                link.insert(at + k, new)
    path_out.write_bytes(etree.tostring(tree, xml_declaration=True, encoding="utf-8", pretty_print=True))
    return path_out
