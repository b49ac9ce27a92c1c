"""Writes the slim parallel hand of `robots/ur5e_pair`: hand.urdf and the meshes that it shows.

One set of dimensions feeds the collision boxes, the inertias and the chamfered visual meshes, so they cannot
drift apart."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import trimesh

# Frame of the flange: z out of the flange, x the closing axis. All in m and kg.
PALM = np.array((0.060, 0.040, 0.070))
FINGER = np.array((0.008, 0.014, 0.080))
PAD = 0.014  # side of the square pad at the finger's end
RECESS = 0.0025  # of the finger behind the pad: only the pads touch what the hand grips
PAD_DEPTH = 0.0015
TRAVEL = 0.0425  # of one finger
TCP_Z = PALM[2] + FINGER[2] - PAD / 2
PALM_MASS, FINGER_MASS = 0.6, 0.05
EFFORT, VELOCITY = 100.0, 0.2  # [N], [m/s]
COLOURS = {
    "shell": (0.90, 0.91, 0.92),
    "dark": (0.20, 0.21, 0.23),
    "metal": (0.66, 0.68, 0.71),
    "accent": (0.16, 0.47, 0.72),
    "rubber": (0.13, 0.13, 0.14),
}


def convex(points: np.ndarray) -> trimesh.Trimesh:
    """Their convex hull."""
    import trimesh  # takes most of a second, which --help need not

    return trimesh.convex.convex_hull(points)


def chamfered(low: tuple[float, ...], high: tuple[float, ...], chamfer: float) -> trimesh.Trimesh:
    """A box from corner to corner [m] with all twelve edges bevelled."""
    low_, high_ = np.array(low), np.array(high)
    points = []
    for signs in np.ndindex(2, 2, 2):
        corner = np.where(np.array(signs) == 1, high_, low_)
        inward = np.where(np.array(signs) == 1, -chamfer, chamfer)
        points += [corner + np.where(np.arange(3) == axis, 0.0, inward) for axis in range(3)]
    return convex(np.array(points))


def band(x: float, y: float, chamfer: float, low: float, high: float) -> trimesh.Trimesh:
    """An upright slab of half sizes x and y [m] with its four upright edges bevelled."""
    outline = [
        (sx * a, sy * b) for sx in (-1, 1) for sy in (-1, 1) for a, b in ((x - chamfer, y), (x, y - chamfer))
    ]
    return convex(np.array([(*corner, z) for corner in outline for z in (low, high)]))


def turned(profile: list[tuple[float, float]], sections: int = 48) -> trimesh.Trimesh:
    """The convex solid of revolution about z through (radius, z) points [m]."""
    angles = np.linspace(0, 2 * np.pi, sections, endpoint=False)
    points = [(r * np.cos(a), r * np.sin(a), z) for r, z in profile for a in angles]
    return convex(np.array(points))


def meshes() -> dict[str, trimesh.Trimesh]:
    """Visual meshes by file name, in the frame of the link that shows them (fingers: at the pad's centre)."""
    import trimesh

    px, py, pz = PALM / 2 * (1, 1, 2)
    parts = {
        "coupling": turned([(0.0195, 0.0), (0.0195, 0.009), (0.0185, 0.010)]),
        "collar": turned([(0.0180, 0.008), (0.0180, 0.016)]),
        "palm": chamfered((-px, -py, 0.014), (px, py, 0.058), 0.003),
        "stripe": band(px + 1.5e-4, py + 1.5e-4, 0.003, 0.0485, 0.0525),
        "rail": chamfered((-px + 0.0015, -py + 0.003, 0.056), (px - 0.0015, py - 0.003, pz), 0.0015),
    }
    tall = FINGER[1] / 2
    foot = -TCP_Z + PALM[2]  # z of the finger's foot, seen from the pad's centre
    for side, sign in (("left", 1.0), ("right", -1.0)):

        def mirrored(
            low: tuple[float, ...], high: tuple[float, ...], chamfer: float, s: float = sign
        ) -> trimesh.Trimesh:
            x = sorted((s * low[0], s * high[0]))
            return chamfered((x[0], *low[1:]), (x[1], *high[1:]), chamfer)

        body = [
            mirrored((RECESS, -tall, foot), (FINGER[0], tall, PAD / 2), 0.001),
        ]
        parts[f"finger_{side}"] = trimesh.util.concatenate(body)
        parts[f"pad_{side}"] = mirrored(
            (0.0, -PAD / 2, -PAD / 2), (RECESS + PAD_DEPTH, PAD / 2, PAD / 2), 0.0004
        )
        # The two carriages pass each other side by side: left keeps to +y, right to -y.
        rod = chamfered((-0.020, 0.001, foot - 0.0085), (FINGER[0], tall, foot), 0.0008)
        parts[f"carriage_{side}"] = rod if sign > 0 else rod.apply_transform(np.diag((-1.0, -1.0, 1.0, 1.0)))
    return parts


def obj_text(mesh: trimesh.Trimesh) -> str:
    """OBJ with one normal a face: PyBullet would smooth over shared vertices."""
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in mesh.triangles.reshape(-1, 3) + 0.0]
    lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in np.round(mesh.face_normals, 4) + 0.0]
    lines += [
        f"f {3 * i + 1}//{i + 1} {3 * i + 2}//{i + 1} {3 * i + 3}//{i + 1}" for i in range(len(mesh.faces))
    ]
    return "\n".join(lines).replace("-0.000000", "0.000000") + "\n"


def inertial(mass: float, size: np.ndarray, centre: tuple[float, ...]) -> str:
    """The inertial element of a solid box."""
    x, y, z = size**2 * mass / 12
    return (
        f'    <inertial>\n      <origin xyz="{xyz(centre)}"/>\n      <mass value="{mass:g}"/>\n'
        f'      <inertia ixx="{y + z:.4e}" ixy="0" ixz="0" iyy="{x + z:.4e}" iyz="0" izz="{x + y:.4e}"/>\n '
        f"   </inertial>\n"
    )


def xyz(vector: tuple[float, ...] | np.ndarray) -> str:
    return " ".join(f"{float(v) + 0.0:.6g}" for v in vector)


def link(
    name: str, inertia: str, visuals: dict[str, str], boxes: list[tuple[np.ndarray, tuple[float, ...]]]
) -> str:
    """A link that shows `visuals` (mesh -> colour) and collides as boxes (size, centre)."""
    text = f'  <link name="{name}">\n{inertia}'
    for mesh, colour in visuals.items():
        text += (
            f'    <visual>\n      <geometry><mesh filename="meshes/{mesh}.obj"/></geometry>\n'
            f'      <material name="{colour}"/>\n    </visual>\n'
        )
    for box in boxes:
        text += (
            f'    <collision>\n      <origin xyz="{xyz(box[1])}"/>\n'
            f'      <geometry><box size="{xyz(box[0])}"/></geometry>\n    </collision>\n'
        )
    return text + "  </link>\n"


def fixed(name: str, parent: str, child: str, origin: tuple[float, ...]) -> str:
    return (
        f'  <joint name="{name}" type="fixed">\n    <parent link="{parent}"/>\n    <child link="{child}"/>\n'
        f'    <origin xyz="{xyz(origin)}"/>\n  </joint>\n'
    )


def urdf_text() -> str:
    """The hand: positive joint values open; 0 is closed with the pads touching."""
    tiny = (
        '    <inertial>\n      <mass value="0.001"/>\n'
        '      <inertia ixx="1e-6" ixy="0" ixz="0" iyy="1e-6" iyz="0" izz="1e-6"/>\n    </inertial>\n'
    )
    text = (
        '<?xml version="1.0"?>\n<!-- Written by scripts/generate_hand.py: change it there. -->\n<robot '
        'name="slim_hand">\n'
    )
    for name, rgb in COLOURS.items():
        text += f'  <material name="{name}"><color rgba="{xyz(rgb)} 1"/></material>\n'
    text += link("mount", tiny, {}, [])
    shown = {"coupling": "metal", "collar": "dark", "palm": "shell", "stripe": "accent", "rail": "dark"}
    centre = (0.0, 0.0, PALM[2] / 2)
    text += link("palm", inertial(PALM_MASS, PALM, centre), shown, [(PALM, centre)])
    text += fixed("palm_joint", "mount", "palm", (0.0, 0.0, 0.0))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        centre = (sign * FINGER[0] / 2, 0.0, PAD / 2 - FINGER[2] / 2)
        shown = {f"finger_{side}": "metal", f"pad_{side}": "rubber", f"carriage_{side}": "dark"}
        body = np.array((FINGER[0] - RECESS, *FINGER[1:])), (sign * (FINGER[0] + RECESS) / 2, *centre[1:])
        depth = RECESS + PAD_DEPTH
        pad = np.array((depth, PAD, PAD)), (sign * depth / 2, 0.0, 0.0)
        text += link(f"finger_{side}", inertial(FINGER_MASS, FINGER, centre), shown, [body, pad])
        text += (
            f'  <joint name="finger_{side}_joint" type="prismatic">\n    <parent link="palm"/>\n'
            f'    <child link="finger_{side}"/>\n    <origin xyz="{xyz((0, 0, TCP_Z))}"/>\n'
            f'    <axis xyz="{sign:g} 0 0"/>\n'
            f'    <limit lower="0" upper="{TRAVEL:g}" effort="{EFFORT:g}" velocity="{VELOCITY:g}"/>\n  '
            f"</joint>\n"
        )
    text += link("tcp", tiny, {}, [])
    return text + fixed("tcp_joint", "palm", "tcp", (0.0, 0.0, TCP_Z)) + "</robot>\n"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    default = Path(__file__).parents[1] / "robots/ur5e_pair"
    parser.add_argument(
        "folder", type=Path, nargs="?", default=default, help="where to write (default: %(default)s)"
    )
    folder = parser.parse_args().folder
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    (folder / "hand.urdf").write_text(urdf_text())
    for name, mesh in meshes().items():
        (folder / "meshes" / f"{name}.obj").write_text(obj_text(mesh))


if __name__ == "__main__":
    main()
