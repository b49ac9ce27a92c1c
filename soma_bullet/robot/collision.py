"""Collision checks for planning: both arms, hands, pieces, table and stand, with coal on pinocchio's
geometry.

A `Scene` is one situation: where the pieces are, what a hand carries, which arm moves, which contacts are
meant. Bodies are called by their link (`left_palm`, `table`, `stand`) or by their piece."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field

import coal
import numpy as np
import pinocchio as pin

from soma_bullet.assembly.hulls import Hull
from soma_bullet.frames import Array
from soma_bullet.robot.kinematics import Robot
from soma_bullet.sizes import CLEAR

MARGIN = 5e-3  # [m] kept to the links of an arm: the simulator's convex hulls stand out by up to 1 mm each
HAND_MARGIN = 2e-3  # [m] kept between hands, pieces, table and stand, which are boxes or exact hulls
NEAR_MARGIN = CLEAR  # [m] kept between a hand or what it carries and pieces: the hand works among them
STRAIGHT = 1e-9  # [m] a finger that slides by no more across the edges of its box sweeps a box
TOUCH_MARGIN = -5e-5  # [m] bodies that are meant to touch may overlap by this


@dataclass(frozen=True, eq=False)
class Situation:
    """What a scene needs to know.

    Attributes:
        poses: T_world_piece (4, 4) of the pieces that lie or stand somewhere.
        carried: piece -> (arm index, T_tcp_piece) of the pieces in hands that move with them.
        moving: indices of the arms that move.
        gripped: piece -> arm index of pieces between the fingers of a hand (carried or held in place).
        touching: unordered pairs of bodies that are meant to touch.
        absent: arms that are left out, for what does not depend on them.
    """

    poses: Mapping[str, Array]
    moving: frozenset[int]
    carried: Mapping[str, tuple[int, Array]] = field(default_factory=dict)
    gripped: Mapping[str, int] = field(default_factory=dict)
    touching: frozenset[frozenset[str]] = frozenset()
    absent: frozenset[int] = frozenset()


class CollisionModel:
    """Geometry of a robot and of the pieces that it works on; makes scenes."""

    def __init__(self, robot: Robot, pieces: Mapping[str, Sequence[Hull]]):
        self.robot = robot
        self.geometry = robot.geometry.copy()
        for shape in self.geometry.geometryObjects:
            if isinstance(shape.geometry, coal.BVHModelBase):
                shape.geometry.buildConvexRepresentation(True)
                shape.geometry = shape.geometry.convex
        self.bodies = [robot.model.frames[shape.parentFrame].name for shape in self.geometry.geometryObjects]
        self.piece_shapes: dict[str, list[tuple[int, pin.SE3]]] = {}
        for name, parts in pieces.items():
            self.piece_shapes[name] = [self._add_part(f"{name}/{k}", part) for k, part in enumerate(parts)]
            self.bodies += [name] * len(parts)
        self.arms = {body: self._arm_of(body) for body in self.bodies}
        self.arm_of = [self.arms[body] for body in self.bodies]
        self.hand_links = {
            link for arm in robot.cell.arms for link in (*arm.finger_links, arm.prefixed(arm.hand.palm_link))
        }
        self.robot_pairs = self._robot_pairs()

    def _add_part(self, name: str, part: Hull) -> tuple[int, pin.SE3]:
        if part.box is not None:
            centre, axes, half = part.box
            right = axes * np.sign(np.linalg.det(axes))
            shape, place = coal.Box(*(2 * half)), pin.SE3(np.ascontiguousarray(right.T), centre)
        else:
            points = coal.StdVec_Vec3s()
            for vertex in part.vertices:
                points.append(vertex)
            shape, place = coal.Convex.convexHull(points, True, "Qt"), pin.SE3.Identity()
        index = self.geometry.addGeometryObject(pin.GeometryObject(name, 0, place, shape))
        return int(index), place

    def _arm_of(self, body: str) -> int | None:
        if body in ("table", "stand") or body in self.piece_shapes:
            return None
        return self.robot.arm_of_link[body]

    def _robot_pairs(self) -> list[tuple[int, int]]:
        """Pairs of robot, table and stand shapes that can collide at all."""
        never = {frozenset(pair) for pair in self.robot.cell.never_checked}
        model, shapes = self.robot.model, self.geometry.geometryObjects
        count = len(shapes) - sum(len(parts) for parts in self.piece_shapes.values())
        pairs = []
        for a in range(count):
            for b in range(a + 1, count):
                i, j = shapes[a].parentJoint, shapes[b].parentJoint
                next_to = i == model.parents[j] or j == model.parents[i]
                # the world is a neighbour of no joint, except that an arm's own base is its shoulder's
                own = 0 not in (i, j) or self.arm_of[a] == self.arm_of[b]
                if (
                    i != j
                    and not (next_to and own)
                    and frozenset((self.bodies[a], self.bodies[b])) not in never
                ):
                    pairs.append((a, b))
        return pairs

    def scene(self, situation: Situation) -> Scene:
        """The scene of a situation."""
        return Scene(self, situation)


class Scene:
    """Collision checks in one situation. Configurations are those of `Robot.configuration`."""

    def __init__(self, model: CollisionModel, situation: Situation):
        self.collision_model, self.situation = model, situation
        self.robot = model.robot
        self.geometry = model.geometry.copy()
        self._tcp_joint = [self.robot.model.frames[f].parentJoint for f in self.robot._tcp_frames]
        self._tcp_place = [self.robot.model.frames[f].placement for f in self.robot._tcp_frames]
        self.geometry.removeAllCollisionPairs()
        self._broad_phase: pin.BroadPhaseManager_NaiveCollisionManager | None = None
        for name, pose in situation.poses.items():
            self._place(name, 0, pin.SE3(np.array(pose)))
        for name, (arm, T_tcp_piece) in situation.carried.items():
            self.attach(name, arm, T_tcp_piece)
        margins = []
        # the shapes of a body are alike, but for where they hang
        known: dict[tuple[str, str, bool], float | None] = {}
        joints = [shape.parentJoint for shape in self.geometry.geometryObjects]
        for a, b in [*model.robot_pairs, *self._piece_pairs()]:
            alike = (model.bodies[a], model.bodies[b], joints[a] == joints[b])
            if alike not in known:
                known[alike] = self._margin(*alike)
            margin = known[alike]
            if margin is not None:
                self.geometry.addCollisionPair(pin.CollisionPair(a, b))
                margins.append(margin)
        self.data = self.robot.model.createData()
        self._margins = np.array(margins)
        self._prepare()

    def _prepare(self) -> None:
        """Make ready for the shapes and the pairs as they are."""
        self._broad_phase = None
        self.geometry_data = self.geometry.createData()
        for request, margin in zip(self.geometry_data.collisionRequests, self._margins.tolist(), strict=True):
            request.security_margin = margin
            request.num_max_contacts = 1

    def swept(self, arm: int, travel: float) -> Scene:
        """The same scene with an arm's fingers as the space that they sweep while each opens by `travel` [m].

        Its configurations have the hand as wide as where it begins: one check stands for all widths of the
        way."""
        other = copy(self)
        other.geometry = self.geometry.copy()
        axes = self.robot.finger_axes(arm)
        for shape in other.geometry.geometryObjects:
            if shape.parentJoint in axes:
                shape.geometry, shape.placement = _swept(
                    shape.geometry, shape.placement, axes[shape.parentJoint] * travel
                )
        other.data = self.robot.model.createData()
        other._prepare()
        return other

    def attach(self, piece: str, arm: int, T_tcp_piece: Array) -> None:
        """Put a piece between the fingers of an arm's hand at T_tcp_piece (4, 4)."""
        self._place(piece, self._tcp_joint[arm], self._tcp_place[arm] * pin.SE3(np.array(T_tcp_piece)))

    def _place(self, piece: str, joint: int, pose: pin.SE3) -> None:
        for index, place in self.collision_model.piece_shapes[piece]:
            shape = self.geometry.geometryObjects[index]
            shape.parentJoint = joint
            shape.placement = pose * place
        self._broad_phase = None

    def _present(self) -> list[str]:
        return [*self.situation.poses, *self.situation.carried]

    def _piece_pairs(self) -> list[tuple[int, int]]:
        model, carried = self.collision_model, self.situation.carried
        robot_count = len(model.bodies) - sum(len(parts) for parts in model.piece_shapes.values())
        pairs = []
        present = self._present()
        for k, name in enumerate(present):
            for index, _ in model.piece_shapes[name]:
                pairs += [(body, index) for body in range(robot_count)]
                for other in present[k + 1 :]:
                    if name in carried or other in carried:
                        pairs += [(index, second) for second, _ in model.piece_shapes[other]]
        return pairs

    def _mover(self, body: str) -> int | None:
        """The arm with which a body moves."""
        carried = self.situation.carried.get(body)
        return carried[0] if carried is not None else self.collision_model.arms[body]

    def _margin(self, a: str, b: str, rigid: bool) -> float | None:
        """Margin [m] of shapes of two bodies, or of one body; None where it need not be checked: both at
        rest, or rigid (on the same joint), or a hand and what it grips."""
        moving = self.situation.moving
        movers = {self._mover(a), self._mover(b)}
        if movers & self.situation.absent:
            return None
        if not movers & moving or (len(movers) == 1 and rigid):
            return None
        names = frozenset((a, b))
        for piece, arm in self.situation.gripped.items():
            if piece in names:
                other = next(iter(names - {piece}), piece)
                if other in self.collision_model.hand_links and self.robot.arm_of_link[other] == arm:
                    return None
        if names in self.situation.touching:
            return TOUCH_MARGIN
        pieces = names & set(self.collision_model.piece_shapes)
        hands = names & self.collision_model.hand_links
        if len(pieces) == 2 or (pieces and hands):
            return NEAR_MARGIN
        return HAND_MARGIN if names <= pieces | hands | {"table", "stand"} else MARGIN

    def collides(self, configuration: Array) -> bool:
        """Whether anything that moves comes nearer than its margin to anything else."""
        if self._broad_phase is None:
            # with some fifty shapes that nearly all move, to compare all boxes is faster than to keep a tree
            # of them
            self._broad_phase = pin.BroadPhaseManager_NaiveCollisionManager(
                self.robot.model, self.geometry, self.geometry_data
            )
            self._found = pin.CollisionCallBackDefault(self.geometry, self.geometry_data, True)
        return bool(
            pin.computeCollisions(self.robot.model, self.data, self._broad_phase, self._found, configuration)
        )

    @property
    def met(self) -> tuple[str, str]:
        """One pair of bodies that are too near, where the last configuration collides."""
        pair = self.geometry.collisionPairs[int(self._found.collisionPairIndex)]
        return self.collision_model.bodies[pair.first], self.collision_model.bodies[pair.second]

    def distance(self, pair: tuple[str, str], configuration: Array) -> tuple[float, float]:
        """Distance between two bodies, negative where they overlap, and what is to be kept between them
        [m]."""
        pin.computeDistances(self.robot.model, self.data, self.geometry, self.geometry_data, configuration)
        found = []
        for k, indices in enumerate(self.geometry.collisionPairs):
            bodies = (self.collision_model.bodies[indices.first], self.collision_model.bodies[indices.second])
            if bodies == pair:
                margin = float(self._margins[k])
                found.append((float(self.geometry_data.distanceResults[k].min_distance), margin))
        return min(found, key=lambda item: item[0] - item[1], default=(np.nan, np.nan))

    def colliding(self, configuration: Array) -> list[tuple[str, str, float]]:
        """The pairs of bodies that are too near, with their distance [m], nearest first."""
        pin.computeDistances(self.robot.model, self.data, self.geometry, self.geometry_data, configuration)
        distances = np.array([result.min_distance for result in self.geometry_data.distanceResults])
        found: dict[tuple[str, str], float] = {}
        for k in np.flatnonzero(distances < self._margins):
            pair = self.geometry.collisionPairs[int(k)]
            names = (self.collision_model.bodies[pair.first], self.collision_model.bodies[pair.second])
            found[names] = min(found.get(names, np.inf), float(distances[k]))
        return sorted(((a, b, d) for (a, b), d in found.items()), key=lambda item: item[2])


def _swept(
    shape: coal.CollisionGeometry, place: pin.SE3, offset: Array
) -> tuple[coal.CollisionGeometry, pin.SE3]:
    """What a box or a convex body at `place` sweeps when it is shifted by `offset` (3,) [m], and where that
    is."""
    along = np.array(place.rotation).T @ offset
    if isinstance(shape, coal.Box):
        half = np.array(shape.halfSide)
        if np.count_nonzero(np.abs(along) > STRAIGHT) <= 1:
            return coal.Box(*(2 * half + np.abs(along))), pin.SE3(
                place.rotation, place.translation + offset / 2
            )
        corners = half * (2 * np.indices((2, 2, 2)).reshape(3, -1).T - 1.0)
    else:
        corners = np.array(shape.points())
    points = coal.StdVec_Vec3s()
    for point in np.vstack([corners, corners + along]):
        points.append(point)
    return coal.Convex.convexHull(points, True, "Qt"), pin.SE3(place)
