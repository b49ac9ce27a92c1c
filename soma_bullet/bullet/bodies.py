"""Workpieces as PyBullet bodies: exact mass and inertia, collision by convex parts of the real body, as few
as will do."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from soma_bullet.assembly.chamfer import chamfered, edge_cuts
from soma_bullet.assembly.hulls import Hull, box_hull
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.frames import Array

MARGIN = 1e-3  # [m] that PyBullet adds all around a convex mesh, whatever it is told
FILM = 1e-6  # [m]
SAME = 1e-5  # [1], [m] planes that differ by less are the same
DEEPER = 1.2  # of what is cut: how far chamfered boxes reach into each other at least
SEAM = 0.05  # of the smallest box's smallest side: how far boxes reach into each other


def write_piece_urdf(piece: Workpiece, folder: Path) -> Path:
    """A URDF of the real body. PyBullet caches files by name, so names carry a hash of their content."""
    moments, axes = np.linalg.eigh(piece.inertia)
    axes = axes * np.sign(np.linalg.det(axes))
    shapes = "\n".join(_collision(piece, part, folder) for part in collision_parts(piece))
    text = f"""<robot name="{piece.name}">
 <link name="{piece.name}">
  <inertial>
   <origin xyz="{_numbers(piece.center_of_mass)}" rpy="{_rpy(axes)}"/>
   <mass value="{float(piece.mass)!r}"/>
   <inertia ixx="{float(moments[0])!r}" iyy="{float(moments[1])!r}" izz="{float(moments[2])!r}"
    ixy="0" ixz="0" iyz="0"/>
  </inertial>
{shapes}
 </link>
</robot>
"""
    path = folder / f"piece_{hashlib.sha256(text.encode()).hexdigest()[:16]}.urdf"
    path.write_text(text, encoding="utf-8")
    return path


def collision_parts(piece: Workpiece) -> tuple[Hull, ...]:
    """Convex polytopes of the real body with its chamfer, few and overlapping little where it is made of
    boxes."""
    if piece.chamfer == 0.0:
        return sparing(piece.body_parts)
    boxes = piece.decomposition.inset(piece.clearance)
    cuts = edge_cuts(piece.decomposition, piece.clearance, piece.chamfer)
    found = (
        _cover(boxes, piece.chamfer + MARGIN)
        if piece.decomposition.kind == "boxes" and len(boxes) == len(cuts)
        else None
    )
    if found is None:
        return chamfered(piece.decomposition, piece.clearance, piece.chamfer)
    return tuple(part.cut(cuts[k]) for k, part in found)


def unpadded(piece: Workpiece, part: Hull) -> Hull:
    """The polytope that has, with Bullet's margin around it, the faces of a part; its edges are round by the
    margin.

    Faces that are cuts inside the piece stay, so that parts reach into each other there. A part thinner than
    twice the margin stays too thick."""
    solid = np.arange(len(part.normals))
    if piece.decomposition.kind == "cuts":
        cuts = [
            np.column_stack([p.normals, p.offsets])[np.setdiff1d(np.arange(len(p.normals)), faces)]
            for p, faces in zip(piece.decomposition.parts, piece.decomposition.solid_faces, strict=True)
        ]
        own = np.column_stack([part.normals, part.offsets])
        inner = np.abs(own[:, None] - np.vstack(cuts)[None]).max(axis=2, initial=0.0) < SAME
        solid = np.flatnonzero(~inner.any(axis=1))
    for margin in (MARGIN, MARGIN / 2, MARGIN / 4):
        try:
            return part.inset(margin, solid)
        except ValueError:
            continue
    return part


def sparing(parts: Sequence[Hull]) -> tuple[Hull, ...]:
    """Boxes with the union of the boxes `parts`, which overlap little; parts that are not all boxes as they
    are.

    Where boxes overlap a contact has points of each, which cost time and converge badly. So the largest box
    is taken whole, then of the box that adds most only what is new, with a seam: a face that ends where two
    boxes meet would else have its edge on another edge."""
    found = _cover(parts)
    return tuple(parts) if found is None else tuple(part for _, part in found)


def _cover(parts: Sequence[Hull], reach: float = 0.0) -> list[tuple[int, Hull]] | None:
    """Boxes within some of the boxes `parts` (which by index) that cover all of them; None where not all are
    boxes.

    Args:
        reach: boxes that meet reach into each other at least this far [m], also by a third one if they only
            meet face to face.
    """
    boxes = [part.box for part in parts if part.box is not None]
    if len(boxes) < max(2, len(parts)):
        return None
    axes = boxes[0][1]
    if not all(np.allclose(box_axes, axes, atol=1e-9) for _, box_axes, _ in boxes):
        return None
    film = FILM if reach else 0.0  # a slit between faces that meet, which a third box fills
    low = np.array([axes @ centre - half for centre, _, half in boxes]) + film
    high = np.array([axes @ centre + half for centre, _, half in boxes]) - film
    ticks = [np.unique(np.concatenate([low[:, k], high[:, k]]).round(9)) for k in range(3)]
    cell_low = np.stack(np.meshgrid(*[t[:-1] for t in ticks], indexing="ij"), axis=-1).reshape(-1, 3)
    cell_high = np.stack(np.meshgrid(*[t[1:] for t in ticks], indexing="ij"), axis=-1).reshape(-1, 3)
    middle, volumes = (cell_low + cell_high) / 2, np.prod(cell_high - cell_low, axis=1)
    inside = ((middle > low[:, None]) & (middle < high[:, None])).all(axis=2)
    seam, missing = max(SEAM * float((high - low).min()), DEEPER * reach), inside.any(axis=0)
    found = []
    while missing.any():
        gains = (inside & missing) @ volumes
        k = int(np.flatnonzero(gains > (1 - 1e-6) * gains.max())[0])  # of equal boxes always the first
        new = inside[k] & missing
        first = np.maximum(cell_low[new].min(axis=0) - seam, low[k])
        last = np.minimum(cell_high[new].max(axis=0) + seam, high[k])
        first, last = (
            np.where(first > low[k], first, first - film),
            np.where(last < high[k], last, last + film),
        )
        found.append((k, box_hull((first + last) / 2 @ axes, axes, (last - first) / 2)))
        missing &= ~new
    return found


def _collision(piece: Workpiece, part: Hull, folder: Path) -> str:
    if part.box is not None:
        centre, axes, half = part.box
        rotation = (axes * np.array([[1], [1], [np.sign(np.linalg.det(axes))]])).T
        origin = f'<origin xyz="{_numbers(centre)}" rpy="{_rpy(rotation)}"/>'
        return f'  <collision>{origin}<geometry><box size="{_numbers(2 * half)}"/></geometry></collision>'
    part = unpadded(piece, part)
    hull = ConvexHull(part.vertices)
    lines = [f"v {_numbers(v)}" for v in part.vertices]
    centre = part.vertices.mean(axis=0)
    for simplex in hull.simplices:
        a, b, c = part.vertices[simplex]
        outward = np.cross(b - a, c - a) @ (a - centre) > 0
        order = simplex if outward else simplex[::-1]
        lines.append("f " + " ".join(str(int(k) + 1) for k in order))
    text = "\n".join(lines) + "\n"
    mesh = folder / f"hull_{hashlib.sha256(text.encode()).hexdigest()[:16]}.obj"
    mesh.write_text(text, encoding="utf-8")
    return f'  <collision><geometry><mesh filename="{mesh}"/></geometry></collision>'


def _numbers(values: Array) -> str:
    return " ".join(repr(float(v)) for v in values)


def _rpy(rotation: Array) -> str:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # at a right pitch the angles are not unique; any of them will do
        return _numbers(Rotation.from_matrix(rotation).as_euler("xyz"))
