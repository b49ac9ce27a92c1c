"""What is measured in the PyBullet world: what a real cell would know, and what only the log may know."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from soma_bullet.bullet.quiet import pybullet as p
from soma_bullet.bullet.stage import Part, Stage
from soma_bullet.frames import Array, make_transform
from soma_bullet.world.simulator import Contact, Names, Sample

Vector = tuple[float, float, float]


class Measured(Stage):
    """A stage that is measured.

    Attributes:
        steps: time steps since the start.
    """

    steps = 0
    _contact_rows: Sequence[tuple[Any, ...]] | None = None  # of the last step
    _robot_rows: Sequence[tuple[Any, ...]] | None = None  # those among them that an arm has a part in

    def forget_contacts(self) -> None:
        """A step has been made: contacts are other ones now."""
        self._contact_rows = self._robot_rows = None

    # --- what a real cell would know ------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """[s] since the start."""
        return self.steps * self.time_step

    def measured_joints(self) -> tuple[Array, ...]:
        """Joints (n,) [rad] of each arm."""
        both = zip(self.robots, self.arm_joints, strict=True)
        return tuple(np.array(self._positions(*joints)) for joints in both)

    def openings(self) -> Array:
        """Distances between the pads (arms,) [m]."""
        return np.array(
            [sum(self._positions(*joints)) for joints in zip(self.robots, self.finger_joints, strict=True)]
        )

    def _positions(self, body: int, joints: list[int]) -> list[float]:
        states = p.getJointStates(body, joints, physicsClientId=self.client)
        return [state[0] for state in states]

    def wrench(self, arm: int) -> Array:
        """Force and torque (6,) with which the wrist carries the hand, in the hand's mount frame [N, N m].

        It is summed from the contacts of the hand and its weight. Bullet's own sensor leaves out the impulses
        of the gear that couples the fingers: it is wrong by up to all of a force along the closing axis.
        Inertia is left out."""
        force, torque, _, quat_xyzw = self._on_hand(arm)
        return -(np.array((force, torque)) @ _rotation(quat_xyzw)).ravel()

    def load(self, arm: int) -> Array:
        """Force on the hand [N], and torque about its centre between the pads [N m], as the wrist feels them
        (6,).

        Weight is included. In the axes of the world its force stays the same when the hand turns.
        """
        force, torque, mount, _ = self._on_hand(arm)
        centre = self.tcp_place(arm)
        moment = _cross([m - c for m, c in zip(mount, centre, strict=False)], force)
        return np.array((*force, *(t + m for t, m in zip(torque, moment, strict=True))))

    def _on_hand(self, arm: int) -> tuple[Vector, Vector, Vector, tuple[float, ...]]:
        """Force on a hand [N], torque about its mount [N m], place [m] and quaternion (x, y, z, w) of that,
        in the world."""
        body, links = self.robots[arm], self.hand_links[arm]
        states = p.getLinkStates(body, links, physicsClientId=self.client)
        mount, quat_xyzw = states[0][4:6]  # the first link is the mount
        mx, my, mz = mount
        fx = fy = fz = tx = ty = tz = 0.0
        for (x, y, _), mass in zip((state[0] for state in states), self.hand_masses[arm], strict=True):
            weight = -self.physics.gravity * mass
            fz, tx, ty = fz + weight, tx + (y - my) * weight, ty - (x - mx) * weight
        if self._robot_rows is None:
            robots = set(self.robots)
            self._robot_rows = [row for row in self._contacts_now() if row[1] in robots or row[2] in robots]
        for row in self._robot_rows:
            for sign, side in ((1.0, 1), (-1.0, 2)):
                if row[side] == body and row[side + 2] in links:
                    normal, first, second = sign * row[9], sign * row[10], sign * row[12]
                    (nx, ny, nz), (ux, uy, uz), (vx, vy, vz) = row[7], row[11], row[13]
                    gx, gy, gz = (
                        normal * nx + first * ux + second * vx,
                        normal * ny + first * uy + second * vy,
                        normal * nz + first * uz + second * vz,
                    )
                    x, y, z = row[side + 4]
                    lx, ly, lz = _cross((x - mx, y - my, z - mz), (gx, gy, gz))
                    fx, fy, fz, tx, ty, tz = fx + gx, fy + gy, fz + gz, tx + lx, ty + ly, tz + lz
        return (fx, fy, fz), (tx, ty, tz), mount, quat_xyzw

    def _contacts_now(self) -> Sequence[tuple[Any, ...]]:
        """Contacts of the last step, of all bodies: for one, pybullet may swap the two and forget the sign of
        friction."""
        if self._contact_rows is None:
            self._contact_rows = p.getContactPoints(physicsClientId=self.client)
        return self._contact_rows

    # --- what only the log may know -------------------------------------------------------------------------

    def piece_poses(self) -> dict[str, Array]:
        """T_world_piece (4, 4) of every piece."""
        return dict(zip(self.pieces, self.frames_of_pieces(self.places_of_pieces()[None])[0], strict=True))

    def places_of_pieces(self) -> Array:
        """What pybullet keeps of every piece (n, 7): position [m] and quaternion (x, y, z, w) of its
        principal axes."""
        bodies = self.pieces.values()
        return np.array(
            [sum(p.getBasePositionAndOrientation(body, physicsClientId=self.client), ()) for body in bodies]
        )

    def frames_of_pieces(self, places: Array) -> Array:
        """T_world_piece (m, n, 4, 4) of m times `places_of_pieces`."""
        found = np.tile(np.eye(4), (*places.shape[:2], 1, 1))
        found[..., :3, :3] = (
            Rotation.from_quat(places[..., 3:].reshape(-1, 4)).as_matrix().reshape(*places.shape[:2], 3, 3)
        )
        found[..., :3, 3] = places[..., :3]
        return found @ np.array([self.T_inertial_piece[name] for name in self.pieces])

    def tcp_pose(self, arm: int) -> Array:
        """T_world_tcp (4, 4) of one arm."""
        place = self.tcp_place(arm)
        return make_transform(_rotation(place[3:]), place[:3])

    def tcp_place(self, arm: int) -> tuple[float, ...]:
        """Position [m] and quaternion (x, y, z, w) of one arm's TCP (7,)."""
        body, link = self.robots[arm], self.wrists[arm]
        state = p.getLinkState(body, link, computeForwardKinematics=1, physicsClientId=self.client)
        position, quat_xyzw = p.multiplyTransforms(state[4], state[5], *self.tcp_on_mount[arm])
        return (*position, *quat_xyzw)

    def all_joints(self) -> Array:
        """Positions of `moving_joints`."""
        found: list[float] = []
        for body, joints in self.moving.items():
            found += self._positions(body, joints)
        return np.array(found)

    @cached_property
    def names(self) -> Names:
        """What the log calls things."""
        bodies = self.part_names()
        return Names(self.moving_joints, tuple(self.pieces), tuple(bodies.values()))

    @cached_property
    def _codes(self) -> dict[Part, int]:
        """Numbers of the bodies in the log."""
        return {part: code for code, part in enumerate(self.part_names())}

    def sample(self) -> Sample:
        """The moment, for the log."""
        arms = range(len(self.cell.arms))
        grips = np.zeros(len(arms))
        finger = {part: arm for arm, parts in enumerate(self.finger_links) for part in parts}
        contacts: list[Contact] = []
        for a, b, force, distance in self.contacts():
            if force <= 0.0 and distance > 0.0:
                continue  # Bullet lists what is merely near
            contacts.append((self._codes[a], self._codes[b], force, distance))
            for side in (a, b):
                if side in finger:
                    grips[finger[side]] += force / 2
        return Sample(
            self.all_joints(),
            np.concatenate(self.targets),
            self.places_of_pieces(),
            np.array([self.tcp_place(arm) for arm in arms]),
            np.array([self.wrench(arm) for arm in arms]),
            grips,
            contacts,
        )

    def felt_grip(self, arm: int) -> float:
        """Force with which what is between the pads of a hand presses them apart [N]."""
        pads = set(self.finger_links[arm])
        return sum(force for a, b, force, _ in self.contacts() for side in (a, b) if side in pads) / 2

    def poses(self, places: Array) -> Array:
        """T_world_piece (m, n, 4, 4) of m times `places_of_pieces`."""
        return self.frames_of_pieces(places)

    def contacts(self) -> list[tuple[Part, Part, float, float]]:
        """Touching links as ((body, link), (body, link), normal force [N], distance [m]); the forces of a
        pair are added."""
        found: dict[tuple[int, int, int, int], list[float]] = {}
        self._contact_rows = p.getContactPoints(physicsClientId=self.client)
        for row in self._contact_rows:
            total = found.get(row[1:5])
            if total is None:
                found[row[1:5]] = [row[9], row[8]]
            else:
                total[0] += row[9]
                if row[8] < total[1]:
                    total[1] = row[8]
        pairs: dict[tuple[Part, Part], tuple[float, float]] = {}
        for (body_a, body_b, link_a, link_b), (more, nearer) in found.items():
            one, two = (body_a, link_a), (body_b, link_b)
            pair = (one, two) if one < two else (two, one)
            force, distance = pairs.get(pair, (0.0, np.inf))
            pairs[pair] = (force + more, min(distance, nearer))
        return [(a, b, force, distance) for (a, b), (force, distance) in pairs.items()]


def _cross(a: Sequence[float], b: Sequence[float]) -> Vector:
    """Of two vectors; numpy takes ten times as long for so few numbers."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _rotation(quat_xyzw: Sequence[float]) -> Array:
    """Rotation matrix (3, 3)."""
    return np.array(p.getMatrixFromQuaternion(quat_xyzw)).reshape(3, 3)
