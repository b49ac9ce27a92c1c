"""Runs segments in the world, those of different arms at the same time, and reports what a real cell would
know.

The simulator is told joint targets and hand commands, nothing else. What a running segment wants of each time
step is a generator: it commands, yields until the step is done, measures, and commands again."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np

from soma_bullet.control.options import Compliance
from soma_bullet.control.travel import Motion, Steps, Travel, rest
from soma_bullet.frames import Array, readonly, to_quat_xyzw
from soma_bullet.sizes import Sizes
from soma_bullet.task.kinds import GRASP, RELEASE
from soma_bullet.task.program.program import Program
from soma_bullet.task.segment import CLOSING, DT, OPENING_TIME, Segment
from soma_bullet.world.log import Event, ExecutionLog, Recorder, SegmentRecord
from soma_bullet.world.simulator import Simulator

TOUCH_FORCE, EASED_FORCE = 5.0, 0.5  # [N] of the first touch, and of the grip before the pads leave
RAMP = 0.15  # [s] between those and the full grip force
EASED_SPEED, EASED_TIME = 0.01, 0.05  # [m/s], [s] of the first opening
FINAL_SETTLE = 2.0  # [s] after both hands have let go


@dataclass(frozen=True, eq=False)
class Observation:
    """What a real cell knows after a segment.

    Attributes:
        outcome: see SegmentRecord; or `turned`, where a placing was not begun since the piece has turned in
            the hand.
        qs: measured joints (n,) [rad] of each arm.
        openings: measured distances between the pads (arms,) [m].
        force: on the hand at the end, against its start (3,) [N], in the world.
        remaining: travel that was left [m].
        reason: of a jam: `force`, `not found`, or empty.
    """

    outcome: str
    qs: tuple[Array, ...]
    openings: Array
    force: Array
    remaining: float
    reason: str = ""


class Executor:
    """Feeds segments to a world and records everything.

    Args:
        world: any simulator.
        sizes: of the workpieces.
        compliance: how guarded motions yield; None for motions that stop at the first touch.
        record_every: samples of a trajectory between samples of the log.
        seed: of the execution; that of the program by default.
    """

    def __init__(
        self,
        world: Simulator,
        program: Program,
        sizes: Sizes,
        compliance: Compliance | None = None,
        record_every: int = 5,
        seed: int | None = None,
    ):
        self.world, self.program, self.sizes, self.record_every = world, program, sizes, record_every
        self.seed = program.seed if seed is None else seed
        self.recorder, self._samples = Recorder(), 0
        self._running: dict[int, tuple[Segment, Generator[None, None, Observation]]] = {}
        self._ended: list[tuple[Segment, Observation]] = []
        self.travel = Travel(world, sizes, compliance)

    # --- running --------------------------------------------------------------------------------------------

    @property
    def busy(self) -> tuple[int, ...]:
        """Arms that run a segment."""
        return tuple(sorted(self._running))

    def begin(self, segment: Segment) -> None:
        """Start a segment of an arm that is free."""
        steps = self._perform(segment)
        try:
            next(steps)
        except StopIteration as stop:  # it takes no time at all
            self._ended.append((segment, stop.value))
            return
        self._running[segment.arm] = (segment, steps)

    def tick(self) -> list[tuple[Segment, Observation]]:
        """One sample of everything that runs; what has ended with it."""
        ended, self._ended = self._ended, []
        if not self._running:
            return ended
        self._step()
        for arm in self.busy:
            segment, steps = self._running[arm]
            try:
                next(steps)
            except StopIteration as stop:
                del self._running[arm]
                ended.append((segment, stop.value))
        return ended

    def run(self, segment: Segment) -> Observation:
        """Run one segment alone, to its end or to its guard."""
        self.begin(segment)
        while True:
            for _, seen in self.tick():
                return seen

    def _perform(self, segment: Segment) -> Generator[None, None, Observation]:
        world, start, arm = self.world, self.world.time, segment.arm
        if segment.kind is GRASP:
            yield from self._grip(arm)
        elif segment.kind is RELEASE:
            assert segment.opening is not None
            yield from self._let_go(arm, segment.opening)
        elif segment.opening is not None:
            world.open_hand(arm, segment.opening)
        motion = Motion()
        if len(segment.path) or (segment.guard and self.travel.compliance is not None):
            yield from self.travel.go(segment, motion)
        else:
            yield from rest(segment.duration - (world.time - start))
        if segment.kind is GRASP:
            assert segment.width is not None
            if self.travel.lost(arm, segment.width):
                motion.outcome = "lost"
            else:
                self.travel.carried[arm] = segment.width
        self._note(segment, start, motion)
        qs, openings = world.measured_joints(), world.openings()
        return Observation(
            motion.outcome, qs, openings, readonly(motion.force), motion.remaining, motion.reason
        )

    def _note(self, segment: Segment, start: float, motion: Motion, kind: str = "") -> None:
        arm = self.world.cell.arms[segment.arm].name
        self.recorder.segments.append(
            SegmentRecord(
                kind or str(segment.kind),
                segment.step,
                arm,
                segment.piece,
                start,
                self.world.time,
                motion.outcome,
                segment.offset,
                motion.peak,
                motion.remaining,
            )  # fmt: skip
        )

    # --- hands ----------------------------------------------------------------------------------------------

    def _grip(self, arm: int) -> Steps:
        """Close gently, then squeeze harder and harder."""
        force = self.world.grip_force(arm)
        self.world.squeeze(arm, min(force, TOUCH_FORCE))
        yield from rest(CLOSING / 2)
        yield from self._ramp(arm, min(force, TOUCH_FORCE), force)

    def _let_go(self, arm: int, opening: float) -> Steps:
        """Ease the grip before the pads leave: a piece that is let go while squeezed hard gets a kick."""
        self.travel.forget(arm)
        yield from self._ramp(arm, self.world.grip_force(arm), EASED_FORCE)
        self.world.open_hand(arm, opening, EASED_SPEED)
        yield from rest(EASED_TIME)
        self.world.open_hand(arm, opening)

    def _ramp(self, arm: int, start: float, end: float) -> Steps:
        steps = max(1, round(RAMP / DT))
        for k in range(1, steps + 1):
            self.world.squeeze(arm, start + (end - start) * k / steps)
            yield

    # --- not of the program ---------------------------------------------------------------------------------

    def note_event(self, kind: str, piece: str, text: str) -> None:
        """Log something that was noticed or decided."""
        self.recorder.events.append(Event(self.world.time, kind, piece, text))

    def wait(self, duration: float) -> None:
        """Hold everything where it is commanded for `duration` [s]."""
        for _ in rest(duration):
            self._step()

    def let_go(self, segment: Segment, opening: float) -> None:
        """Open a hand where it is: what an ablation does to a hold."""
        start = self.world.time
        for _ in self._let_go(segment.arm, opening):
            self._step()
        self.wait(OPENING_TIME)
        self._note(segment, start, Motion(), "ablation")

    def settle(self) -> None:
        """The final rest before judgement."""
        start = self.world.time
        self.wait(FINAL_SETTLE)
        self.recorder.segments.append(
            SegmentRecord(
                "final", None, "", "", start, self.world.time, "as planned", readonly(np.zeros(3)), 0.0, 0.0
            )
        )

    def _step(self) -> None:
        """One sample of a trajectory, or as long a rest."""
        self.world.advance()
        self._samples += 1
        if self._samples % self.record_every == 0:
            self.recorder.add(self.world.time, self.world.sample())

    def log(self, ended: str) -> ExecutionLog:
        """The record so far."""
        program, world, arrays = self.program, self.world, self.recorder.arrays()
        poses = world.poses(arrays.pop("places"))
        arrays["poses"] = readonly(np.dstack(to_quat_xyzw(poses)))
        signs = np.where(arrays["tcps"][..., 6:] < 0.0, (1, 1, 1, -1, -1, -1, -1), 1.0)
        arrays["tcps"] = readonly(arrays["tcps"] * signs)
        arms, names = world.cell.arms, world.names
        return ExecutionLog(
            cell=world.cell.name,
            assembly=program.assembly,
            digest=program.digest,
            seed=self.seed,
            order=program.order,
            stand=program.stand,
            T_world_assembly=program.T_world_assembly,
            joint_names=names.joints,
            target_names=tuple(name for arm in arms for name in arm.joint_names),
            arm_names=tuple(arm.name for arm in arms),
            piece_names=names.pieces,
            bodies=names.bodies,
            segments=tuple(self.recorder.segments),
            events=tuple(self.recorder.events),
            constraints=world.constraints(),
            ended=ended,
            **arrays,
        )
