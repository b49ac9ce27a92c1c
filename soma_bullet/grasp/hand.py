"""The hand as geometry: a parallel gripper described by a TOML file and a URDF.

The TCP lies midway between the pads' centres: z towards the workpiece, x the closing axis (first finger at
+x), y = z x x."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from soma_bullet.errors import InputError
from soma_bullet.frames import Array, make_transform, readonly
from soma_bullet.sizes import way_out
from soma_bullet.toml_fields import Fields, read_toml


@dataclass(frozen=True)
class Box:
    """A solid box. T (4, 4) places its centre in the frame at hand, half (3,) [m] are its half sizes."""

    T: Array
    half: Array

    @cached_property
    def aligned(self) -> bool:
        """Whether its edges are parallel to the axes of the frame at hand."""
        return bool(np.allclose(np.abs(self.T[:3, :3]), np.eye(3), atol=1e-9))

    def moved(self, offset: Array | tuple[float, float, float]) -> Box:
        """The box shifted by `offset` (3,) [m] in its outer frame."""
        shifted = np.array(self.T)
        shifted[:3, 3] += offset
        return Box(readonly(shifted), self.half)


@dataclass(frozen=True)
class Hand:
    """A parallel hand. Lengths in m, forces in N; link and joint names as in its URDF, without any prefix.

    Attributes:
        finger_links, finger_joints: the finger at +x of the TCP first; a positive joint value opens its
            finger.
        opening: widest distance between the pads; each finger joint takes half of it.
        pad_size (2,): along y and z of the TCP.
        T_mount_tcp (4, 4): the TCP seen from the mount link, which sits on the arm's tool link.
        palm_boxes, left_boxes, right_boxes: collision geometry in the TCP frame with the fingers closed.
    """

    name: str
    urdf: Path
    mount_link: str
    palm_link: str
    finger_links: tuple[str, str]
    finger_joints: tuple[str, str]
    tcp_link: str
    opening: float
    pad_size: Array
    pad_friction: float
    grip_force: float
    force_range: tuple[float, float]
    T_mount_tcp: Array
    palm_boxes: tuple[Box, ...]
    left_boxes: tuple[Box, ...]
    right_boxes: tuple[Box, ...]

    @cached_property
    def way_out(self) -> float:
        """How far it goes straight to a grasp, and back from it [m]: longer fingers, farther."""
        palm = max(float(box.T[2, 3] + np.abs(box.T[2, :3]) @ box.half) for box in self.palm_boxes)
        return way_out(round(-palm, 9))

    def boxes(self, width: float) -> tuple[Box, ...]:
        """All collision boxes in the TCP frame with the pads `width` [m] apart: palm, left, right."""
        shift = np.array((width / 2, 0.0, 0.0))
        left = tuple(box.moved(shift) for box in self.left_boxes)
        return (*self.palm_boxes, *left, *(box.moved(-shift) for box in self.right_boxes))

    @cached_property
    def figures(self) -> dict[str, Any]:
        """All fields but the URDF's place, as numbers, texts and lists: the same for equal hands."""
        return {f.name: _plain(getattr(self, f.name)) for f in fields(self) if f.name != "urdf"}


def _plain(value: Any) -> Any:
    """A field of a hand; its boxes by their numbers."""
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if isinstance(value, Box):
        return [value.T.tolist(), value.half.tolist()]
    return np.asarray(value).tolist()


def load_hand(path: Path | str) -> Hand:
    """The hand described by a TOML file (`robots/<cell>/hand.toml`).

    Raises:
        InputError: with every fault of the file and of the URDF that it names.
    """
    path = Path(path)
    faults: list[str] = []
    fields = Fields(read_toml(path), faults)
    fields.schema()
    scale = fields.unit()
    name, urdf = fields.text("name"), path.parent / fields.text("urdf")
    links, joints, grip = fields.table("links"), fields.table("joints"), fields.table("grip")
    mount, palm, tcp = (links.text(key) for key in ("mount", "palm", "tcp"))
    finger_links, finger_joints = links.texts("fingers", 2), joints.texts("fingers", 2)
    opening, pad_size = grip.number("opening") * scale, grip.numbers("pad_size", (2,)) * scale
    friction, force = grip.number("pad_friction"), grip.number("force")
    low, high = grip.numbers("force_range", (2,))
    for part in (fields, links, joints, grip):
        part.close()
    if not low <= force <= high and not np.isnan([low, high, force]).any():
        faults.append(f"grip.force = {force:g} N lies outside grip.force_range = [{low:g}, {high:g}]")
    if not urdf.is_file():
        faults.append(f"urdf: no file {urdf}")
    if faults:  # the geometry can only be read once all names are there
        raise InputError(str(path), faults)

    names = (mount, palm, *finger_links, tcp)
    T_mount_tcp, boxes = _geometry(path, urdf, names, finger_joints, opening)
    finger_size = [2 * np.abs(box.T[1:3, :3]) @ box.half for box in (*boxes[1], *boxes[2])]
    if (pad_size > np.max(finger_size, axis=0) + 1e-9).any():
        faults.append(
            f"grip.pad_size: {pad_size * 1e3} mm exceeds the fingers, {np.max(finger_size, axis=0) * 1e3} mm"
        )
    gaps = [
        min(float(side * box.T[0, 3] - np.abs(box.T[0, :3]) @ box.half) for box in part)
        for side, part in ((1.0, boxes[1]), (-1.0, boxes[2]))
    ]
    if np.abs(gaps).max() > 1e-6:
        faults.append(
            f"urdf: closed fingers must touch at x = 0 of the tcp, they are {np.array(gaps) * 1e3} mm from it"
        )
    if faults:
        raise InputError(str(path), faults)
    return Hand(
        name,
        urdf.resolve(),
        mount,
        palm,
        (finger_links[0], finger_links[1]),
        (finger_joints[0], finger_joints[1]),
        tcp,
        opening,
        readonly(pad_size),
        friction,
        force,
        (float(low), float(high)),
        readonly(T_mount_tcp),
        *boxes,
    )


def _geometry(
    path: Path, urdf: Path, names: tuple[str, ...], finger_joints: tuple[str, ...], opening: float
) -> tuple[Array, tuple[tuple[Box, ...], ...]]:
    """T_mount_tcp and the boxes of palm, left and right finger in the TCP frame, from the URDF's collision
    geometry."""
    import yourdfpy

    try:
        model = yourdfpy.URDF.load(str(urdf), load_meshes=False)
    except Exception as error:  # yourdfpy passes on whatever its XML library raises
        raise InputError(str(urdf), f"cannot be read as URDF: {error}") from None
    faults = [
        f"links: {name!r} is not a link of {urdf.name}; it has {', '.join(model.link_map)}"
        for name in names
        if name not in model.link_map
    ]
    for name in finger_joints:
        joint = model.joint_map.get(name)
        if joint is None or joint.type != "prismatic":
            faults.append(f"joints.fingers: {name!r} is not a prismatic joint of {urdf.name}")
        elif joint.limit is None or (joint.limit.upper or 0.0) < opening / 2 - 1e-9:
            faults.append(f"grip.opening = {opening * 1e3:g} mm needs joint {name} to travel half of it")
    if faults:
        raise InputError(str(path), faults)

    mount, palm, left, right, tcp = names
    for name, sign in zip(finger_joints, (1.0, -1.0), strict=True):
        joint = model.joint_map[name]
        axis = model.get_transform(joint.child, tcp)[:3, :3] @ joint.axis
        if not np.allclose(axis, (sign, 0, 0), atol=1e-6):
            faults.append(
                f"joints.fingers: {name} must open towards {'+' if sign > 0 else '-'}x of the tcp, not {axis}"
            )
    boxes = tuple(
        tuple(
            _box(model.get_transform(link, tcp), shape, urdf, faults)
            for shape in model.link_map[link].collisions
        )
        for link in (palm, left, right)
    )
    faults += [
        f"{urdf.name}: link {link} has no collision geometry"
        for link, shapes in zip((palm, left, right), boxes, strict=True)
        if not shapes
    ]
    if faults:
        raise InputError(str(path), faults)
    return model.get_transform(tcp, mount), boxes


def _box(T_tcp_link: Array, collision: Any, urdf: Path, faults: list[str]) -> Box:
    """A collision element as a box in the TCP frame; a mesh counts as its bounding box."""
    T_tcp_shape = T_tcp_link if collision.origin is None else T_tcp_link @ collision.origin
    shape = collision.geometry
    if shape.box is not None:
        return Box(readonly(T_tcp_shape), readonly(np.asarray(shape.box.size) / 2))
    if shape.mesh is None:
        faults.append(f"{urdf.name}: the collision geometry of a hand must be boxes or meshes")
        return Box(readonly(np.eye(4)), readonly(np.zeros(3)))
    import trimesh

    file = urdf.parent / shape.mesh.filename
    if not file.is_file():
        faults.append(f"{urdf.name}: mesh {shape.mesh.filename!r} not found, tried {file}")
        return Box(readonly(np.eye(4)), readonly(np.zeros(3)))
    low, high = trimesh.load(file, force="mesh").bounds * (
        1.0 if shape.mesh.scale is None else shape.mesh.scale
    )
    return Box(
        readonly(T_tcp_shape @ make_transform(translation=(low + high) / 2)), readonly((high - low) / 2)
    )
