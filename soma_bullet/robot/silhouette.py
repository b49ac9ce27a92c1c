"""One arm with its hand and what it carries, as shapes that can be placed and measured against those of
another arm."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import coal
import numpy as np
import pinocchio as pin

from soma_bullet.frames import Array, Mask
from soma_bullet.robot.collision import HAND_MARGIN, MARGIN, CollisionModel
from soma_bullet.robot.kinematics import Robot

SAME_PLACE = 5e-3  # [m] shapes of an obstacle of which no point is farther from its like than this are one


@dataclass(frozen=True, eq=False)
class Placed:
    """Shapes in the world: rotations (n, 3, 3), origins (n, 3) [m], centres (n, 3) and radii (n,) [m] of
    balls around them, and which (n,) are links of the arm, not of its hand or of what that carries."""

    shapes: Sequence[coal.CollisionGeometry]
    rotations: Array
    origins: Array
    centres: Array
    radii: Array
    links: Mask
    _known: dict[int, coal.Transform3s] = field(default_factory=dict)

    def place(self, k: int) -> coal.Transform3s:
        """Where the k-th shape is."""
        if k not in self._known:
            self._known[k] = coal.Transform3s(self.rotations[k], self.origins[k])
        return self._known[k]


class Silhouette:
    """One arm with its hand `opening` [m] wide and pieces in it at T_tcp_piece (4, 4), or nothing."""

    def __init__(
        self, model: CollisionModel, arm: int, opening: float, carried: Mapping[str, Array] | None = None
    ):
        self.robot, self.arm = model.robot, arm
        objects = model.geometry.geometryObjects
        mine = [objects[k] for k, owner in enumerate(model.arm_of) if owner == arm]
        self.shapes = [shape.geometry for shape in mine]
        bodies = [body for body, owner in zip(model.bodies, model.arm_of, strict=True) if owner == arm]
        mounts = [(int(shape.parentJoint), pin.SE3(shape.placement)) for shape in mine]
        for name, T_tcp_piece in (carried or {}).items():
            joint, tcp = self.robot.tcp_mount(arm)
            for k, place in model.piece_shapes[name]:
                self.shapes.append(objects[k].geometry)
                mounts.append((joint, tcp * pin.SE3(np.array(T_tcp_piece)) * place))
        self.links = np.arange(len(self.shapes)) < len(mine)
        self.links[: len(mine)] = [body not in model.hand_links for body in bodies]
        for shape in self.shapes:
            shape.computeLocalAABB()
        self._chain = Chain(self.robot, arm)
        places = self._on_the_chain(mounts, opening)
        self._rotations = np.array([place.rotation for place in places])
        self._centres = np.array(
            [p.act(np.array(s.aabb_center)) for p, s in zip(places, self.shapes, strict=True)]
        )
        self._points = np.array([[place.translation for place in places], self._centres])[..., None]
        self.radii = np.array([float(shape.aabb_radius) for shape in self.shapes])

    def _on_the_chain(self, mounts: Sequence[tuple[int, pin.SE3]], opening: float) -> list[pin.SE3]:
        """Places of shapes on pinocchio's joints seen from the arm's last joint before those; keeps which
        that is."""
        qs, openings = self.robot.home, np.array(self.robot.closed)
        openings[self.arm] = opening
        data = self.robot.model.createData()
        pin.forwardKinematics(self.robot.model, data, self.robot.configuration(qs, openings))
        places, self._parents = [], np.zeros(len(mounts), int)
        for k, (joint, place) in enumerate(mounts):
            moved_by = joint
            while moved_by and moved_by not in self._chain.joints:
                moved_by = int(self.robot.model.parents[moved_by])
            self._parents[k] = self._chain.joints.index(moved_by) + 1 if moved_by else 0
            places.append(data.oMi[moved_by].actInv(data.oMi[joint]) * place)
        return places

    def at(self, q: Array) -> Placed:
        """The arm at its joints (6,) [rad]."""
        return self.along(np.asarray(q)[None]).at(0)

    def along(self, path: Array) -> Track:
        """The arm at every state of a path (n, 6) [rad]."""
        rotations, origins = self._chain.places(path)
        frames, starts = rotations[:, self._parents], origins[:, self._parents]
        places, centres = ((frames @ points)[..., 0] + starts for points in self._points)
        return Track(self.shapes, frames @ self._rotations, places, centres, self.radii, self.links)


class Chain:
    """The joints of one arm, one after another, for many states at once."""

    def __init__(self, robot: Robot, arm: int):
        self.joints = [int(robot.model.getJointId(name)) for name in robot.arm(arm).joint_names]
        placements = [robot.model.jointPlacements[joint] for joint in self.joints]
        self._fixed = np.array([place.rotation for place in placements])
        self._offsets = np.array([place.translation for place in placements])[:, :, None]
        crosses = []  # of the joints' axes
        for joint in self.joints:
            model = robot.model.joints[joint]
            data = model.createData()
            model.calc(data, pin.neutral(robot.model))
            crosses.append(pin.skew(np.array(data.S).ravel()[3:]))
        self._sine = self._fixed @ np.array(crosses)
        self._rest = self._sine @ np.array(crosses)

    def places(self, path: Array) -> tuple[Array, Array]:
        """Rotations (n, 7, 3, 3) and origins (n, 7, 3) [m] of the world and the joints for joints (n, 6)
        [rad] (Rodrigues)."""
        turns = (
            self._fixed
            + np.sin(path)[..., None, None] * self._sine
            + (1.0 - np.cos(path))[..., None, None] * self._rest
        )
        rotations, origins = np.empty((len(path), 7, 3, 3)), np.empty((len(path), 7, 3, 1))
        rotations[:, 0], origins[:, 0] = np.eye(3), 0.0
        for k in range(6):
            origins[:, k + 1] = origins[:, k] + rotations[:, k] @ self._offsets[k]
            rotations[:, k + 1] = rotations[:, k] @ turns[:, k]
        return rotations, origins[..., 0]


@dataclass(frozen=True, eq=False)
class Track:
    """Shapes along a path of n states: rotations (n, m, 3, 3), origins and centres (n, m, 3) [m], radii and
    links (m,)."""

    shapes: Sequence[coal.CollisionGeometry]
    rotations: Array
    origins: Array
    centres: Array
    radii: Array
    links: Mask
    _known: dict[int, Placed] = field(default_factory=dict)

    def at(self, k: int) -> Placed:
        """The shapes at one state."""
        if k not in self._known:
            self._known[k] = Placed(
                self.shapes, self.rotations[k], self.origins[k], self.centres[k], self.radii, self.links
            )
        return self._known[k]

    @cached_property
    def arcs(self) -> Array:
        """Bound (n, m) [m] on how far any point of each shape has come since the start of the path."""
        shifts = np.linalg.norm(np.diff(self.centres, axis=0), axis=2)
        turns = np.linalg.norm(np.diff(self.rotations, axis=0), axis=(2, 3)) / np.sqrt(
            2
        )  # chords of a unit circle
        steps = shifts + turns * self.radii
        return np.vstack([np.zeros(len(self.radii)), np.cumsum(steps, axis=0)])


def distance(first: Placed, second: Placed, enough: float) -> float:
    """Distance [m] between two placed arms, or a bound on it above `enough`."""
    return _nearest(first, second, enough, np.zeros((len(first.shapes), len(second.shapes))))


def _nearest(first: Placed, second: Placed, enough: float, less: Array) -> float:
    """Least distance [m], that of each pair (n, m) less so much, or a bound on it above `enough`."""
    bounds = _bounds(first, second) - less
    nearest = float(bounds[bounds > enough].min(initial=np.inf))
    for i, j in np.argwhere(bounds <= enough).tolist():
        if bounds[i, j] < nearest:
            nearest = min(nearest, apart(first, second, i, j) - less[i, j])
    return nearest


def room(first: Placed, second: Placed, enough: float) -> float:
    """The same where a link of an arm counts as nearer than a hand by what it keeps more (see
    `collision`)."""
    more = np.where(first.links[:, None] | second.links, MARGIN - HAND_MARGIN, 0.0)
    return _nearest(first, second, enough, more)


def apart(first: Placed, second: Placed, i: int, j: int) -> float:
    """Distance [m] between the i-th shape of the one and the j-th of the other."""
    result = coal.DistanceResult()
    coal.distance(first.shapes[i], first.place(i), second.shapes[j], second.place(j), _REQUEST, result)
    return float(result.min_distance)


_REQUEST = coal.DistanceRequest()


def _bounds(first: Placed, second: Placed) -> Array:
    """Lower bounds (n, m) [m] on the distances of their shapes, by the balls around them."""
    gaps = np.linalg.norm(first.centres[:, None] - second.centres, axis=2)
    bounds: Array = gaps - first.radii[:, None] - second.radii
    return bounds


class Obstacle:
    """Many places of arms as one, alike shapes that hardly differ but once; kept off by a margin [m]."""

    def __init__(self, places: Iterable[Placed], margin: float):
        self.margin = margin
        self._tree = coal.DynamicAABBTreeCollisionManager()
        self._objects = []
        for placed, k in _unlike(places):
            thing = coal.CollisionObject(placed.shapes[k], placed.place(k))
            thing.computeAABB()
            thing.getAABB().expand(margin)  # in place
            self._objects.append(thing)
            self._tree.registerObject(thing)
        self._tree.setup()
        self._callback = coal.CollisionCallBackDefault()
        self._callback.data.request.security_margin = margin
        self._movers: dict[int, coal.CollisionObject] = {}

    def __len__(self) -> int:
        return len(self._objects)

    def near(self, placed: Placed) -> bool:
        """Whether a placed arm comes nearer than the margin."""
        for k in range(len(placed.shapes) - 1, -1, -1):  # the hand, and what it carries, hit the soonest
            shape = placed.shapes[k]
            mover = self._movers.get(id(shape))
            if mover is None:
                mover = self._movers[id(shape)] = coal.CollisionObject(shape)
            mover.setTransform(placed.place(k))
            mover.computeAABB()
            self._callback.init()
            self._tree.collide(mover, self._callback)
            if self._callback.data.result.isCollision():
                return True
        return False


def _unlike(places: Iterable[Placed]) -> list[tuple[Placed, int]]:
    """The shapes of places that are farther than SAME_PLACE from all alike ones before them."""
    found: list[tuple[Placed, int]] = []
    seen: dict[int, tuple[list[Array], list[Array]]] = {}
    for placed in places:
        for k, shape in enumerate(placed.shapes):
            centres, rotations = seen.setdefault(id(shape), ([], []))
            if centres:
                shifts = np.linalg.norm(np.array(centres) - placed.centres[k], axis=1)
                turns = np.linalg.norm(np.array(rotations) - placed.rotations[k], axis=(1, 2)) / np.sqrt(2)
                if (shifts + placed.radii[k] * turns).min() < SAME_PLACE:
                    continue
            centres.append(placed.centres[k])
            rotations.append(placed.rotations[k])
            found.append((placed, k))
    return found
