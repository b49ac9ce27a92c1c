"""The PyBullet world of one episode while its clock runs: commands in, measurements out."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import Array
from soma_bullet.frames import from_quat_xyzw as transform_of
from soma_bullet.robot.cell import Cell
from soma_bullet.sim.quiet import pybullet as p
from soma_bullet.sim.stage import Physics, Stage

CLOSING_SPEED, OPENING_SPEED = 0.05, 0.1  # [m/s]


class World(Stage):
    """A stage whose clock runs. It is told joint targets and hand commands, nothing else."""

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
        self.steps = 0
        for arm in range(len(cell.arms)):
            self.open_hand(arm, 0.0)

    # --- commands ----------------------------------------------------------------------------------------------------------

    def command_arm(self, arm: int, q: Array) -> None:
        """Joint targets (6,) of one arm for the next step."""
        self.targets[arm] = q

    def grip_force(self, arm: int) -> float:
        """With which a hand grips [N]."""
        return self.physics.grip_force if self.physics.grip_force is not None else self.cell.arms[arm].hand.grip_force

    def squeeze(self, arm: int, force: float) -> None:
        """Close with a force [N] and keep squeezing."""
        for joint in self.finger_joints[arm]:
            p.setJointMotorControl2(
                self.robot, joint, p.VELOCITY_CONTROL, targetVelocity=-CLOSING_SPEED, force=force, physicsClientId=self.client
            )

    def open_hand(self, arm: int, opening: float, speed: float = OPENING_SPEED) -> None:
        """Move the pads to a distance of `opening` [m], each at up to `speed` [m/s]."""
        limit = self.cell.arms[arm].hand.force_range[1]
        for joint in self.finger_joints[arm]:
            p.setJointMotorControl2(
                self.robot, joint, p.POSITION_CONTROL, targetPosition=opening / 2, maxVelocity=speed, force=limit,
                physicsClientId=self.client,
            )  # fmt: skip

    def renew_contacts(self, arm: int) -> None:
        """Let the contacts of a hand's pads form anew in the next step.

        Bullet keeps an anchored contact as it is, its normal in world axes included. Once the hand has turned the normal is
        stale, up to pointing backwards, and drags the piece along when the hand opens. Renewing the links' place in the broad
        phase drops it; nothing else changes.
        """
        for link in self.finger_links[arm]:
            p.setCollisionFilterGroupMask(self.robot, link, 1, -1, physicsClientId=self.client)

    def step(self) -> None:
        """One time step with the current commands."""
        for arm, joints in zip(self.cell.arms, self.arm_joints, strict=True):
            k = self.cell.arms.index(arm)
            p.setJointMotorControlArray(
                self.robot, joints, p.POSITION_CONTROL, targetPositions=self.targets[k].tolist(),
                targetVelocities=[0.0] * len(joints), forces=arm.effort.tolist(),
                positionGains=[1.0] * len(joints), velocityGains=[1.0] * len(joints), physicsClientId=self.client,
            )  # fmt: skip
        p.stepSimulation(physicsClientId=self.client)
        self.steps += 1

    # --- what a real cell would know -----------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """[s] since the start."""
        return self.steps * self.physics.dt

    def measured_joints(self) -> Array:
        """Joints (arms, 6) [rad]."""
        states = [p.getJointStates(self.robot, joints, physicsClientId=self.client) for joints in self.arm_joints]
        return np.array([[state[0] for state in arm] for arm in states])

    def openings(self) -> Array:
        """Distances between the pads (arms,) [m]."""
        states = [p.getJointStates(self.robot, joints, physicsClientId=self.client) for joints in self.finger_joints]
        return np.array([sum(state[0] for state in hand) for hand in states])

    def wrench(self, arm: int) -> Array:
        """Force and torque (6,) at the wrist, in the hand's mount frame [N, N m]."""
        return np.array(p.getJointState(self.robot, self.wrists[arm], physicsClientId=self.client)[2])

    # --- what only the log may know ------------------------------------------------------------------------------------------

    def piece_poses(self) -> dict[str, Array]:
        """T_world_piece (4, 4) of every piece."""
        poses = {}
        for name, body in self.pieces.items():
            position, quat_xyzw = p.getBasePositionAndOrientation(body, physicsClientId=self.client)
            poses[name] = transform_of(position, quat_xyzw) @ self.T_inertial_piece[name]
        return poses

    def tcp_poses(self) -> list[Array]:
        """T_world_tcp (4, 4) of every arm."""
        states = p.getLinkStates(self.robot, self.tcp_links, computeForwardKinematics=1, physicsClientId=self.client)
        return [transform_of(state[4], state[5]) for state in states]

    def all_joints(self) -> Array:
        """Positions of `moving_joints`."""
        ids = [self.joint_ids[name] for name in self.moving_joints]
        return np.array([state[0] for state in p.getJointStates(self.robot, ids, physicsClientId=self.client)])

    def contacts(self) -> list[tuple[tuple[int, int], tuple[int, int], float, float]]:
        """Touching links as ((body, link), (body, link), normal force [N], distance [m]); the forces of a pair are added."""
        found: dict[tuple[tuple[int, int], tuple[int, int]], tuple[float, float]] = {}
        for row in p.getContactPoints(physicsClientId=self.client):
            key = tuple(sorted(((row[1], row[3]), (row[2], row[4]))))
            force, distance = found.get(key, (0.0, np.inf))  # type: ignore[arg-type]
            found[key] = (force + row[9], min(distance, row[8]))  # type: ignore[index]
        return [(a, b, force, distance) for (a, b), (force, distance) in found.items()]
