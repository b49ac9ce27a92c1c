"""The PyBullet world of one episode while its clock runs: commands in, measurements out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from soma_bullet.assembly.model import Assembly
from soma_bullet.bullet.quiet import pybullet as p
from soma_bullet.bullet.stage import Part, Stage, time_step
from soma_bullet.frames import Array, apply, inverse, make_transform
from soma_bullet.robot.model import Cell
from soma_bullet.world.options import Physics

Vector = tuple[float, float, float]

CLOSING_SPEED, OPENING_SPEED = 0.05, 0.1  # [m/s]
SETTLED = 8  # iterations of the solver in which a finger's motor reaches its limit
# [s] between looks for contacts whose friction drives what it should stop, and for pieces at rest
LOOKS_EVERY = 0.25
SLIPPED = 0.97  # of the most that friction can hold: there two bodies slip
NEGLIGIBLE = 1e-6  # [N] of friction
DRIVEN = 1e-5  # [m/s] along its friction at which a contact that slips drives
STILL = 2e-5, 2e-4  # [m], [rad] by which a piece at rest has moved between two looks, at most
# steps in which the contacts of a pad form anew: the fingers stand still in the first and close slowly in the
# next
FORMING = 2


class BulletSimulator(Stage):
    """A stage whose clock runs. It is told joint targets and hand commands, nothing else.

    Attributes:
        last_looked: `places_of_pieces` at the last look.
    """

    def __init__(
        self,
        cell: Cell,
        assembly: Assembly,
        stand: tuple[float, float],
        poses: Mapping[str, Array],
        home: Array,
        physics: Physics,
    ):
        super().__init__(cell, assembly, stand, poses, home, physics)
        self.steps, self._looks_every = 0, round(LOOKS_EVERY / time_step(physics))
        self.last_looked: Array | None = None
        self._efforts = [arm.effort.tolist() for arm in cell.arms]
        self._squeezing = [0.0] * len(cell.arms)  # [N]
        self._forming = [0] * len(cell.arms)  # steps until the contacts of a hand's pads have formed anew
        self._contact_rows: Sequence[tuple[Any, ...]] | None = None  # of the last step
        # those among them that an arm has a part in
        self._robot_rows: Sequence[tuple[Any, ...]] | None = None
        for arm, q in enumerate(home):
            self.command_arm(arm, q)
            self.open_hand(arm, 0.0)

    # --- commands -------------------------------------------------------------------------------------------

    def command_arm(self, arm: int, q: Array) -> None:
        """Joint targets (6,) of one arm for the next step."""
        self.targets[arm] = q
        joints = self.arm_joints[arm]
        p.setJointMotorControlArray(
            self.robots[arm], joints, p.POSITION_CONTROL, targetPositions=np.asarray(q, float).tolist(),
            targetVelocities=[0.0] * len(joints), forces=self._efforts[arm],
            positionGains=[1.0] * len(joints), velocityGains=[1.0] * len(joints), physicsClientId=self.client,
        )  # fmt: skip

    def grip_force(self, arm: int) -> float:
        """With which a hand grips [N]."""
        return (
            self.physics.grip_force
            if self.physics.grip_force is not None
            else self.cell.arms[arm].hand.grip_force
        )

    def squeeze(self, arm: int, force: float) -> None:
        """Close with a force [N] and keep squeezing; told so again, squeeze with another force.

        The solver adds to a motor's impulse what its speed is worth, in each iteration, until the limit is
        reached: a hand that has closed is told the speed with which SETTLED iterations do. No more: a pad
        with few contacts may turn the piece at that speed for one step, until the others are found."""
        for joint, mass in zip(self.finger_joints[arm], self.finger_masses[arm], strict=True):
            passes = self.physics.iterations if self._forming[arm] else SETTLED
            firm = force * time_step(self.physics) / mass / passes
            speed = (
                firm
                if self._forming[arm]
                else max(CLOSING_SPEED, firm)
                if self._squeezing[arm]
                else CLOSING_SPEED
            )
            p.setJointMotorControl2(
                self.robots[arm],
                joint,
                p.VELOCITY_CONTROL,
                targetVelocity=-speed,
                force=force,
                physicsClientId=self.client,
            )
        self._squeezing[arm] = force

    def open_hand(self, arm: int, opening: float, speed: float = OPENING_SPEED) -> None:
        """Move the pads to a distance of `opening` [m], each at up to `speed` [m/s]."""
        limit = self.cell.arms[arm].hand.force_range[1]
        self._squeezing[arm], self._forming[arm] = 0.0, 0
        for joint in self.finger_joints[arm]:
            p.setJointMotorControl2(
                self.robots[arm],
                joint,
                p.POSITION_CONTROL,
                targetPosition=opening / 2,
                maxVelocity=speed,
                force=limit,
                physicsClientId=self.client,
            )

    def renew_contacts(self, arm: int, finger: int) -> None:
        """Let the contacts of one of a hand's pads form anew in the next step, while the other keeps the
        piece where it is.

        Bullet keeps an anchored contact as it is, its normal in world axes included. Once the hand has turned
        the normal is stale, up to pointing backwards, and drags the piece along when the hand opens. Renewing
        the links' place in the broad phase drops it. New ones form in the same step, but only where the boxes
        overlap: a pad may start with a point or two, around which the grip would turn the piece until the
        next step finds the others. So the fingers stand still in this one."""
        body, link = self.finger_links[arm][finger]
        p.setCollisionFilterGroupMask(body, link, 1, -1, physicsClientId=self.client)
        if not self._squeezing[arm]:
            return
        limit = self.cell.arms[arm].hand.force_range[1]
        for joint in self.finger_joints[arm]:
            p.setJointMotorControl2(
                self.robots[arm],
                joint,
                p.VELOCITY_CONTROL,
                targetVelocity=0.0,
                force=limit,
                physicsClientId=self.client,
            )
        self._forming[arm] = FORMING

    def step(self) -> None:
        """One time step with the current commands."""
        if self.steps % self._looks_every == 0:
            self.look()
        p.stepSimulation(physicsClientId=self.client)
        self._contact_rows = self._robot_rows = None
        self.steps += 1
        if any(self._forming):
            for arm, steps in enumerate(self._forming):
                if steps:
                    self._forming[arm] = steps - 1
                    self.squeeze(arm, self._squeezing[arm])

    def look(self) -> None:
        """See what has moved since the last look: contacts that drive form anew, and what rests sleeps."""
        places, before = self.places_of_pieces(), self.last_looked
        self.last_looked = places
        if before is None:
            return
        self._forget_what_drives(before, places)
        if self.physics.asleep:
            self._let_sleep(before, places)

    def _let_sleep(self, before: Array, places: Array) -> None:
        """Let pieces at rest sleep that touch nothing but fixtures and such pieces: they wake where anything
        comes near.

        Bullet would do so itself after 2 s at rest. It seldom comes to that: whenever a contact of anything
        is dropped, it goes through those of all else in another order, which is felt as a push of some
        micrometres."""
        far = places - before
        shifts, turns = np.linalg.norm(far[:, :3], axis=1), 2 * np.linalg.norm(far[:, 3:], axis=1)
        still = (shifts < STILL[0]) & (turns < STILL[1])
        restless = {
            body
            for body, rests in zip(self.pieces.values(), still, strict=True)
            if not rests or self._moves(body)
        }
        groups = {body: {body} for body in self.pieces.values()}  # those that touch are in one
        for row in self._contacts_now():
            one, two = row[1], row[2]
            if one in groups and two in groups:
                if groups[one] is not groups[two]:
                    groups[one] |= groups[two]
                    groups.update(dict.fromkeys(groups[two], groups[one]))
            elif one in self.robots or two in self.robots:
                restless |= {one, two}
        for body, group in groups.items():
            if not group & restless:
                state = p.ACTIVATION_STATE_SLEEP
                p.changeDynamics(body, -1, activationState=state, physicsClientId=self.client)

    def _moves(self, body: int) -> bool:
        """Whether a piece is faster than one that sleeps."""
        velocity = sum(p.getBaseVelocity(body, physicsClientId=self.client), ())
        return float(np.linalg.norm(velocity)) >= self.physics.asleep

    def _forget_what_drives(self, before: Array, places: Array) -> None:
        """Let the contacts of pieces that friction drives, and that no pad touches, form anew in the next
        step.

        Bullet's anchored contact pulls towards where it formed, and lets go where its friction exceeds the
        limit: that of one which slips is at the limit, and exceeds it by rounding alone. It goes on pulling
        with all its friction in the same direction, also where the bodies now slide that way, and what is
        pinched so creeps. Coulomb's friction opposes sliding."""
        then, now = self.frames_of_pieces(np.array([before, places]))
        back = dict(zip(self.pieces.values(), then @ inverse(now), strict=True))
        pads = {part for parts in self.finger_links for part in parts}
        gripped, driven = set[int](), set[int]()
        for row in self._contacts_now():
            one, two = (row[1], row[3]), (row[2], row[4])
            if one in pads or two in pads:
                gripped |= {one[0], two[0]}
            elif one in self.roughness and two in self.roughness and (one[0] in back or two[0] in back):
                friction = row[10] * np.array(row[11]) + row[12] * np.array(row[13])
                size = float(np.linalg.norm(friction))
                if size >= SLIPPED * self.roughness[one] * self.roughness[two] * row[9] and size > NEGLIGIBLE:
                    slid = _moved(back.get(one[0]), row[5]) - _moved(back.get(two[0]), row[6])
                    if slid @ friction > DRIVEN * LOOKS_EVERY * size:
                        driven |= {one[0], two[0]}
        for body in sorted(driven & set(back) - gripped):
            p.setCollisionFilterGroupMask(body, -1, 1, -1, physicsClientId=self.client)

    # --- what a real cell would know ------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """[s] since the start."""
        return self.steps * time_step(self.physics)

    def measured_joints(self) -> Array:
        """Joints (arms, 6) [rad]."""
        return np.array(
            [self._positions(*joints) for joints in zip(self.robots, self.arm_joints, strict=True)]
        )

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

    def tcp_poses(self) -> list[Array]:
        """T_world_tcp (4, 4) of every arm."""
        return [self.tcp_pose(arm) for arm in range(len(self.robots))]

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


def _moved(back: Array | None, point: Sequence[float]) -> Array:
    """How far (3,) [m] a point of a body has come from where a transform (4, 4) takes it back to; without
    one, it has not."""
    return np.zeros(3) if back is None else np.array(point) - apply(back, point)


def _cross(a: Sequence[float], b: Sequence[float]) -> Vector:
    """Of two vectors; numpy takes ten times as long for so few numbers."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _rotation(quat_xyzw: Sequence[float]) -> Array:
    """Rotation matrix (3, 3)."""
    return np.array(p.getMatrixFromQuaternion(quat_xyzw)).reshape(3, 3)
