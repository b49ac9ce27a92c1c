"""Builds a program: the actions of a schedule turned into segments, each a timed trajectory or a hand
command, with guards."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest

import numpy as np

from soma_bullet.frames import Array, apply, readonly
from soma_bullet.motion.line import LineError
from soma_bullet.motion.timing import TimingError
from soma_bullet.motion.transfer import TransferError
from soma_bullet.robot.collision import Scene
from soma_bullet.seeds import derived
from soma_bullet.sizes import CLEAR
from soma_bullet.task.actions.action import Action, Step, Steps, alike
from soma_bullet.task.actions.go_home import GoHome
from soma_bullet.task.actions.hand_over import HandOver
from soma_bullet.task.actions.release import Release, leave
from soma_bullet.task.feed import Feed
from soma_bullet.task.kinds import HOME, LIFT, RETREAT, Kind, as_planned
from soma_bullet.task.limits import Effort
from soma_bullet.task.program.motions import plan_motion, scene_of, straight_motion, widths_to
from soma_bullet.task.program.program import Moment, beginning
from soma_bullet.task.schedule import Assignment, Schedule
from soma_bullet.task.segment import DOWN, LEVEL, NO_PATH, SMALLEST_JUMP, STEEP, UP, Segment
from soma_bullet.task.state import CellState
from soma_bullet.task.workcell import Workcell

WORTH = 10  # lines of hands that take about as long as a motion
DAMPING = 0.01  # of the inverse Jacobian: near a singularity a hand gives way less, and no joint moves far


class MotionError(Exception):
    """A motion of one action cannot be made; the assignment is None where it comes before all of them."""

    def __init__(self, reason: str, assignment: Assignment | None = None, action: Action | None = None):
        super().__init__(reason)
        self.reason, self.assignment, self.action = reason, assignment, action


@dataclass(frozen=True, eq=False)
class Made:
    """An action, its segments with the states around them, and how many motions there were until then."""

    action: Action
    moments: tuple[Moment, ...]
    count: int


class ProgramBuilder:
    """Makes the segments of one schedule; raises MotionError at the first motion that cannot be made.

    Args:
        seed: of the motions; start: a state as found, to go on from.
        earlier: what was made of an earlier schedule from the beginning: as far as the actions are the same,
            their segments are taken over.
        effort: is told of every motion that is made.

    Attributes:
        made: action by action, from the beginning.
    """

    def __init__(
        self,
        workcell: Workcell,
        feed: Feed,
        schedule: Schedule,
        seed: int,
        start: CellState | None = None,
        earlier: Sequence[Made] = (),
        effort: Effort | None = None,
    ):
        self.workcell, self.schedule, self.seed, self.start = workcell, schedule, seed, start
        self.count, self.effort = 0, effort or Effort()
        self.made: list[Made] = []
        self._earlier = list(earlier) if start is None else []
        self.state = self.beginning = beginning(workcell, feed, start)
        self.step: int | None = None

    def run(self) -> Iterator[Moment]:
        """Every segment with the states before and after it, in an order in which they can run one at a
        time."""
        self.count, self.state, self.step = 0, self.beginning, None
        if self.start is not None:
            yield from self._get_ready(self.start)
        assignments = self.schedule.assignments
        for a, following in zip_longest(assignments, assignments[1:]):
            self.step = a.step
            for n, action in enumerate(a.actions):
                try:
                    yield from self.perform(action)
                    for arm, piece in self._idle_after(a, n, following):
                        yield from self.perform(GoHome(arm, piece))
                except MotionError as error:
                    raise MotionError(error.reason, a, action) from None

    def _idle_after(self, a: Assignment, n: int, following: Assignment | None) -> list[tuple[int, str]]:
        """Arms that go home after an action of a step, and from what: those that have let go and are not to
        act next."""
        action, actions = a.actions[n], a.actions
        if n < len(a.bring):
            goes = action.regrasps and (isinstance(action, HandOver) or actions[n + 1].arm != action.arm)
            return [(action.arm, action.piece)] if goes else []
        if n + 1 < len(actions):
            return []
        first = following.actions[0].arm if following is not None else None
        idle = [r for r in a.releases if r.arm not in self.state.gripped and r.arm != first]
        return [(release.arm, release.piece) for release in idle]

    def perform(self, action: Action) -> Iterator[Moment]:
        """The segments of an action, from the state after those before. Raises MotionError."""
        n = len(self.made)
        if n < len(self._earlier) and alike(self._earlier[n].action, action):
            known = self._earlier[n]
            self.made.append(known)
            self.count = known.count
            for moment in known.moments:
                self.state = moment[2]
                yield moment
            return
        self._earlier = []  # what follows starts from elsewhere
        moments: list[Moment] = []
        for moment in self._follow(action.steps(self.workcell, self.state)):
            moments.append(moment)
            yield moment
        self.made.append(Made(action, tuple(moments), self.count))

    def _follow(self, steps: Steps) -> Iterator[Moment]:
        try:
            step = next(steps)
            while True:
                yield self._make(step)
                step = steps.send(self.state)
        except StopIteration:
            return

    # --- from a state as found -----------------------------------------------------------------------------

    def _get_ready(self, start: CellState) -> Iterator[Moment]:
        """Holds change as they must, idle arms go home, those that carry a piece get clear of what it
        touches."""
        for arm in start.free:
            yield from self._clear_away(arm)
        for action in self.schedule.changes:
            yield from self.perform(action)
        for action in self.schedule.changes:
            if isinstance(action, Release):
                yield from self._clear_away(action.arm)
        for arm in sorted(start.carried):
            if self._touched(arm) is not None:
                yield self._back_out(arm, start.gripped[arm])

    def _clear_away(self, arm: int) -> Iterator[Moment]:
        """An arm that has nothing goes home; from a piece it first goes straight back, opening the hand if
        that is needed."""
        home, state = self.workcell.robot.home[arm], self.state
        if arm in state.gripped or np.abs(state.qs[arm] - home).max() < SMALLEST_JUMP:
            return
        T = self.workcell.robot.tcp(arm, state.qs[arm])
        near = min(state.poses, key=lambda n: float(np.linalg.norm(self._centre(n) - T[:3, 3])))
        going = Step(HOME, arm, near, home, opening=0.0)
        if self._touched(arm) is None:
            try:
                yield self._make(going)
                return
            except MotionError:  # the hand closes on the way, and there may be a piece between its fingers
                pass
        away = -T[:3, 2] * self.workcell.hand(arm).way_out
        try:
            yield self._make(Step(RETREAT, arm, near, offset=away))
        except MotionError:
            yield from self._follow(leave(self.workcell, self.state, arm, near, None))
        yield self._make(going)

    def _centre(self, piece: str) -> Array:
        return apply(self.state.poses[piece], self.workcell.body(piece).center_of_mass)

    def _touched(self, arm: int) -> str | None:
        """A piece that the hand of an arm, or the piece in it, is too near to; the name of anything else if
        there is none."""
        state = self.state
        scene = self.workcell.scene(state, arm)
        pairs = scene.colliding(self.workcell.configuration(state, arm, state.qs[arm]))
        names = [name for pair in pairs for name in pair[:2] if name in state.poses]
        mine = state.gripped.get(arm)
        return next((name for name in names if name != mine), names[0] if names else None)

    def _back_out(self, arm: int, piece: str) -> Moment:
        """A carried piece that touches something goes back the way it came, or up; what it touches meanwhile
        is left out."""
        reason = ""
        back = [a.insert.way.sweep()[-1] for a in self.schedule.assignments[:1] if a.piece == piece]
        for offset in (*back, UP * self.workcell.sizes.lift):
            try:
                return self._make(Step(LIFT, arm, piece, offset=offset), loose=True)
            except MotionError as error:
                reason = error.reason
        raise MotionError(reason)

    # --- one segment ---------------------------------------------------------------------------------------

    def _make(self, step: Step, loose: bool = False) -> Moment:
        """The segment of a step, from the state as it is; `loose`: without the piece."""
        kind, arm, piece = step.kind, step.arm, step.piece
        before = kind.before(self.state, arm, piece)
        if kind.way == "wait":
            path = NO_PATH
        else:
            self.effort.lines += WORTH
            path = readonly(self._around(step, before) if kind.around else self._line(step, before, loose))
        segment = Segment(
            kind,
            self.step,
            arm,
            piece,
            path,
            readonly(step.offset),
            step.opening,
            step.duration,
            width=step.width,
        )
        segment = guarded(self.workcell, segment, before, step.bears)
        self.state = as_planned(self.workcell, self.state, segment)
        return before, segment, self.state

    def _around(self, step: Step, before: CellState) -> Array:
        """A motion around obstacles; the hand opens or closes on the way, and every width between must be
        free all along."""
        self.count += 1
        kind, arm, piece = step.kind, step.arm, step.piece
        assert step.q_end is not None
        widths, scene = widths_to(before, arm, step.opening), self._scene(before, kind, arm, piece)
        start, seed = before.qs[arm], derived(self.seed, "motion", self.count)
        try:
            return plan_motion(self.workcell, scene, before, arm, start, step.q_end, widths, seed)
        except TransferError as error:
            blamed = self._blame(error, scene, before, arm, float(widths.max()))
            raise MotionError(f"{piece}: {kind}: {blamed}") from None
        except TimingError as error:
            raise MotionError(f"{piece}: {kind}: {error}") from None

    def _line(self, step: Step, before: CellState, loose: bool) -> Array:
        kind, arm, piece = step.kind, step.arm, step.piece
        seen = before
        if loose:
            seen = replace(before, carried={}, poses={n: T for n, T in before.poses.items() if n != piece})
        scene = self._scene(seen, kind, arm, piece)
        try:
            return straight_motion(
                self.workcell, scene, before, arm, before.qs[arm], np.asarray(step.offset), kind
            )
        except (LineError, TimingError) as error:
            raise MotionError(f"{piece}: {kind}: {error}") from None

    def _scene(self, state: CellState, kind: Kind, arm: int, piece: str) -> Scene:
        return scene_of(self.workcell, state, kind, arm, piece)

    def _blame(self, error: TransferError, scene: Scene, before: CellState, arm: int, width: float) -> str:
        if error.q is None:
            return "no path within the budget"
        configuration = self.workcell.configuration(before, arm, error.q, width)
        met = f": {' meets '.join(scene.met)}" if scene.collides(configuration) else ""
        return f"{error.cause} in collision{met}"


def guarded(workcell: Workcell, segment: Segment, before: CellState, bears: float) -> Segment:
    """A segment with its guard and its compliance, where it has them.

    A placing ends by touch downwards only. Sideways it ends where it should: what it would have to meet there
    is pushed away.

    Args:
        bears: force [N] with which the piece may press on what it meets.
    """
    if not segment.kind.guarded:
        return segment
    end = segment.path[-1] if len(segment.path) else before.qs[segment.arm]
    jacobian = workcell.robot.jacobian(segment.arm, end)
    compliance = jacobian.T @ np.linalg.inv(jacobian @ jacobian.T + DAMPING**2 * np.eye(6))
    sizes = workcell.sizes
    segment = replace(segment, raised=_raised(workcell, segment, before))
    stopped = segment.kind.ends != "goal" or (
        float(segment.last_way @ DOWN) > LEVEL
        and workcell.stopped(segment.piece, segment.last_way, before.placed)
    )
    return replace(
        segment,
        guard=min(sizes.guard, max(sizes.touch, bears)),
        compliance=readonly(compliance),
        beyond=sizes.beyond if stopped else 0.0,
    )


def _raised(workcell: Workcell, segment: Segment, before: CellState) -> float:
    """How far above its path a guarded line brings its piece [m]."""
    if LEVEL < segment.downward < STEEP:
        return workcell.sizes.fall
    if segment.kind.ends != "goal" or abs(segment.downward) > LEVEL:
        return 0.0
    if not workcell.stopped(segment.piece, DOWN, before.placed):
        return 0.0
    if workcell.stopped(segment.piece, UP, before.placed):  # between what carries it and a roof
        return float(workcell.assembly.drops[workcell.assembly.index(segment.piece)])
    return CLEAR
