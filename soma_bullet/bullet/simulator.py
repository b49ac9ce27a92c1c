"""The PyBullet world of one episode while its clock runs: commands in, measurements out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from soma_bullet.assembly.model import Assembly
from soma_bullet.bullet.measured import Measured
from soma_bullet.bullet.quiet import pybullet as p
from soma_bullet.bullet.upkeep import GripUpkeep
from soma_bullet.frames import Array, apply, inverse
from soma_bullet.robot.model import Cell
from soma_bullet.world.options import Physics

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


class BulletSimulator(Measured):
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
        home: Sequence[Array],
        physics: Physics,
    ):
        super().__init__(cell, assembly, stand, poses, home, physics)
        self._looks_every = round(LOOKS_EVERY / self.time_step)
        self.last_looked: Array | None = None
        self._efforts = [arm.effort.tolist() for arm in cell.arms]
        # targets before those of the next sample, of arms that are told new ones: steps between two samples
        # go from one to the other
        self._from: list[Array | None] = [None] * len(cell.arms)
        self._squeezing = [0.0] * len(cell.arms)  # [N]
        self._forming = [0] * len(cell.arms)  # steps until the contacts of a hand's pads have formed anew
        for arm, q in enumerate(home):
            self.command_arm(arm, q)
            self.open_hand(arm, 0.0)

    # --- commands -------------------------------------------------------------------------------------------

    def command_arm(self, arm: int, q: Array) -> None:
        """Joint targets (n,) of one arm for the next sample."""
        if self.substeps > 1 and self._from[arm] is None:
            self._from[arm] = self.targets[arm]
        self.targets[arm] = np.array(q, float)
        self._drive(arm, self.targets[arm])

    def _drive(self, arm: int, q: Array) -> None:
        """Joint targets (n,) of one arm for the next step."""
        joints = self.arm_joints[arm]
        p.setJointMotorControlArray(
            self.robots[arm], joints, p.POSITION_CONTROL, targetPositions=q.tolist(),
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
            firm = (
                force * self.time_step / mass / (self.physics.iterations if self._forming[arm] else SETTLED)
            )
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
        self.forget_contacts()
        self.steps += 1
        if any(self._forming):
            for arm, steps in enumerate(self._forming):
                if steps:
                    self._forming[arm] = steps - 1
                    self.squeeze(arm, self._squeezing[arm])

    def advance(self) -> None:
        """One sample of a trajectory with the current commands."""
        for k in range(1, self.substeps + 1):
            for arm, (before, target) in enumerate(zip(self._from, self.targets, strict=True)):
                if before is not None:
                    self._drive(arm, before + (target - before) * (k / self.substeps))
            self.step()
        self._from = [None] * len(self._from)

    def target(self, arm: int) -> Array:
        """Joint targets (n,) [rad] that an arm was told last."""
        return np.array(self.targets[arm])

    def upkeep(self, arm: int, piece: str, samples: int) -> GripUpkeep:
        """What keeps the contacts of a hand with the piece that it carries along a path of so many
        samples."""
        return GripUpkeep(self, arm, piece, samples)

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


def _moved(back: Array | None, point: Sequence[float]) -> Array:
    """How far (3,) [m] a point of a body has come from where a transform (4, 4) takes it back to; without
    one, it has not."""
    return np.zeros(3) if back is None else np.array(point) - apply(back, point)
