"""Workpieces as PyBullet bodies: exact mass and inertia, collision by their convex parts inset by the clearance."""

from __future__ import annotations

import hashlib
import warnings
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from soma_bullet.assembly.hulls import Hull
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.frames import Array


def write_piece_urdf(piece: Workpiece, folder: Path) -> Path:
    """A URDF of the real body. PyBullet caches files by name, so names carry a hash of their content."""
    moments, axes = np.linalg.eigh(piece.inertia)
    axes = axes * np.sign(np.linalg.det(axes))
    shapes = "\n".join(_collision(part, folder) for part in piece.body_parts)
    text = f"""<robot name="{piece.name}">
 <link name="{piece.name}">
  <inertial>
   <origin xyz="{_numbers(piece.center_of_mass)}" rpy="{_rpy(axes)}"/>
   <mass value="{float(piece.mass)!r}"/>
   <inertia ixx="{float(moments[0])!r}" iyy="{float(moments[1])!r}" izz="{float(moments[2])!r}" ixy="0" ixz="0" iyz="0"/>
  </inertial>
{shapes}
 </link>
</robot>
"""
    path = folder / f"piece_{hashlib.sha256(text.encode()).hexdigest()[:16]}.urdf"
    path.write_text(text, encoding="utf-8")
    return path


def _collision(part: Hull, folder: Path) -> str:
    if part.box is not None:
        centre, axes, half = part.box
        rotation = (axes * np.array([[1], [1], [np.sign(np.linalg.det(axes))]])).T
        origin = f'<origin xyz="{_numbers(centre)}" rpy="{_rpy(rotation)}"/>'
        return f'  <collision>{origin}<geometry><box size="{_numbers(2 * half)}"/></geometry></collision>'
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
