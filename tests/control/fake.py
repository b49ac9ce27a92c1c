"""A world without physics: all that control needs of a simulator, in as few lines as that takes.

Joints are where they were told to be. A hand that squeezes closes to the width of the piece between its pads,
which moves with it from then on. What is let go near its goal settles there, and else falls onto the table. A
carried piece is pushed back by what it touches in the assembly, and by the table, like by springs."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from soma_bullet.assembly.contacts import SUPPORT
from soma_bullet.frames import Array, apply, from_quat_xyzw, inverse, rotation_angle, to_quat_xyzw, translate
from soma_bullet.task.segment import DT
from soma_bullet.task.workcell import Workcell
from soma_bullet.world.simulator import Names, Sample

SPEED = 0.1  # [m/s] of each pad
NEAR, TURNED = 3e-3, np.deg2rad(3.0)  # [m], [rad] from its goal, where a piece settles there
STIFFNESS = 2e4  # [N/m]


class FakeSimulator:
    """A `world.simulator.Simulator`. The pieces begin at T_world_piece (4, 4)."""

    def __init__(self, workcell: Workcell, poses: Mapping[str, Array]):
        self.workcell, self.robot, self.cell = workcell, workcell.robot, workcell.cell
        joints = [n for arm in self.cell.arms for n in (*arm.joint_names, *arm.finger_joints)]
        pieces = workcell.assembly.names
        self.names = Names(tuple(joints), pieces, ("table", "stand", *pieces))
        self.lying = dict(poses)  # or where they were when they were taken
        self.closing = dict[int, str]()  # arm -> piece between its pads
        self.held = dict[int, tuple[str, Array]]()  # arm -> piece, T_tcp_piece (4, 4)
        self.targets = [np.array(q) for q in workcell.robot.home]
        self.gaps, self.goals, self.forces, self.speeds = np.zeros((4, len(self.cell.arms)))
        self.ticks = 0

    # --- commands -------------------------------------------------------------------------------------------

    def command_arm(self, arm: int, q: Array) -> None:
        self.targets[arm] = np.array(q, float)

    def grip_force(self, arm: int) -> float:
        return self.cell.arms[arm].hand.grip_force

    def squeeze(self, arm: int, force: float) -> None:
        if not self.forces[arm]:
            self.closing[arm], self.goals[arm] = self.between(arm)
        self.forces[arm], self.speeds[arm] = force, SPEED

    def open_hand(self, arm: int, opening: float, speed: float = SPEED) -> None:
        self.forces[arm], self.goals[arm], self.speeds[arm] = 0.0, opening, speed
        self.closing.pop(arm, None)
        if arm in self.held:
            pose, (piece, _) = self.piece_poses()[self.held[arm][0]], self.held.pop(arm)
            self.lying[piece] = self.come_to_rest(piece, pose)

    def target(self, arm: int) -> Array:
        return self.targets[arm].copy()

    def advance(self) -> None:
        self.ticks += 1
        reach = 2 * self.speeds * DT
        self.gaps = np.clip(self.goals, self.gaps - reach, self.gaps + reach)
        for arm, piece in list(self.closing.items()):
            if self.gaps[arm] == self.goals[arm]:
                del self.closing[arm]
                if piece:
                    self.held[arm] = piece, inverse(self.tcp(arm)) @ self.piece_poses()[piece]

    def upkeep(self, arm: int, piece: str, samples: int) -> FakeSimulator:
        return self

    def at(self, sample: int) -> None:
        """Contacts that are not there need no upkeep."""

    def close(self) -> None:
        """Nothing to free."""

    # --- measurements ---------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        return self.ticks * DT

    def measured_joints(self) -> tuple[Array, ...]:
        return tuple(q.copy() for q in self.targets)

    def openings(self) -> Array:
        return self.gaps.copy()

    def felt_grip(self, arm: int) -> float:
        return self.forces[arm] if arm in self.held else 0.0

    def load(self, arm: int) -> Array:
        force = self.push(self.held[arm][0]) if arm in self.held else np.zeros(3)
        return np.concatenate([force, np.zeros(3)])

    # --- for the log, and for a sensing step ----------------------------------------------------------------

    def piece_poses(self) -> dict[str, Array]:
        carried = {piece: self.tcp(arm) @ T for arm, (piece, T) in reversed(self.held.items())}
        return {name: carried.get(name, pose) for name, pose in self.lying.items()}

    def sample(self) -> Sample:
        arms, poses = range(len(self.targets)), self.piece_poses()
        joints = [np.append(q, [gap / 2] * 2) for q, gap in zip(self.targets, self.gaps, strict=True)]
        places = places_of(np.array([poses[name] for name in self.names.pieces]))
        tcps, grips = places_of(np.array([self.tcp(arm) for arm in arms])), np.zeros(len(arms))
        grips[list(self.held)] = self.forces[list(self.held)]
        wrenches = np.array([self.load(arm) for arm in arms])
        return Sample(np.concatenate(joints), np.concatenate(self.targets), places, tcps, wrenches, grips, ())

    def poses(self, places: Array) -> Array:
        rows = places.reshape(-1, 7)
        return np.array([from_quat_xyzw(row[:3], row[3:]) for row in rows]).reshape(*places.shape[:2], 4, 4)

    def constraints(self) -> tuple[str, ...]:
        return ()

    # --- the world ------------------------------------------------------------------------------------------

    def tcp(self, arm: int) -> Array:
        """T_world_tcp (4, 4)."""
        return self.robot.tcp(arm, self.targets[arm])

    def between(self, arm: int) -> tuple[str, float]:
        """The piece between the pads of a hand, and how wide it is there [m]; exact for boxes along its
        axes."""
        half = np.array((self.gaps[arm], *self.cell.arms[arm].hand.pad_size)) / 2
        for name, pose in self.piece_poses().items():
            T = inverse(self.tcp(arm)) @ pose
            bounds = np.array([part.moved(T).bounds for part in self.workcell.body(name).body_parts])
            there = bounds[((bounds[:, 0] < half) & (bounds[:, 1] > -half)).all(axis=1)]
            if len(there):
                return name, float(there[:, 1, 0].max() - there[:, 0, 0].min())
        return "", 0.0

    def push(self, piece: str) -> Array:
        """Force (3,) [N] on a carried piece of what it touches."""
        pose, cell = self.piece_poses()[piece], self.workcell
        force = np.zeros(3)
        force[2] = max(0.0, -self.height(piece, pose))
        if self.at_goal(piece, pose):
            k, shift = cell.assembly.index(piece), pose[:3, 3] - cell.settled[piece][:3, 3]
            for contact in (c.into(k) for c in cell.assembly.contacts if k in (c.body_a, c.body_b)):
                if contact.body_a == SUPPORT or self.stands(cell.assembly.names[contact.body_a]):
                    normal = cell.T_world_assembly[:3, :3] @ contact.normal
                    force = force + max(0.0, -float(shift @ normal)) * normal
        return STIFFNESS * force

    def come_to_rest(self, piece: str, pose: Array) -> Array:
        """Where a piece ends up (4, 4) that is let go at a pose."""
        if self.at_goal(piece, pose):
            return self.workcell.settled[piece]
        return translate(pose, (0.0, 0.0, -self.height(piece, pose)))

    def height(self, piece: str, pose: Array) -> float:
        """Of the lowest point of the real body above the table [m]."""
        body = self.workcell.body(piece)
        return float(apply(pose, body.vertices)[:, 2].min() + body.clearance)

    def at_goal(self, piece: str, pose: Array) -> bool:
        """Whether a piece is so near to its goal that it settles there."""
        goal = self.workcell.settled[piece]
        near = np.linalg.norm(pose[:3, 3] - goal[:3, 3]) < NEAR
        return bool(near and rotation_angle(pose[:3, :3], goal[:3, :3]) < TURNED)

    def stands(self, piece: str) -> bool:
        return self.at_goal(piece, self.piece_poses()[piece])


def places_of(poses: Array) -> Array:
    """Position and quaternion (x, y, z, w) of poses (n, 4, 4): (n, 7)."""
    return np.hstack(to_quat_xyzw(poses))
