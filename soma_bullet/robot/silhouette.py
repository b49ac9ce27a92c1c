"""One arm with its hand and what it carries, as shapes that can be placed and measured against those of another arm."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import coal
import numpy as np
import pinocchio as pin

from soma_bullet.frames import Array
from soma_bullet.robot.collision import CollisionModel

SAME_PLACE = 5e-3  # [m] shapes of an obstacle nearer to each other than this, if alike, are one


@dataclass(frozen=True, eq=False)
class Placed:
    """Shapes in the world: centres (n, 3) and radii (n,) [m] of balls around them, and where to look up their places."""

    shapes: Sequence[coal.CollisionGeometry]
    centres: Array
    radii: Array
    joints: Sequence[pin.SE3]
    locals: Sequence[pin.SE3]
    _known: dict[int, coal.Transform3s] = field(default_factory=dict)

    @cached_property
    def squares(self) -> Array:
        """Squared distances (n,) [m2] of the centres from the origin."""
        found: Array = np.einsum("ni,ni->n", self.centres, self.centres)
        return found

    def place(self, k: int) -> coal.Transform3s:
        """Where the k-th shape is."""
        if k not in self._known:
            pose = self.joints[k] * self.locals[k]
            self._known[k] = coal.Transform3s(pose.rotation, pose.translation)
        return self._known[k]


class Silhouette:
    """One arm with its hand `opening` [m] wide and (piece, T_tcp_piece) in it, or nothing."""

    def __init__(self, model: CollisionModel, arm: int, opening: float, carried: tuple[str, Array] | None = None):
        self.robot, self.arm, self.opening = model.robot, arm, opening
        objects = model.geometry.geometryObjects
        mine = [objects[k] for k, owner in enumerate(model.arm_of) if owner == arm]
        self.shapes = [shape.geometry for shape in mine]
        self.parents = [int(shape.parentJoint) for shape in mine]
        self.locals = [pin.SE3(shape.placement) for shape in mine]
        if carried is not None:
            name, T_tcp_piece = carried
            joint, tcp = self.robot.tcp_mount(arm)
            for k, place in model.piece_shapes[name]:
                self.shapes.append(objects[k].geometry)
                self.parents.append(joint)
                self.locals.append(tcp * pin.SE3(np.array(T_tcp_piece)) * place)
        for shape in self.shapes:
            shape.computeLocalAABB()
        self._centres = np.array([p.act(np.array(s.aabb_center)) for p, s in zip(self.locals, self.shapes, strict=True)])
        self._radii = np.array([float(shape.aabb_radius) for shape in self.shapes])

    def at(self, q: Array) -> Placed:
        """The arm at its joints (6,) [rad]."""
        qs, openings = np.array(self.robot.home), np.array(self.robot.closed)
        qs[self.arm], openings[self.arm] = q, self.opening
        pin.forwardKinematics(self.robot.model, self.robot.data, self.robot.configuration(qs, openings))
        frames = {joint: pin.SE3(self.robot.data.oMi[joint]) for joint in set(self.parents)}
        joints = [frames[joint] for joint in self.parents]
        rotations = np.array([frame.rotation for frame in joints])
        origins = np.array([frame.translation for frame in joints])
        centres = np.einsum("nij,nj->ni", rotations, self._centres) + origins
        return Placed(self.shapes, centres, self._radii, joints, self.locals)


def distance(first: Placed, second: Placed, enough: float) -> float:
    """Distance [m] between two placed arms, or a bound on it above `enough`."""
    nearest = np.inf
    bounds = _bounds(first, second)
    lowest = float(bounds.min())
    if lowest > enough:
        return lowest
    close = np.flatnonzero(bounds <= enough)
    for flat in close[np.argsort(bounds.ravel()[close], kind="stable")].tolist():
        i, j = divmod(flat, bounds.shape[1])
        if bounds[i, j] > nearest:
            break
        result = coal.DistanceResult()
        coal.distance(
            first.shapes[i], first.place(i), second.shapes[j], second.place(j), coal.DistanceRequest(), result
        )  # fmt: skip
        nearest = min(nearest, float(result.min_distance))
    return min(nearest, float(bounds.ravel()[bounds.ravel() > enough].min(initial=np.inf)))


def near(first: Placed, second: Placed, margin: float) -> bool:
    """Whether two placed arms come nearer to each other than a margin [m]."""
    bounds = _bounds(first, second)
    request = coal.CollisionRequest()
    request.security_margin = margin
    for flat in np.flatnonzero(bounds < margin).tolist():
        i, j = divmod(flat, bounds.shape[1])
        result = coal.CollisionResult()
        if coal.collide(first.shapes[i], first.place(i), second.shapes[j], second.place(j), request, result):
            return True
    return False


def _bounds(first: Placed, second: Placed) -> Array:
    """Lower bounds (n, m) [m] on the distances of their shapes, by the balls around them."""
    squared = np.add.outer(first.squares, second.squares) - 2.0 * (first.centres @ second.centres.T)
    bounds: Array = np.sqrt(np.maximum(squared, 0.0)) - np.add.outer(first.radii, second.radii)
    return bounds


def merged(places: Iterable[Placed]) -> Placed | None:
    """Many places of arms as one obstacle, links that hardly move but once; None of nothing."""
    shapes: list[coal.CollisionGeometry] = []
    centres: list[Array] = []
    radii: list[float] = []
    joints: list[pin.SE3] = []
    local: list[pin.SE3] = []
    seen: dict[int, list[pin.SE3]] = {}
    for placed in places:
        for k, shape in enumerate(placed.shapes):
            pose = placed.joints[k] * placed.locals[k]
            alike = seen.setdefault(id(shape), [])
            if any(pose.isApprox(other, SAME_PLACE) for other in alike):
                continue
            alike.append(pose)
            shapes.append(shape)
            centres.append(placed.centres[k])
            radii.append(float(placed.radii[k]))
            joints.append(placed.joints[k])
            local.append(placed.locals[k])
    return Placed(shapes, np.array(centres), np.array(radii), joints, local) if shapes else None
