"""Forward kinematics by pinocchio, inverse kinematics of each arm by EAIK (all branches, in closed form)."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import pinocchio as pin
from eaik.IK_HP import HPRobot

from soma_bullet.frames import Array, readonly
from soma_bullet.robot.compose import compose_urdf
from soma_bullet.robot.model import Arm, Cell
from soma_bullet.sizes import Reach

Slots = slice | list[int]  # of an arm's joints in pinocchio's vector
FK_ERROR = 1e-6  # [m, and rad] an inverse-kinematics branch that misses its pose by more is dropped


class Robot:
    """The cell's arms as one kinematic model.

    Configurations: `q` (n,) is one arm's joints [rad]; `qs` those of each arm; `openings` (arms,) the
    distances between the pads [m]."""

    def __init__(self, cell: Cell, stand_size: tuple[float, float]):
        self.cell = cell
        self.stand_size = stand_size
        with tempfile.TemporaryDirectory() as folder:
            urdf = str(compose_urdf(cell, stand_size, Path(folder) / "cell.urdf", visuals=False))
            self.model = pin.buildModelFromUrdf(urdf)
            self.geometry = pin.buildGeomFromUrdf(self.model, urdf, pin.GeometryType.COLLISION)
        self.data = self.model.createData()
        self._arm_slots = [_span([self._slot(name) for name in arm.joint_names]) for arm in cell.arms]
        self._finger_slots = [[self._slot(name) for name in arm.finger_joints] for arm in cell.arms]
        self._tcp_frames = [self.model.getFrameId(arm.tcp_link) for arm in cell.arms]
        self._solvers = [self._solver(k) for k in range(len(cell.arms))]

    @cached_property
    def arm_of_link(self) -> dict[str, int]:
        """The arm to which each link of an arm, or of its hand, belongs: all that hangs on its base link."""
        frames = self.model.frames
        bases = {arm.prefixed(arm.model.base_link): k for k, arm in enumerate(self.cell.arms)}
        found: dict[int, int | None] = {0: None}
        for k, frame in enumerate(frames):  # parents come first
            if k:
                found[k] = bases.get(frame.name, found[int(frame.parentFrame)])
        return {frames[k].name: arm for k, arm in found.items() if arm is not None}

    @cached_property
    def reaches(self) -> tuple[Reach, ...]:
        """Lengths that depend on each arm's own, from its second joint to the pads."""
        found = []
        for arm, tcp in zip(self.cell.arms, self._tcp_frames, strict=True):
            joints = [self.model.getJointId(name) for name in arm.joint_names[2:]]
            offsets = [self.model.jointPlacements[joint].translation for joint in joints]
            offsets.append(self.model.frames[tcp].placement.translation)
            found.append(Reach.of(float(sum(np.linalg.norm(offset) for offset in offsets))))
        return tuple(found)

    def _slot(self, joint: str) -> int:
        return int(self.model.joints[self.model.getJointId(joint)].idx_q)

    def arm(self, index: int) -> Arm:
        """The arm's description."""
        return self.cell.arms[index]

    @cached_property
    def home(self) -> tuple[Array, ...]:
        """Home of each arm (n,) [rad]."""
        return tuple(readonly(arm.q_home) for arm in self.cell.arms)

    @cached_property
    def closed(self) -> Array:
        """Openings (arms,) of closed hands [m]."""
        return readonly(np.zeros(len(self.cell.arms)))

    def configuration(self, qs: Sequence[Array], openings: Array) -> Array:
        """pinocchio's vector for each arm's joints (n,) and openings (arms,)."""
        q = np.zeros(self.model.nq)
        for arm, (slots, fingers) in enumerate(zip(self._arm_slots, self._finger_slots, strict=True)):
            q[slots] = qs[arm]
            q[fingers] = openings[arm] / 2
        return q

    def arm_slots(self, arm: int) -> Slots:
        """Where one arm's joints stand in pinocchio's vector."""
        return self._arm_slots[arm]

    def finger_axes(self, arm: int) -> dict[int, Array]:
        """For every finger pinocchio's joint, and the unit vector (3,) along which it opens, seen from that
        joint."""
        found = {}
        for name, slot in zip(self.arm(arm).finger_joints, self._finger_slots[arm], strict=True):
            joint, ends = self.model.getJointId(name), []
            for value in (0.0, 1.0):
                full = np.zeros(self.model.nq)
                full[slot] = value
                pin.forwardKinematics(self.model, self.data, full)
                ends.append(np.array(self.data.oMi[joint].translation))
            found[int(joint)] = np.array(self.data.oMi[joint].rotation).T @ (ends[1] - ends[0])
        return found

    def tcp(self, arm: int, q: Array) -> Array:
        """T_world_tcp (4, 4) of one arm at its joints (n,)."""
        full = np.zeros(self.model.nq)
        full[self._arm_slots[arm]] = q
        pin.framesForwardKinematics(self.model, self.data, full)
        return np.array(self.data.oMf[self._tcp_frames[arm]].homogeneous)

    def jacobian(self, arm: int, q: Array) -> Array:
        """Twist of one arm's TCP for the rates of its joints (6, n) at q (n,): translation, then rotation, in
        world axes."""
        full = np.zeros(self.model.nq)
        full[self._arm_slots[arm]] = q
        frame = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        columns = pin.computeFrameJacobian(self.model, self.data, full, self._tcp_frames[arm], frame)
        return np.array(columns[:, self._arm_slots[arm]])

    def tcp_mount(self, arm: int) -> tuple[int, pin.SE3]:
        """pinocchio's joint that carries an arm's TCP, and the TCP's place on it."""
        frame = self.model.frames[self._tcp_frames[arm]]
        return int(frame.parentJoint), frame.placement

    def inverse(self, arm: int, T_world_tcp: Array, reference: Array) -> Array:
        """All joint vectors (k, n) that reach a TCP pose (4, 4), nearest to `reference` (n,) first.

        Each is wrapped to the turn nearest to it within the limits.
        """
        solver, rotation_home = self._solvers[arm]
        pose = np.array(T_world_tcp)
        pose[:3, :3] = pose[:3, :3] @ rotation_home.T
        limits = self.arm(arm)
        found = np.asarray(solver.IK(pose).Q, float).reshape(-1, len(limits.lower))
        kept: list[Array] = []
        for branch in found[np.isfinite(found).all(axis=1)]:
            q = nearest_turn(branch, reference, limits.lower, limits.upper)
            if q is None or any(np.abs(q - other).max() < 1e-6 for other in kept):
                continue
            if np.abs(self.tcp(arm, q) - T_world_tcp).max() < FK_ERROR:
                kept.append(q)
        return np.array(sorted(kept, key=lambda q: round(float(np.abs(q - reference).max()), 9))).reshape(
            -1, 6
        )

    def follow(self, arm: int, T_world_tcp: Array, previous: Array) -> Array | None:
        """The joints (n,) nearest to `previous` that reach a TCP pose (4, 4): one step along a line; None
        where none do."""
        solver, rotation_home = self._solvers[arm]
        pose = np.array(T_world_tcp)
        pose[:3, :3] = pose[:3, :3] @ rotation_home.T
        limits = self.arm(arm)
        found = np.asarray(solver.IK(pose).Q, float).reshape(-1, len(limits.lower))
        change = (found - previous + np.pi) % (2 * np.pi) - np.pi
        for k in np.abs(change).max(axis=1).argsort(kind="stable").tolist():
            q = previous + change[k]
            within = ((q <= limits.upper) & (q >= limits.lower)).all()  # what is not a number is not, either
            if within and np.abs(self.tcp(arm, q) - T_world_tcp).max() < FK_ERROR:
                return q
        return None

    def _solver(self, arm: int) -> tuple[HPRobot, Array]:
        """EAIK's robot from the joint axes at zero, in the world frame, and the TCP's rotation there."""
        pin.framesForwardKinematics(self.model, self.data, np.zeros(self.model.nq))
        joints = [self.model.getJointId(name) for name in self.arm(arm).joint_names]
        places = [np.array(self.data.oMi[j].homogeneous) for j in joints]
        tcp = np.array(self.data.oMf[self._tcp_frames[arm]].homogeneous)
        axes = np.array([place[:3, 2] for place in places])
        origins = np.array([np.zeros(3), *(place[:3, 3] for place in places), tcp[:3, 3]])
        return HPRobot(axes, np.diff(origins, axis=0)), tcp[:3, :3]


def _span(slots: list[int]) -> Slots:
    """Slots as a slice where one follows the other: numpy is much quicker with these."""
    first = slots[0]
    return slice(first, first + len(slots)) if slots == list(range(first, first + len(slots))) else slots


def nearest_turn(q: Array, reference: Array, lower: Array, upper: Array) -> Array | None:
    """q (n,) shifted by whole turns to lie nearest to `reference` within the limits; None where no turn is
    within."""
    turned = reference + (q - reference + np.pi) % (2 * np.pi) - np.pi
    turned = np.where(
        turned > upper, turned - 2 * np.pi, np.where(turned < lower, turned + 2 * np.pi, turned)
    )
    return None if np.any(turned > upper) or np.any(turned < lower) else turned
