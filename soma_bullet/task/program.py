"""The program: a schedule turned into segments, each a timed trajectory or a hand command, with guards.

Segments run one after another. `replan` makes a segment anew from measured joints, when the cell is not where the program
expected it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from soma_bullet.errors import NoSolutionError
from soma_bullet.frames import Array, inverse, readonly
from soma_bullet.grasp.clearance import OPENING
from soma_bullet.motion.line import LineError, sample_line
from soma_bullet.motion.timing import HandLimits, TimingError, time_path
from soma_bullet.motion.transfer import TransferError, TransferOptions, blend_corners, plan_transfer
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.robot.collision import Scene
from soma_bullet.task.feed import Feed
from soma_bullet.task.grasps import grasp_poses
from soma_bullet.task.schedule import APPROACH, LIFT, Assignment, Schedule, Scheduler
from soma_bullet.task.workcell import TABLE, Hands, Workcell

Kind = Literal["transit", "approach", "grasp", "lift", "transfer", "insert", "place", "settle", "release", "retreat", "home"]

DT = 1 / 480  # [s] between samples of a trajectory: the simulator's step
CHECK_EVERY = 0.010  # [s] between collision checks on the timed trajectory
PLACE = 0.010  # [m] of the insertion that is slow and guarded
GUARD = 1.0  # [N] change of the wrist's force that ends a placing
SETTLE = 0.2  # [s] after a placing
CLOSING, OPENING_TIME = 0.5, 0.4  # [s] for the hand to grip, and to let go
SPEEDS = {
    "approach": HandLimits(0.15, 0.5),
    "lift": HandLimits(0.10, 0.3),
    "insert": HandLimits(0.10, 0.3),
    "place": HandLimits(0.010, 0.03),
    "retreat": HandLimits(0.15, 0.3),
}  # [m/s], [m/s2]
FINGER_STEP = 0.004  # [m] of one finger; none is thinner
MOTIONS = ("transit", "approach", "lift", "transfer", "insert", "place", "retreat", "home")
EDGE_STEPS = (0.02, 0.004, 0.004, 0.004, 0.004)  # [rad] between checked states of an edge, one for each attempt
CARRYING = 0.6  # of the joint limits while a hand carries a piece
SMALLEST_JUMP = 1e-4  # [rad] a segment that starts farther from the measured joints is made anew


@dataclass(frozen=True, eq=False)
class Segment:
    """One thing that one arm does while the other stands still.

    Attributes:
        kind: what it is; `transit`, `transfer`, `home` go around obstacles; `grasp`, `settle`, `release` are waits.
        step: of the plan; arm: index; piece: what it is about.
        path: joints every DT (n, 6) [rad]; empty for waits.
        offset: straight travel of the hand (3,) [m] for lines, else zero.
        opening: distance between the pads [m] that the hand goes to, or NaN to leave it as it is.
        duration: [s] of waits.
        guard: change of the wrist's force [N] that ends the segment, 0 for none.
    """

    kind: Kind
    step: int
    arm: int
    piece: str
    path: Array
    offset: Array
    opening: float
    duration: float
    guard: float

    @property
    def seconds(self) -> float:
        """Planned duration [s]."""
        return max(self.duration, (len(self.path) - 1) * DT if len(self.path) else 0.0)


@dataclass(frozen=True, eq=False)
class Program:
    """What the cell executes.

    Attributes:
        cell, assembly, digest: names and content hash of the input.
        seed: of everything random.
        order: of the plan.
        feed: where the pieces are at the start.
        schedule: who does what.
        segments: in the order of execution.
        T_world_assembly: (4, 4).
        stand: footprint of the stand [m].
    """

    cell: str
    assembly: str
    digest: str
    seed: int
    order: tuple[str, ...]
    feed: Feed
    schedule: Schedule
    segments: tuple[Segment, ...]
    T_world_assembly: Array
    stand: tuple[float, float]

    @property
    def makespan(self) -> float:
        """Planned duration [s]."""
        return sum(segment.seconds for segment in self.segments)


class MotionError(Exception):
    """A motion of one assignment cannot be made."""

    def __init__(self, assignment: Assignment, reason: str):
        super().__init__(reason)
        self.assignment, self.reason = assignment, reason


def make_program(
    workcell: Workcell, plan: AssemblyPlan, feed: Feed, seed: int, progress: Callable[[str], None] | None = None
) -> Program:
    """Schedule and trajectories of a plan.

    A motion that cannot be found rules out exactly its step, arm and grasp, and the search of the schedule goes on.

    Raises:
        NoSolutionError: with what blocked, most frequent first.
    """
    scheduler = Scheduler(workcell, plan, feed)
    while True:
        schedule = scheduler.find()
        try:
            segments = tuple(ProgramBuilder(workcell, plan, feed, schedule, seed).segments())
        except MotionError as error:
            a = error.assignment
            scheduler.excluded.add((a.step, a.arm, a.grasp))
            scheduler.rejections[error.reason] += 1
            if progress is not None:
                progress(error.reason)
            continue
        return Program(
            workcell.cell.name, workcell.assembly.name, workcell.assembly.digest, seed, plan.order, feed, schedule, segments,
            workcell.T_world_assembly, workcell.robot.stand_size,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Context:
    """Where pieces and hands are when a segment starts."""

    poses: dict[str, Array]
    hands: Hands
    carried: tuple[str, Array] | None = None
    touching: frozenset[frozenset[str]] = frozenset()


class ProgramBuilder:
    """Makes the segments of one schedule; raises MotionError at the first motion that cannot be made."""

    def __init__(self, workcell: Workcell, plan: AssemblyPlan, feed: Feed, schedule: Schedule, seed: int):
        self.workcell, self.plan, self.feed, self.schedule, self.seed = workcell, plan, feed, schedule, seed
        self.count = 0

    def segments(self) -> Iterator[Segment]:
        poses = {name: self.feed.pose(name) for name in self.feed.names}
        hands = self.workcell.idle()
        for k, assignment in enumerate(self.schedule.assignments):
            following = self.schedule.assignments[k + 1] if k + 1 < len(self.schedule.assignments) else None
            for segment, context in self._step(assignment, following, poses, hands):
                poses, hands = context.poses, context.hands
                yield segment

    def _step(
        self, a: Assignment, following: Assignment | None, poses: dict[str, Array], hands: Hands
    ) -> Iterator[tuple[Segment, _Context]]:
        """Segments of one assignment, each with the context after it."""
        cell, arm, piece = self.workcell, a.arm, a.piece
        up, tool = np.array([0.0, 0.0, 1.0]), cell.robot.tcp(arm, a.q_pick)[:3, 2]
        opened = a.width + 2 * OPENING
        grasp = grasp_poses(self.plan, piece)[0][a.grasp]
        carried = (piece, inverse(grasp))
        meant = frozenset(p for p in cell.touching if piece in p)

        def moved(q: Array, width: float, gripping: bool = True) -> Hands:
            return hands.with_arm(arm, q, width).gripping(arm, piece if gripping else None)

        before = _Context(poses, hands)
        yield self._transit(a, "transit", before, a.q_before, opened), _Context(poses, moved(a.q_before, opened, False))
        at = _Context(poses, moved(a.q_before, opened))
        yield self._line(a, "approach", at, a.q_before, tool * APPROACH), _Context(poses, moved(a.q_pick, opened))
        yield self._wait(a, "grasp", arm, piece, CLOSING, 0.0), _Context(poses, moved(a.q_pick, a.width))
        lifting = _Context(poses, moved(a.q_pick, a.width), carried, frozenset({frozenset({piece, TABLE})}))
        yield self._line(a, "lift", lifting, a.q_pick, up * LIFT), _Context(poses, moved(a.q_lifted, a.width))
        carrying = _Context(poses, moved(a.q_lifted, a.width), carried, meant)
        yield self._transit(a, "transfer", carrying, a.q_ready, a.width), _Context(poses, moved(a.q_ready, a.width))
        first = self._line(
            a, "insert", _Context(poses, moved(a.q_ready, a.width), carried, meant), a.q_ready, a.direction * (a.length - PLACE)
        )
        q_near = first.path[-1]
        yield first, _Context(poses, moved(q_near, a.width))
        placed = {**poses, piece: cell.settled[piece]}
        yield (
            self._line(a, "place", _Context(poses, moved(q_near, a.width), carried, meant), q_near, a.direction * PLACE),
            _Context(placed, moved(a.q_goal, a.width)),
        )
        hands = moved(a.q_goal, a.width)
        yield self._wait(a, "settle", arm, piece, SETTLE, np.nan), _Context(placed, hands)
        for release in a.releases:
            opening = hands.openings[release.arm] + 2 * OPENING
            hands = hands.with_arm(release.arm, hands.qs[release.arm], opening)
            yield self._wait(a, "release", release.arm, release.piece, OPENING_TIME, opening), _Context(placed, hands)
            away = -cell.robot.tcp(release.arm, hands.qs[release.arm])[:3, 2]
            retreat = self._line(
                a, "retreat", _Context(placed, hands), hands.qs[release.arm], away * APPROACH, release.arm, release.piece
            )
            hands = hands.with_arm(release.arm, retreat.path[-1]).gripping(release.arm, None)
            yield retreat, _Context(placed, hands)
        for release in a.releases:
            if following is None or following.arm != release.arm:
                home = cell.robot.home[release.arm]
                segment = self._transit(a, "home", _Context(placed, hands), home, 0.0, release.arm, release.piece)
                hands = hands.with_arm(release.arm, home, 0.0)
                yield segment, _Context(placed, hands)

    def _scene(self, context: _Context, arm: int) -> Scene:
        return self.workcell.scene(context.poses, context.hands, arm, context.carried, context.touching)

    def _transit(
        self,
        a: Assignment,
        kind: Kind,
        context: _Context,
        goal: Array,
        opening: float,
        arm: int | None = None,
        piece: str | None = None,
    ) -> Segment:
        """A motion around obstacles; the hand opens or closes on the way, and every width between must be free all along."""
        arm, piece = a.arm if arm is None else arm, a.piece if piece is None else piece
        self.count += 1
        widths = widths_between(float(context.hands.openings[arm]), opening)
        try:
            path = plan_motion(
                self.workcell,
                self._scene(context, arm),
                context.hands,
                arm,
                context.hands.qs[arm],
                goal,
                widths,
                self.seed + 1000 * self.count,
            )
        except TransferError as error:
            raise MotionError(a, f"{piece}: {kind}: {self._blame(error, context, arm, float(widths.max()))}") from None
        except TimingError as error:
            raise MotionError(a, f"{piece}: {kind}: {error}") from None
        opening = np.nan if kind == "transfer" else opening  # keep squeezing
        return Segment(kind, a.step, arm, piece, readonly(path), readonly(np.zeros(3)), opening, 0.0, 0.0)

    def _blame(self, error: TransferError, context: _Context, arm: int, width: float) -> str:
        if error.q is None:
            return "no path within the budget"
        configuration = self.workcell.configuration(context.hands, arm, error.q, width)
        pair = self._scene(context, arm).first_collision(configuration)
        return f"{error.cause} in collision" + (f": {pair[0]} meets {pair[1]}" if pair else "")

    def _line(
        self,
        a: Assignment,
        kind: Kind,
        context: _Context,
        q_start: Array,
        offset: Array,
        arm: int | None = None,
        piece: str | None = None,
    ) -> Segment:
        arm, piece = a.arm if arm is None else arm, a.piece if piece is None else piece
        try:
            path = line_motion(self.workcell, self._scene(context, arm), context.hands, arm, q_start, offset, SPEEDS[kind])
        except (LineError, TimingError) as error:
            raise MotionError(a, f"{piece}: {kind}: {error}") from None
        guard = GUARD if kind == "place" else 0.0
        return Segment(kind, a.step, arm, piece, readonly(path), readonly(offset), np.nan, 0.0, guard)

    def _wait(self, a: Assignment, kind: Kind, arm: int, piece: str, duration: float, opening: float) -> Segment:
        return Segment(kind, a.step, arm, piece, readonly(np.zeros((0, 6))), readonly(np.zeros(3)), opening, duration, 0.0)


def widths_between(first: float, last: float) -> Array:
    """Widths [m] of a hand that opens or closes, so close that what fits between two of them is thinner than a finger."""
    return np.linspace(first, last, 1 + int(np.ceil(abs(last - first) / 2 / FINGER_STEP)))


def plan_motion(
    workcell: Workcell, scene: Scene, hands: Hands, arm: int, start: Array, goal: Array, widths: Array, seed: int
) -> Array:
    """Timed joints (n, 6) around obstacles, free at every one of the hand's widths [m]. Raises TransferError, TimingError."""
    limits = workcell.robot.arm(arm)
    gentle = CARRYING if scene.situation.carried else 1.0
    collides = lambda q: any(scene.collides(workcell.configuration(hands, arm, q, width)) for width in widths)  # noqa: E731
    for attempt, step in enumerate(EDGE_STEPS):
        options = TransferOptions(seed=seed + 7919 * attempt, step=step)
        waypoints = plan_transfer(start, np.array([goal]), limits.lower, limits.upper, collides, options)
        dense = blend_corners(waypoints, collides)
        samples = time_path(dense, gentle * limits.velocity, gentle * limits.acceleration, DT)
        try:
            _check(samples, collides)
        except TimingError:
            if attempt + 1 == len(EDGE_STEPS):
                raise
            continue  # it grazes something between two checked states: look more closely, and elsewhere
        break
    return samples


def line_motion(
    workcell: Workcell, scene: Scene, hands: Hands, arm: int, start: Array, offset: Array, limits: HandLimits
) -> Array:
    """Timed joints (n, 6) along a straight line of the hand. Raises LineError, TimingError."""
    path, travel = sample_line(workcell.robot, arm, start, offset)
    joints = workcell.robot.arm(arm)
    samples = time_path(path, joints.velocity, joints.acceleration, DT, travel, limits)
    _check(samples, lambda q: scene.collides(workcell.configuration(hands, arm, q)))
    return samples


def _check(samples: Array, collides: Callable[[Array], bool]) -> None:
    stride = max(1, int(CHECK_EVERY / DT))
    for q in [*samples[::stride], samples[-1]]:
        if collides(q):
            raise TimingError("the timed trajectory collides")


def replan(workcell: Workcell, plan: AssemblyPlan, program: Program, index: int, qs: Array) -> Segment:
    """One motion segment of the program made anew from measured joints qs (arms, 6): a line as a line, else to the same end.

    Raises:
        NoSolutionError: it cannot be made from there.
    """
    segment = program.segments[index]
    context = _context_before(workcell, plan, program, index, qs)
    scene = workcell.scene(context.poses, context.hands, segment.arm, context.carried, context.touching)
    start = qs[segment.arm]
    try:
        if segment.kind in SPEEDS:
            path = line_motion(workcell, scene, context.hands, segment.arm, start, segment.offset, SPEEDS[segment.kind])
        else:
            now = float(context.hands.openings[segment.arm])
            widths = widths_between(now, now if np.isnan(segment.opening) else segment.opening)
            goal, seed = segment.path[-1], program.seed + index
            path = plan_motion(workcell, scene, context.hands, segment.arm, start, goal, widths, seed)
    except (LineError, TransferError, TimingError) as error:
        reason = f"{segment.piece}: {segment.kind} cannot be made from the measured joints: {error}"
        raise NoSolutionError("motion", reason) from None
    return replace(segment, path=readonly(path))


def _context_before(workcell: Workcell, plan: AssemblyPlan, program: Program, index: int, qs: Array) -> _Context:
    """Where the program expects pieces and hands before a segment, with the arms where they were measured."""
    poses = {name: program.feed.pose(name) for name in program.feed.names}
    hands = workcell.idle()
    carried: dict[int, tuple[str, Array]] = {}
    for segment in program.segments[:index]:
        arm, piece = segment.arm, segment.piece
        if segment.kind == "approach":
            hands = hands.gripping(arm, piece)
        elif segment.kind == "grasp":
            assignment = next(a for a in program.schedule.assignments if a.step == segment.step)
            hands = hands.with_arm(arm, hands.qs[arm], assignment.width)
            carried[arm] = (piece, inverse(grasp_poses(plan, piece)[0][assignment.grasp]))
        elif segment.kind == "settle":
            poses = {**poses, piece: workcell.settled[piece]}
            carried.pop(arm, None)
        elif segment.kind == "retreat":
            hands = hands.gripping(arm, None)
        if not np.isnan(segment.opening) and segment.kind != "grasp":
            hands = hands.with_arm(arm, hands.qs[arm], segment.opening)
    segment = program.segments[index]
    if segment.kind == "approach":
        hands = hands.gripping(segment.arm, segment.piece)
    touching = frozenset(p for p in workcell.touching if segment.piece in p)
    if segment.kind == "lift":
        touching = frozenset({frozenset({segment.piece, TABLE})})
    return _Context(poses, replace(hands, qs=np.array(qs)), carried.get(segment.arm), touching)
