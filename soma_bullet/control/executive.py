"""The executive loop: start what may start, look at what was measured, recover where that is possible, or
stop cleanly.

It knows what a real cell would: measured joints, the wrists' forces, the distances between the pads. Where
pieces are it asks only by an explicit sensing step, which is as inexact as the perception of the feed and is
logged."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from soma_bullet.control.correction import Correction, correct, displacement
from soma_bullet.control.execute import Executor, Observation
from soma_bullet.control.options import ExecutionOptions
from soma_bullet.errors import NoSolutionError
from soma_bullet.frames import Array, apply, inverse, readonly, rotation_angle
from soma_bullet.grasp.clearance import OPENING
from soma_bullet.motion.line import LineError, sample_line
from soma_bullet.motion.timing import time_path
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.task.assignments import Carried, Start
from soma_bullet.task.beside import Beside
from soma_bullet.task.builder import NO_PATH, NONE
from soma_bullet.task.feed import misplace
from soma_bullet.task.feed_options import FeedOptions
from soma_bullet.task.motions import joined
from soma_bullet.task.overlap import overlapped
from soma_bullet.task.program import recover_program, replan
from soma_bullet.task.segments import DT, MOTIONS, OPENING_TIME, SMALLEST_JUMP, SPEEDS, Program, Segment
from soma_bullet.task.tracing import APPROACH
from soma_bullet.task.workcell import Hands, Workcell
from soma_bullet.world.log import Event

LARGEST_JUMP = 0.01  # [rad] a path that starts no farther from the measured joints is bent to meet them
AGAIN = 3  # times that a jammed insertion is tried again
RECOVERIES = 6  # in one episode
OFF_MM, OFF_DEG = 5.0, 10.0  # [mm], [deg] a piece that is seen farther from its goal has been lost
LOOKS = 16  # at a piece in the hand before it is placed, if perception errs: each errs anew
DOUBT = 2.0  # standard errors of their mean by which a piece may seem displaced before that counts
Progress = Callable[[str, float], None]
Detour = Generator[Segment, Observation, Observation]


class _TooLong(Exception):
    """The episode has taken longer than it may."""


@dataclass(frozen=True, eq=False)
class _Trouble:
    """What did not go as planned: a segment of the program."""

    index: int
    segment: Segment
    seen: Observation | None
    reason: str


class Executive:
    """Executes one program.

    Args:
        workcell, plan, program: what is built where, by which plan; recoveries plan on from them.
        executor: of the world.
        feed: how exact perception is.
        options: how it is executed.
        ablate: `hold` opens every hand that should hold; nothing is recovered from then.
    """

    def __init__(
        self,
        workcell: Workcell,
        plan: AssemblyPlan,
        program: Program,
        executor: Executor,
        feed: FeedOptions,
        options: ExecutionOptions,
        ablate: str = "",
        progress: Progress = lambda what, fraction: None,
    ):
        self.workcell, self.plan, self.program, self.executor = workcell, plan, program, executor
        self.feed, self.ablate, self.together, self.progress = feed, ablate, options.together, progress
        self.correct, self.longest = options.recover, options.longest
        self.recover = options.recover and not ablate
        self.placed: list[str] = []
        self.gripped: dict[int, str] = {}  # arm -> piece between its fingers
        self.looks = 0

    def run(self) -> str:
        """Returns `done`, or why it stopped."""
        program, again = self.program, 0
        while True:
            try:
                trouble = self._run(program)
            except _TooLong:
                return f"not done after {self.longest:g} s"
            fallen = self._fallen() if trouble is None and self.recover else []
            if trouble is None and not fallen:
                return "done"
            piece = trouble.segment.piece if trouble else fallen[0]
            what = f"{piece} {trouble.reason}" if trouble else f"{', '.join(fallen)} fell"
            self._event("trouble", piece, what)
            if not self.recover or again == RECOVERIES:
                return what
            again += 1
            try:
                start = self._found(program, trouble)
                seed, feed = self.program.seed + 101 * again, self.program.feed
                program = recover_program(self.workcell, self.plan, start, seed, feed.noise, feed.square)
                program = overlapped(self.workcell, program) if self.together else program
            except NoSolutionError as error:
                self._event("given up", piece, error.summary)
                return f"{what}; {error.summary}"
            self._event("planned anew", piece, f"from step {start.step + 1}")

    # --- running a program ----------------------------------------------------------------------------------

    def _run(self, program: Program) -> _Trouble | None:
        """Run segments as soon as they may, until all are done or one goes wrong; then the others are let
        finish."""
        arms = self.workcell.cell.arms
        waiting = {
            arm: [k for k, s in enumerate(program.segments) if s.arm == arm] for arm in range(len(arms))
        }
        done: set[int] = set()
        running: dict[int, tuple[int, Detour]] = {}
        trouble: _Trouble | None = None
        ended: list[tuple[Segment, Observation]] = []
        while True:
            for segment, seen in ended:
                k, detour = running.pop(segment.arm)
                try:
                    following = detour.send(seen)
                    running[segment.arm] = (k, detour)
                    self.executor.begin(following)
                except StopIteration as stop:
                    trouble = self._after(program, k, segment, stop.value) or trouble
                    done.add(k)
            for arm, queue in waiting.items():
                if (
                    not queue
                    or trouble is not None
                    or arm in running
                    or not done.issuperset(program.after[queue[0]])
                ):
                    continue
                try:
                    ready = self._ready(program, queue[0])
                except NoSolutionError as error:
                    trouble = _Trouble(queue[0], program.segments[queue[0]], None, error.summary)
                    continue
                if ready is not None:
                    k = queue.pop(0)
                    self.progress(
                        f"{arms[arm].name}: {ready.kind} {ready.piece}", len(done) / len(program.segments)
                    )
                    detour = self._detour(ready, partial(self._beside, program, k, done))
                    try:
                        following = next(detour)
                    except StopIteration as stop:  # it does not even begin
                        trouble = self._after(program, k, ready, stop.value)
                        continue
                    if following.kind == "grasp":  # a hand that closes on a piece is about to carry it
                        self.gripped[arm] = following.piece
                    self.executor.begin(following)
                    running[arm] = (k, detour)
            if not running:
                return trouble
            ended = self.executor.tick()
            if self.executor.world.time > self.longest:
                raise _TooLong

    def _ready(self, program: Program, k: int) -> Segment | None:
        """A segment from where its arm is; None where that has to wait until no other arm moves."""
        segment, qs = program.segments[k], self.executor.world.measured_joints()
        if segment.kind not in MOTIONS:
            return segment
        jump = float(np.abs(qs[segment.arm] - segment.path[0]).max())
        if jump <= SMALLEST_JUMP:
            return segment
        if (
            jump <= LARGEST_JUMP or segment.kind == "retreat"
        ):  # perhaps from a placing that was corrected by more
            return replace(segment, path=readonly(joined(segment.path, qs[segment.arm])))
        return None if self.executor.busy else replan(self.workcell, program, k, qs)

    def _beside(self, program: Program, k: int, done: set[int]) -> Beside:
        """The other arms while a segment runs that is about to."""
        return Beside(self.workcell, program, k, self.executor.world.measured_joints(), done)

    def _detour(self, segment: Segment, beside: Callable[[], Beside]) -> Detour:
        """What is run for a segment: itself, and what is tried where an insertion jams. Returns the last
        observation.

        Before a piece is placed a look at it in the hand tells whether it sits there as planned.
        """
        if segment.kind != "place" or not self.correct:
            return (yield segment)
        corrected = self._corrected(segment, beside, DOUBT)
        segment = corrected.segment
        if corrected.fault and self.recover:
            world = self.executor.world
            left = float(np.linalg.norm(segment.offset))
            return Observation(corrected.fault, world.measured_joints(), world.openings(), NONE, left)
        seen = yield segment
        for _ in range(AGAIN if self.recover else 0):
            if seen.outcome != "jammed":
                break
            self._event(
                "jammed", segment.piece, f"{seen.reason or 'contact'}, {seen.remaining * 1e3:.1f} mm left"
            )
            q = self.executor.world.measured_joints()[segment.arm]
            back = joined(self._reached(segment, seen)[::-1], q)
            yield replace(segment, kind="back_off", path=readonly(back), offset=-segment.offset, guard=0.0)
            corrected = self._corrected(segment, beside)
            if corrected.fault:
                return replace(seen, outcome=corrected.fault)
            seen = yield corrected.segment
        return seen

    def _reached(self, segment: Segment, seen: Observation) -> Array:
        """As much of a path as was travelled."""
        length = float(np.linalg.norm(segment.offset))
        last = round((len(segment.path) - 1) * (1.0 - seen.remaining / max(length, 1e-12)))
        return segment.path[: max(last, 1) + 1]

    def _corrected(self, segment: Segment, beside: Callable[[], Beside], sigmas: float = 0.0) -> Correction:
        """A placing, corrected by what is seen in the hand: the mean of some looks if they err.

        It counts from `sigmas` of their mean's error on; without them, after a jam, all of it does.
        """
        looks = LOOKS if any(self.feed.noise) else 1
        seen = [poses[segment.piece] for poses in self._looks(looks)]
        q = self.executor.world.measured_joints()[segment.arm]
        off = displacement(self.workcell, segment, q, seen)
        if sigmas and not off.counts(*(sigmas * np.array(self.feed.noise) / np.sqrt(looks))):
            return Correction(segment)
        if off.gone:
            return Correction(segment, "lost")
        alone = (
            sum(piece not in self.placed for piece in self.gripped.values()) == 1
        )  # else planning anew lays a piece down
        return correct(self.workcell.robot, segment, off, beside(), q, utmost=not alone)

    def _after(self, program: Program, k: int, segment: Segment, seen: Observation) -> _Trouble | None:
        """Keep account of what is where; what went wrong, if anything."""
        if seen.outcome == "turned":
            return _Trouble(k, segment, seen, "turned in the hand")
        if seen.outcome in ("jammed", "lost") and not self.ablate:
            return _Trouble(k, segment, seen, f"{seen.outcome} in {segment.kind}")
        if segment.kind == "place":
            self.placed.append(segment.piece)
        elif segment.kind == "retreat":
            self.gripped.pop(segment.arm, None)
        elif segment.kind == "settle" and self.ablate == "hold":
            assignment = next(a for a in program.schedule.assignments if a.step == segment.step)
            if segment.piece in assignment.holds:
                self.executor.let_go(segment, assignment.width + 2 * OPENING)
        return None

    # --- looking, and going on from what is found -----------------------------------------------------------

    def _looks(self, times: int) -> list[dict[str, Array]]:
        """Perceived T_world_piece of every piece, so many times; each look errs anew."""
        poses, feed = self.executor.world.piece_poses(), self.program.feed
        there = replace(feed, poses=readonly(np.array([poses[name] for name in feed.names])))
        seeds = [self.program.seed + 7919 * (self.looks + k) for k in range(1, times + 1)]
        self.looks += times
        self._event("looked", "", f"{times} times" if times > 1 else "")
        looks = [misplace(self.workcell.assembly, there, self.feed, seed) for seed in seeds]
        return [{name: seen.pose(name) for name in seen.names} for seen in looks]

    def _look(self) -> dict[str, Array]:
        """One of them."""
        return self._looks(1)[0]

    def _fallen(self, poses: Mapping[str, Array] | None = None) -> list[str]:
        """Pieces that were placed and are seen elsewhere."""
        poses = self._look() if poses is None else poses
        return [name for name in self.placed if self._off(name, poses[name])]

    def _off(self, name: str, pose: Array) -> bool:
        goal, piece = (
            self.workcell.settled[name],
            self.workcell.assembly.pieces[self.workcell.assembly.index(name)],
        )
        shift = np.linalg.norm(apply(pose, piece.center_of_mass) - apply(goal, piece.center_of_mass))
        return bool(shift > OFF_MM * 1e-3 or rotation_angle(pose[:3, :3], goal[:3, :3]) > np.deg2rad(OFF_DEG))

    def _found(self, program: Program, trouble: _Trouble | None) -> Start:
        """The state to go on from, the hands clear of what they lost."""
        lost = trouble is not None and trouble.segment.arm in self._empty(trouble)
        if trouble is not None and lost:
            self._withdraw(program, trouble.index, trouble.segment)
        for arm, piece in sorted(self.gripped.items()):
            if list(self.gripped.values()).count(piece) > 1:  # amid a hand-over: one of the two hands lets go
                self._back_away(arm, piece)
        poses = self._look()
        fallen = self._fallen(poses)
        if fallen:
            self._event("fallen", fallen[0], f"{', '.join(fallen)} not in place")
            for arm, piece in list(self.gripped.items()):
                if piece in self.placed:
                    self._back_away(arm, piece)
        self.placed = [name for name in self.placed if name not in fallen]
        order = self.plan.order
        step = next((k for k, name in enumerate(order) if name not in self.placed), len(order))
        if set(order[:step]) != set(self.placed):
            raise NoSolutionError(
                "schedule", f"{', '.join(self.placed)} are in place, which no step of the plan begins with"
            )
        world = self.executor.world
        qs, openings = world.measured_joints(), world.openings()
        held = {arm: piece for arm, piece in self.gripped.items() if piece in self.placed}
        carrying = tuple(
            Carried(piece, arm, inverse(self.workcell.robot.tcp(arm, qs[arm])) @ poses[piece])
            for arm, piece in sorted(self.gripped.items())
            if piece not in self.placed
        )
        known = {
            name: self.workcell.settled[name] if name in self.placed else pose for name, pose in poses.items()
        }
        return Start(step, known, Hands(qs, openings, held), carrying)

    def _empty(self, trouble: _Trouble) -> tuple[int, ...]:
        """Arms whose hands have lost what they should have."""
        if trouble.seen is not None and trouble.seen.outcome == "lost":
            return (trouble.segment.arm,)
        return ()

    def _withdraw(self, program: Program, index: int, segment: Segment) -> None:
        """Open a hand that has nothing, and go back the way it came if it is at a grasp."""
        arm = segment.arm
        self.gripped.pop(arm, None)
        opening = self.executor.world.openings()[arm]
        width = next(
            (s.width for s in reversed(program.segments) if s.kind == "grasp" and s.piece == segment.piece),
            opening,
        )
        opened = max(opening, width) + 2 * OPENING
        self._now(
            replace(segment, kind="release", path=NO_PATH, opening=opened, duration=OPENING_TIME, guard=0.0)
        )
        if segment.kind == "grasp":
            approach = next(
                s for s in reversed(program.segments[:index]) if (s.kind, s.arm) == ("approach", arm)
            )
            q = self.executor.world.measured_joints()[arm]
            back = readonly(joined(approach.path[::-1], q))
            self._now(replace(approach, kind="back_off", path=back, offset=-approach.offset, opening=np.nan))

    def _back_away(self, arm: int, piece: str) -> None:
        """Open a hand at what is left of the assembly, and go straight back."""
        world, robot = self.executor.world, self.workcell.robot
        self.gripped.pop(arm)
        q = world.measured_joints()[arm]
        opened = float(world.openings()[arm]) + 2 * OPENING
        here = Segment("release", -1, arm, piece, NO_PATH, NONE, opened, OPENING_TIME, 0.0)
        self._now(here)
        offset = -robot.tcp(arm, q)[:3, 2] * APPROACH
        try:
            path, travel = sample_line(robot, arm, q, offset)
        except LineError as error:
            raise NoSolutionError("motion", f"{piece}: no way back from where it was held: {error}") from None
        joints = robot.arm(arm)
        timed = time_path(path, joints.velocity, joints.acceleration, DT, travel, SPEEDS["retreat"])
        self._now(
            replace(
                here,
                kind="back_off",
                path=readonly(timed),
                offset=readonly(offset),
                opening=np.nan,
                duration=0.0,
            )
        )

    def _now(self, segment: Segment) -> None:
        self.executor.run(segment)

    def _event(self, kind: str, piece: str, text: str) -> None:
        self.executor.recorder.events.append(Event(self.executor.world.time, kind, piece, text))
