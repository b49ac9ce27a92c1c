"""One URDF composed of the whole cell: table, stand, and every arm with its hand, under the arm's prefix."""

from __future__ import annotations

import copy
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from soma_bullet.errors import InputError
from soma_bullet.frames import Array, make_transform
from soma_bullet.robot.cell import mesh_file, parse_urdf
from soma_bullet.robot.model import Arm, Cell

# PyBullet takes 1 kg and 1 kg m^2 for a link without an inertial element.
_TINY_MASS, _TINY_INERTIA = 1e-3, 1e-6  # [kg], [kg m^2]


def compose_urdf(
    cell: Cell,
    stand_size_xy: tuple[float, float],
    path_out: Path,
    visuals: bool = True,
    fixtures: bool = True,
    arms: Sequence[Arm] | None = None,
    frames: Collection[str] | None = None,
) -> Path:
    """Writes the whole cell as one URDF: `world`, `table`, `stand`, then each arm and its hand under the
    arm's prefix.

    Args:
        stand_size_xy: the stand's footprint [m], from the assembly's.
        fixtures: table and stand; a simulator may want them as bodies of their own.
        visuals: without them the file loads faster and shows nothing but table and stand.
        arms: these of the cell's arms; None for all. A simulator solves arms that are bodies of their own
            faster.
        frames: links without mass and shape that stay, by name; None for all. A simulator goes through each
            of them for every contact.

    Raises:
        InputError: with every mesh that is not found, and all places tried; or with names that collide.
    """
    import yourdfpy
    from lxml import etree
    from yourdfpy import urdf as u

    faults: list[str] = []
    stand_size = np.array((*stand_size_xy, cell.stand_height))
    if (stand_size <= 0).any():
        faults.append(f"stand_size_xy = {stand_size_xy}: must be positive")
    robot = u.Robot(name=cell.name, links=[u.Link(name="world", inertial=_tiny())])
    if fixtures:
        _add_box(
            robot, "table", cell.table.size, (*cell.table.centre, -cell.table.size[2] / 2), cell.table.colour
        )
        _add_box(robot, "stand", stand_size, (*cell.stand_centre, cell.stand_height / 2), cell.stand_colour)
    for arm in cell.arms if arms is None else arms:
        part = _prepared(arm, faults)
        _append(robot, part, arm.name, "world", arm.prefixed(arm.model.base_link), arm.T_world_base)
        hand = parse_urdf(arm.hand.urdf)
        _finish_links(hand, arm.hand.urdf.parent, faults)
        _append(robot, hand, arm.name, arm.tool_link, arm.prefixed(arm.hand.mount_link), np.eye(4))
    names = [link.name for link in robot.links]
    faults += [f"link {name} would be there twice" for name in sorted(set(names)) if names.count(name) > 1]
    unchecked = {link for pair in cell.never_checked for link in pair} if arms is None else set()
    faults += [f"collision.never_checked: {link!r} is not a link of the cell"
               for link in sorted(unchecked - {*names, "table", "stand"})]  # fmt: skip
    if faults:
        raise InputError(str(cell.path), faults)
    if not visuals:
        for link in robot.links:
            link.visuals = [] if link.name not in ("table", "stand") else link.visuals
    if frames is not None:
        _leave_out_frames(robot, {"world", *frames})
    path_out.parent.mkdir(parents=True, exist_ok=True)
    model = yourdfpy.URDF(robot=robot, build_scene_graph=False, load_meshes=False)
    # PyBullet garbles lines of several kB: one element a line.
    path_out.write_bytes(
        etree.tostring(model.write_xml(), xml_declaration=True, encoding="utf-8", pretty_print=True)
    )
    return path_out


def _leave_out_frames(robot: Any, kept: Collection[str]) -> None:
    """Fixes what hangs on links without mass and shape to what those are fixed to, and drops them."""
    above = {joint.child: joint for joint in robot.joints}
    for link in list(robot.links):
        up = above.get(link.name)
        if (
            link.name in kept
            or link.collisions
            or link.inertial.mass > _TINY_MASS
            or up is None
            or up.type != "fixed"
        ):
            continue
        for joint in robot.joints:
            if joint.parent == link.name:
                joint.parent = up.parent
                joint.origin = _origin(up) @ _origin(joint)
        robot.joints.remove(up)
        robot.links.remove(link)


def _origin(joint: Any) -> Array:
    return np.eye(4) if joint.origin is None else np.asarray(joint.origin)


def _tiny() -> Any:
    from yourdfpy import urdf as u

    return u.Inertial(origin=np.eye(4), mass=_TINY_MASS, inertia=np.eye(3) * _TINY_INERTIA)


def _material(name: str, rgb: tuple[float, ...]) -> Any:
    from yourdfpy import urdf as u

    return u.Material(name=name, color=u.Color(rgba=np.array((*rgb, 1.0))))


def _add_box(robot: Any, name: str, size: Array, centre: tuple[float, ...], rgb: tuple[float, ...]) -> None:
    from yourdfpy import urdf as u

    shape = u.Geometry(box=u.Box(size=np.asarray(size)))
    robot.links.append(u.Link(
        name=name, inertial=_tiny(), collisions=[u.Collision(name=None, origin=np.eye(4), geometry=shape)],
        visuals=[u.Visual(origin=np.eye(4), geometry=shape, material=_material(f"{name}_colour", rgb))],
    ))  # fmt: skip
    robot.joints.append(
        u.Joint(
            name=f"{name}_joint",
            type="fixed",
            parent="world",
            child=name,
            origin=make_transform(translation=centre),
        )
    )


def _prepared(arm: Arm, faults: list[str]) -> Any:
    """The arm's own URDF with the meshes replaced and the colours set, names still without prefix."""
    from yourdfpy import urdf as u

    model = arm.model
    robot = parse_urdf(model.urdf)
    for link in robot.links:
        if link.name in model.collision:
            swap, old = model.collision[link.name], link.collisions
            origin = swap.origin if swap.origin is not None else old[0].origin if old else np.eye(4)
            link.collisions = [
                u.Collision(name=None, origin=origin, geometry=_mesh(file)) for file in swap.meshes
            ]
        if link.name in model.visual:
            swap, old = model.visual[link.name], link.visuals
            origin = swap.origin if swap.origin is not None else old[0].origin if old else np.eye(4)
            link.visuals = [u.Visual(origin=origin, geometry=_mesh(file)) for file in swap.meshes]
        for visual in link.visuals:
            if link.name in model.colours:
                visual.material = _material(f"{link.name}_colour", model.colours[link.name])
    _finish_links(robot, model.urdf.parent, faults)
    return robot


def _mesh(file: Path) -> Any:
    from yourdfpy import urdf as u

    return u.Geometry(mesh=u.Mesh(filename=str(file)))


def _finish_links(robot: Any, folder: Path, faults: list[str]) -> None:
    """Absolute mesh paths, an inertial for every link, materials spelled out where they are used."""
    materials = {material.name: material for material in robot.materials}
    for link in robot.links:
        link.inertial = link.inertial or _tiny()
        for shape in (*link.visuals, *link.collisions):
            if shape.geometry.mesh is not None:
                shape.geometry.mesh.filename = str(mesh_file(shape.geometry.mesh.filename, folder, faults))
        for visual in link.visuals:
            if visual.material is not None and visual.material.color is None:
                visual.material = materials.get(visual.material.name, visual.material)


def _append(robot: Any, part: Any, prefix: str, parent: str, root: str, T_parent_root: Array) -> None:
    """Adds a robot to another under a prefix, its root link fixed to `parent`."""
    from yourdfpy import urdf as u

    robot.joints.append(
        u.Joint(name=f"{root}_joint", type="fixed", parent=parent, child=root, origin=np.array(T_parent_root))
    )
    for link in copy.deepcopy(part.links):
        link.name = f"{prefix}_{link.name}"
        for visual in link.visuals:
            if visual.material is not None:
                visual.material.name = f"{prefix}_{visual.material.name}"
        robot.links.append(link)
    for joint in copy.deepcopy(part.joints):
        joint.name, joint.parent, joint.child = (
            f"{prefix}_{n}" for n in (joint.name, joint.parent, joint.child)
        )
        robot.joints.append(joint)
