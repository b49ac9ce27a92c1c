"""Runs segments in the world, those of different arms at the same time, and reports what a real cell would know.

The simulator is told joint targets and hand commands, nothing else. What a running segment wants of each time step is a
generator: it commands, yields until the step is done, measures, and commands again.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field, replace

import numpy as np

from soma_bullet.frames import Array, readonly, rotation_angle, to_quat_xyzw
from soma_bullet.sim.guide import Compliance, Guide
from soma_bullet.sim.log import ExecutionLog, Recorder, SegmentRecord
from soma_bullet.sim.world import World
from soma_bullet.task.segments import CLOSING, DT, OPENING_TIME, Program, Segment

TARE = 0.1  # [s] at rest before a guarded segment
TOUCH_FORCE, EASED_FORCE = 5.0, 0.5  # [N] of the first touch, and of the grip before the pads leave
RAMP = 0.15  # [s] between those and the full grip force
EASED_SPEED, EASED_TIME = 0.01, 0.05  # [m/s], [s] of the first opening
STALE = np.deg2rad(15.0)  # [rad] by which a hand may turn before the contacts of its pads are renewed
STALE_POINTS = np.deg2rad(7.0)  # [rad] the same where a pad touches in a few points alone, on which the piece rolls
FILTER = 4  # samples of the force that are averaged
JAM = 1e-3  # [m] a guarded motion that stops farther from its end is jammed
LEANING = 0.3  # [s] of resistance so near to its end after which a guided motion has arrived as well
SEATED = 0.35e-3  # [m] a guided motion that meets resistance nearer to its end has arrived; on the table JAM will do
EMPTY = 2e-3  # [m] pads nearer to each other than a piece's width less this hold nothing
WATCH = 5  # samples between looks at the width of a hand that carries
FALL, LOWERING = 1e-3, 8e-3  # [m], [m/s] of the last way straight down
NARROW = 0.5e-3  # [m] largest radius of a search on that way
RESTING, EASING = 0.15, 2e-3  # [N] with which a piece rests that the hand does not press on, [m/s] of going back to it
SLOW = 0.25  # [s] over which a guided motion takes up its speed again
FINAL_SETTLE = 2.0  # [s] after both hands have let go

Steps = Generator[None, None, None]


@dataclass(frozen=True, eq=False)
class Observation:
    """What a real cell knows after a segment.

    Attributes:
        outcome: see SegmentRecord; or `turned`, where a placing was not begun since the piece has turned in the hand.
        qs: measured joints (arms, 6) [rad].
        openings: measured distances between the pads (arms,) [m].
        force: on the hand at the end, against its start (3,) [N], in the world.
        remaining: travel that was left [m].
        reason: of a jam: `force`, `not found`, or empty.
    """

    outcome: str
    qs: Array
    openings: Array
    force: Array
    remaining: float
    reason: str = ""


@dataclass
class _Motion:
    """What came of following a path."""

    outcome: str = "as planned"
    remaining: float = 0.0
    peak: float = 0.0
    force: Array = field(default_factory=lambda: np.zeros(3))
    reason: str = ""


class Executor:
    """Feeds segments to a world and records everything.

    Args:
        compliance: how guarded motions yield; None for motions that stop at the first touch.
    """

    def __init__(self, world: World, program: Program, compliance: Compliance | None = None):
        self.world, self.program, self.compliance = world, program, compliance
        self.recorder = Recorder()
        names = world.part_names()
        self.bodies = list(names.values())
        self._codes = {part: code for code, part in enumerate(names)}
        self._running: dict[int, tuple[Segment, Generator[None, None, Observation]]] = {}
        self._ended: list[tuple[Segment, Observation]] = []
        self._carried: dict[int, float] = {}  # arm -> width of what it holds [m]
        self._tares: dict[int, Array] = {}  # arm -> load of the hand with what it holds in the air (6,)

    # --- running ---------------------------------------------------------------------------------------------------------

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
        if segment.kind == "grasp":
            yield from self._grip(arm)
        elif segment.kind == "release":
            yield from self._let_go(arm, segment.opening)
        elif not np.isnan(segment.opening):
            world.open_hand(arm, segment.opening)
        motion = _Motion()
        if len(segment.path) or (segment.guard and self.compliance is not None):
            yield from self._travel(segment, motion)
        else:
            yield from self._rest(segment.duration - (world.time - start))
        if segment.kind == "grasp":
            if world.openings()[arm] < segment.width - EMPTY:
                motion.outcome = "lost"
            else:
                self._carried[arm] = segment.width
        self._note(segment, start, motion)
        qs, openings = world.measured_joints(), world.openings()
        return Observation(motion.outcome, qs, openings, readonly(motion.force), motion.remaining, motion.reason)

    def _note(self, segment: Segment, start: float, motion: _Motion, kind: str = "") -> None:
        arm = self.world.cell.arms[segment.arm].name
        self.recorder.segments.append(
            SegmentRecord(
                kind or segment.kind,
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

    # --- hands -------------------------------------------------------------------------------------------------------------

    def _grip(self, arm: int) -> Steps:
        """Close gently, then squeeze harder and harder."""
        force = self.world.grip_force(arm)
        self.world.squeeze(arm, min(force, TOUCH_FORCE))
        yield from self._rest(CLOSING / 2)
        yield from self._ramp(arm, min(force, TOUCH_FORCE), force)

    def _let_go(self, arm: int, opening: float) -> Steps:
        """Ease the grip before the pads leave: a piece that is let go while squeezed hard gets a kick."""
        self._carried.pop(arm, None)
        self._tares.pop(arm, None)
        yield from self._ramp(arm, self.world.grip_force(arm), EASED_FORCE)
        self.world.open_hand(arm, opening, EASED_SPEED)
        yield from self._rest(EASED_TIME)
        self.world.open_hand(arm, opening)

    def _ramp(self, arm: int, start: float, end: float) -> Steps:
        steps = max(1, round(RAMP / DT))
        for k in range(1, steps + 1):
            self.world.squeeze(arm, start + (end - start) * k / steps)
            yield

    # --- motions -----------------------------------------------------------------------------------------------------------

    def _travel(self, segment: Segment, motion: _Motion) -> Steps:
        if segment.guard and self.compliance is not None and len(segment.compliance):
            load = yield from self._mean_load(segment.arm)
            if len(segment.path):
                tare = self._tares[segment.arm] = load
                yield from self._guided(segment, motion, self.compliance, tare)
            else:
                tare = self._tares.get(segment.arm, load)
                if (tare - load)[:3] @ segment.last_way > RESTING:  # it rests on something; pressed on, that would creep away
                    return
                yield from self._lowered(segment, motion, self.compliance, tare, np.array(self.world.targets[segment.arm]), 0.0)
            if motion.outcome != "jammed":
                yield from self._ease(segment, tare)
        elif segment.guard:
            yield from self._guarded(segment, motion)
        else:
            yield from self._free(segment, motion)

    def _free(self, segment: Segment, motion: _Motion) -> Steps:
        """Feed a path; a hand that carries watches that its pads stay apart."""
        world, arm = self.world, segment.arm
        anchored, stale = world.tcp_pose(arm)[:3, :3], list[int]()
        lasting = STALE if segment.piece not in world.pieces or world.touches_flat(segment.piece) else STALE_POINTS
        ending = len(segment.path) - 1 - WATCH * len(world.finger_links[arm])
        for k, q in enumerate(segment.path[1:], 1):
            if segment.kind == "transfer" and (k % WATCH == 0 or k >= ending):
                turned = world.tcp_pose(arm)[:3, :3]
                if not stale and (rotation_angle(anchored, turned) > lasting or k == ending):
                    stale, anchored = list(range(len(world.finger_links[arm]))), turned
                if stale and (k < ending or (k - ending) % WATCH == 0):
                    world.renew_contacts(arm, stale.pop())
            world.command_arm(arm, q)
            yield
            if k % WATCH == 0 and arm in self._carried and world.openings()[arm] < self._carried[arm] - EMPTY:
                del self._carried[arm]
                motion.outcome = "lost"
                return

    def _guarded(self, segment: Segment, motion: _Motion) -> Steps:
        """Feed a path; stop where the wrist's force has changed by more than the guard."""
        arm, length = segment.arm, float(np.linalg.norm(segment.offset))
        tare = yield from self._mean_load(arm)
        recent: list[Array] = []
        for k, q in enumerate(segment.path[1:], 1):
            self.world.command_arm(arm, q)
            yield
            recent = [*recent[1 - FILTER :], self.world.load(arm)]
            change = (np.mean(recent, axis=0) - tare)[:3]
            force = float(np.linalg.norm(change))
            motion.peak = max(motion.peak, force)
            if force > segment.guard and len(recent) == FILTER:
                motion.remaining, motion.force = length * _fraction_left(segment.path, float(k)), change
                motion.outcome = "jammed" if motion.remaining > JAM else "stopped early"
                return

    def _guided(self, segment: Segment, motion: _Motion, compliance: Compliance, tare: Array) -> Steps:
        """Feed a path as far as the wrist's force allows, and aside as it asks; see Guide.

        A piece that comes in at a slant stays FALL above its path and comes down straight at the end: it then meets what
        carries it without pushing it aside. Where something should be met at the end, the hand goes on until it is.
        """
        path, length = segment.path, float(np.linalg.norm(segment.offset))
        along, slanted = segment.offset / length, segment.slanted

        def place(at: float, guide: Guide) -> Array:
            whole = min(int(at), len(path) - 2)
            nominal = path[whole] + (at - whole) * (path[whole + 1] - path[whole])
            fall = FALL * min(1.0, 3.0 * at / (len(path) - 1)) * slanted
            shift, turn = guide.offset + (0.0, 0.0, fall), guide.twist * along
            return nominal + segment.compliance[:, :3] @ shift + segment.compliance[:, 3:] @ turn

        def left(at: float) -> float:
            return length * _fraction_left(path, at)

        guide = Guide(along, compliance)
        at = yield from self._feel(segment, motion, guide, tare, len(path) - 1.0, place, left)
        fall = FALL * slanted
        if motion.outcome == "jammed" or (motion.outcome == "stopped early" and not slanted) or not fall + segment.beyond:
            return
        yield from self._lowered(segment, motion, compliance, tare, place(at, guide), fall)

    def _lowered(
        self, segment: Segment, motion: _Motion, compliance: Compliance, tare: Array, start: Array, fall: float
    ) -> Steps:
        """Go on the last way by `fall` [m], and beyond until something is met."""
        down, step = segment.last_way, LOWERING * DT
        guide = Guide(down, replace(compliance, reach=min(compliance.reach, NARROW)))
        motion.outcome = "as planned"
        yield from self._feel(
            segment, motion, guide, tare, (fall + segment.beyond) / step,
            lambda at, g: start + segment.compliance[:, :3] @ (down * at * step + g.offset),  # it turns no more
            lambda at: max(fall - at * step, 0.0),
        )  # fmt: skip

    def _ease(self, segment: Segment, tare: Array) -> Steps:
        """Go back until a piece only just rests on what stopped it: pressed on, that would creep away under it."""
        world, arm = self.world, segment.arm
        start, back = np.array(world.targets[arm]), 0.0
        recent: list[Array] = []
        while back < JAM / 2:
            recent = [*recent[1 - FILTER :], world.load(arm)]
            if -float((np.mean(recent, axis=0) - tare)[:3] @ segment.last_way) < RESTING:
                return
            back += EASING * DT
            world.command_arm(arm, start - segment.compliance[:, :3] @ segment.last_way * back)
            yield

    def _feel(
        self, segment: Segment, motion: _Motion, guide: Guide, tare: Array, last: float,
        place: Callable[[float, Guide], Array], left: Callable[[float], float],
    ) -> Generator[None, None, float]:  # fmt: skip
        """Go from 0 to `last`, a sample at a time, as the guide allows; returns how far it came.

        `place` gives the joints, `left` what is left [m].
        """
        world, arm = self.world, segment.arm
        at, pace = 0.0, 0.0
        seated = JAM if segment.kind == "set_down" else SEATED
        recent: list[Array] = []
        while at < last:
            speed = 1.0
            if len(recent) == FILTER:
                load = np.mean(recent, axis=0) - tare
                motion.force = load[:3]
                force = float(np.linalg.norm(motion.force))
                motion.peak = max(motion.peak, force)
                motion.remaining = left(at)
                if motion.remaining <= seated and force > segment.guard and float(motion.force @ guide.direction) < 0.0:
                    motion.outcome = "stopped early" if motion.remaining > 0.0 else "as planned"
                    return at
                near = motion.remaining <= JAM  # it lies on something, or rubs: searching here would only push that aside
                speed = guide.update(load, DT, motion.remaining, near)
                if guide.failed or (near and guide.waited > LEANING):
                    motion.outcome, motion.reason = "jammed" if guide.failed else "stopped early", guide.failed
                    return at
            pace = min(speed, pace + DT / SLOW)
            at = float(np.clip(at + pace, 0.0, last))
            world.command_arm(arm, place(at, guide))
            yield
            recent = [*recent[1 - FILTER :], world.load(arm)]
        motion.remaining = 0.0
        return at

    def _mean_load(self, arm: int) -> Generator[None, None, Array]:
        loads = []
        for _ in range(round(TARE / DT)):
            yield
            loads.append(self.world.load(arm))
        return np.mean(loads, axis=0)

    def _rest(self, duration: float) -> Steps:
        for _ in range(round(duration / DT)):
            yield

    # --- not of the program ----------------------------------------------------------------------------------------------

    def wait(self, duration: float) -> None:
        """Hold everything where it is commanded for `duration` [s]."""
        for _ in self._rest(duration):
            self._step()

    def let_go(self, segment: Segment, opening: float) -> None:
        """Open a hand where it is: what an ablation does to a hold."""
        start = self.world.time
        for _ in self._let_go(segment.arm, opening):
            self._step()
        self.wait(OPENING_TIME)
        self._note(segment, start, _Motion(), "ablation")

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
        finger = {part: arm for arm, parts in enumerate(world.finger_links) for part in parts}
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
            poses=world.places_of_pieces(),
            tcps=[world.tcp_place(arm) for arm in range(len(world.cell.arms))],
            wrenches=[world.wrench(arm) for arm in range(len(world.cell.arms))],
            grips=grips,
        )

    def log(self, ended: str) -> ExecutionLog:
        """The record so far."""
        program, cell, arrays = self.program, self.world.cell, self.recorder.arrays()
        arrays["poses"] = readonly(np.dstack(to_quat_xyzw(self.world.frames_of_pieces(arrays["poses"]))))
        arrays["tcps"] = readonly(arrays["tcps"] * np.where(arrays["tcps"][..., 6:] < 0.0, (1, 1, 1, -1, -1, -1, -1), 1.0))
        return ExecutionLog(
            cell=cell.name, assembly=program.assembly, digest=program.digest, seed=program.seed, order=program.order,
            stand=program.stand, T_world_assembly=program.T_world_assembly, joint_names=self.world.moving_joints,
            arm_names=tuple(arm.name for arm in cell.arms), piece_names=tuple(self.world.pieces), bodies=tuple(self.bodies),
            segments=tuple(self.recorder.segments), events=tuple(self.recorder.events),
            constraints=self.world.constraints(), ended=ended, **arrays,
        )  # fmt: skip


def _fraction_left(path: Array, at: float) -> float:
    """Of the way along a path (n, 6), by the joints, from a sample that may lie between two."""
    q = path[min(round(at), len(path) - 1)]
    travelled = np.abs(q - path[0]).sum()
    return float(1.0 - travelled / max(np.abs(path[-1] - path[0]).sum(), 1e-12))
