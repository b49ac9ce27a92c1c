"""Runs segments in the world, one at a time, and reports what a real cell would know.

The simulator is told joint targets and hand commands, nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from soma_bullet.frames import Array, readonly, rotation_angle, to_quat_xyzw
from soma_bullet.sim.log import ExecutionLog, Recorder, SegmentRecord
from soma_bullet.sim.world import World
from soma_bullet.task.program import CLOSING, DT, OPENING_TIME, Program, Segment

TARE = 0.1  # [s] at rest before a guarded segment
TOUCH_FORCE, EASED_FORCE = 5.0, 0.5  # [N] of the first touch, and of the grip before the pads leave
RAMP = 0.15  # [s] between those and the full grip force
EASED_SPEED, EASED_TIME = 0.01, 0.05  # [m/s], [s] of the first opening
STALE = np.deg2rad(40.0)  # [rad] by which a hand may turn before the contacts of its pads are renewed
FILTER = 4  # samples of the force that are averaged
JAM = 2e-3  # [m] a guarded placing that stops farther from its end is jammed
EMPTY = 2e-3  # [m] pads nearer to each other than a piece's width less this hold nothing
FINAL_SETTLE = 2.0  # [s] after both hands have let go


@dataclass(frozen=True, eq=False)
class Observation:
    """What a real cell knows after a segment.

    Attributes:
        outcome: see SegmentRecord.
        qs: measured joints (arms, 6) [rad].
        openings: measured distances between the pads (arms,) [m].
        force: wrist's force against its start at the end (3,) [N].
        remaining: travel that was left [m].
    """

    outcome: str
    qs: Array
    openings: Array
    force: Array
    remaining: float


class Executor:
    """Feeds segments to a world and records everything."""

    def __init__(self, world: World, program: Program):
        self.world, self.program = world, program
        self.recorder = Recorder()
        self.bodies = [*world.link_ids, "world", *world.fixtures, *world.pieces]
        links = [(world.robot, link) for link in world.link_ids.values()]
        others = [(body, -1) for body in (world.robot, *world.fixtures.values(), *world.pieces.values())]
        self._codes = {key: code for code, key in enumerate([*links, *others])}

    def run(self, segment: Segment) -> Observation:
        """Run one segment to its end or to its guard."""
        world, start = self.world, self.world.time
        if segment.kind == "grasp":
            self._grip(segment.arm)
        elif segment.kind == "release":
            self._let_go(segment.arm, segment.opening)
        elif not np.isnan(segment.opening):
            world.open_hand(segment.arm, segment.opening)
        outcome, remaining, peak, force = "as planned", 0.0, 0.0, np.zeros(3)
        if len(segment.path):
            outcome, remaining, peak, force = self._follow(segment)
        else:
            self.wait(segment.duration - (world.time - start))
        if segment.kind == "grasp" and world.openings()[segment.arm] < self._width(segment) - EMPTY:
            outcome = "lost"
        self.recorder.segments.append(
            SegmentRecord(
                segment.kind,
                segment.step,
                world.cell.arms[segment.arm].name,
                segment.piece,
                start,
                world.time,
                outcome,
                segment.offset,
                peak,
                remaining,
            )  # fmt: skip
        )
        return Observation(outcome, world.measured_joints(), world.openings(), readonly(force), remaining)

    def _grip(self, arm: int) -> None:
        """Close gently, then squeeze harder and harder."""
        force = self.world.grip_force(arm)
        self.world.squeeze(arm, min(force, TOUCH_FORCE))
        self.wait(CLOSING / 2)
        self._ramp(arm, min(force, TOUCH_FORCE), force)

    def _let_go(self, arm: int, opening: float) -> None:
        """Ease the grip before the pads leave: a piece that is let go while squeezed hard gets a kick."""
        self._ramp(arm, self.world.grip_force(arm), EASED_FORCE)
        self.world.open_hand(arm, opening, EASED_SPEED)
        self.wait(EASED_TIME)
        self.world.open_hand(arm, opening)

    def _ramp(self, arm: int, start: float, end: float) -> None:
        steps = max(1, round(RAMP / DT))
        for k in range(1, steps + 1):
            self.world.squeeze(arm, start + (end - start) * k / steps)
            self._step()

    def _width(self, segment: Segment) -> float:
        return next(a.width for a in self.program.schedule.assignments if a.step == segment.step)

    def _follow(self, segment: Segment) -> tuple[str, float, float, Array]:
        """Feed a path; stop where the wrist's force has changed by more than the guard."""
        world, arm = self.world, segment.arm
        if segment.guard:
            tare = self._mean_force(arm, TARE)
        else:
            tare = world.wrench(arm)[:3]
        recent: list[Array] = []
        peak = 0.0
        anchored = world.tcp_poses()[arm][:3, :3]
        for k, q in enumerate(segment.path[1:], 1):
            if segment.kind == "transfer":
                turned = world.tcp_poses()[arm][:3, :3]
                if rotation_angle(anchored, turned) > STALE or k + 1 == len(segment.path):
                    world.renew_contacts(arm)
                    anchored = turned
            world.command_arm(arm, q)
            self._step()
            if not segment.guard and k % 5:
                continue
            recent = [*recent[1 - FILTER :], world.wrench(arm)[:3]]
            change = np.mean(recent, axis=0) - tare
            force = float(np.linalg.norm(change))
            peak = max(peak, force) if segment.guard or segment.kind == "insert" else peak
            if segment.guard and force > segment.guard and len(recent) == FILTER:
                remaining = float(np.linalg.norm(segment.offset)) * self._fraction_left(segment, k)
                return ("jammed" if remaining > JAM else "stopped early"), remaining, peak, change
        return "as planned", 0.0, peak, np.zeros(3)

    def _fraction_left(self, segment: Segment, k: int) -> float:
        travelled = np.abs(segment.path[k] - segment.path[0]).sum()
        return float(1.0 - travelled / max(np.abs(segment.path[-1] - segment.path[0]).sum(), 1e-12))

    def _mean_force(self, arm: int, duration: float) -> Array:
        forces = []
        for _ in range(round(duration / DT)):
            self._step()
            forces.append(self.world.wrench(arm)[:3])
        return np.mean(forces, axis=0)

    def wait(self, duration: float) -> None:
        """Hold everything where it is commanded for `duration` [s]."""
        for _ in range(round(duration / DT)):
            self._step()

    def let_go(self, segment: Segment, opening: float) -> None:
        """Open a hand where it is: what an ablation does to a hold."""
        start = self.world.time
        self._let_go(segment.arm, opening)
        self.wait(OPENING_TIME)
        self.recorder.segments.append(
            SegmentRecord(
                "ablation",
                segment.step,
                self.world.cell.arms[segment.arm].name,
                segment.piece,
                start,
                self.world.time,
                "as planned",
                readonly(np.zeros(3)),
                0.0,
                0.0,
            )  # fmt: skip
        )

    def settle(self) -> None:
        """The final rest before judgement."""
        start = self.world.time
        self.wait(FINAL_SETTLE)
        self.recorder.segments.append(
            SegmentRecord("final", -1, "", "", start, self.world.time, "as planned", readonly(np.zeros(3)), 0.0, 0.0)
        )

    def _step(self) -> None:
        """One sample of a trajectory, or as long a rest."""
        physics = self.world.physics
        for _ in range(physics.substeps):
            self.world.step()
        if self.world.steps % (physics.substeps * physics.record_every) == 0:
            self._record()

    def _record(self) -> None:
        world = self.world
        grips = np.zeros(len(world.cell.arms))
        finger = {(world.robot, link): arm for arm, links in enumerate(world.finger_links) for link in links}
        for a, b, force, distance in world.contacts():
            if force <= 0.0 and distance > 0.0:
                continue  # Bullet lists what is merely near
            self.recorder.touch(self._codes[a], self._codes[b], force, distance)
            for side in (a, b):
                if side in finger:
                    grips[finger[side]] += force / 2
        self.recorder.add(
            times=world.time,
            joints=world.all_joints(),
            targets=world.targets,
            poses=[np.concatenate(to_quat_xyzw(pose)) for pose in world.piece_poses().values()],
            tcps=[np.concatenate(to_quat_xyzw(pose)) for pose in world.tcp_poses()],
            wrenches=[world.wrench(arm) for arm in range(len(world.cell.arms))],
            grips=grips,
        )

    def log(self, ended: str) -> ExecutionLog:
        """The record so far."""
        program, cell = self.program, self.world.cell
        return ExecutionLog(
            cell=cell.name, assembly=program.assembly, digest=program.digest, seed=program.seed, order=program.order,
            stand=program.stand, T_world_assembly=program.T_world_assembly, joint_names=self.world.moving_joints,
            arm_names=tuple(arm.name for arm in cell.arms), piece_names=tuple(self.world.pieces), bodies=tuple(self.bodies),
            segments=tuple(self.recorder.segments), constraints=self.world.constraints(), ended=ended, **self.recorder.arrays(),
        )  # fmt: skip
