"""Builds a program: a schedule turned into segments, each a timed trajectory or a hand command, with
guards."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import zip_longest

import numpy as np

from soma_bullet.frames import Array, apply, readonly
from soma_bullet.grasp.clearance import OPENING
from soma_bullet.motion.line import LineError
from soma_bullet.motion.timing import TimingError
from soma_bullet.motion.transfer import TransferError
from soma_bullet.robot.collision import Scene
from soma_bullet.task.assignments import (
    Assignment,
    Pick,
    PutDown,
    Regrasp,
    Release,
    Schedule,
    Square,
    Start,
    Take,
)
from soma_bullet.task.feed import Feed
from soma_bullet.task.motions import plan_motion, straight_motion, widths_between
from soma_bullet.task.segments import (
    BEYOND,
    CLOSING,
    FOLLOWING,
    GUARD,
    GUARDED,
    OPENING_TIME,
    PLACE,
    SETTLE,
    SMALLEST_JUMP,
    Context,
    Kind,
    Segment,
    beginning,
    entering,
    leaving,
)
from soma_bullet.task.tracing import APPROACH, LIFT
from soma_bullet.task.workcell import Workcell

DAMPING = 0.01  # of the inverse Jacobian: near a singularity a hand gives way less, and no joint moves far
Who = tuple[int, str]  # an arm, and the piece that it is about
Made = tuple[Context, Segment, Context]  # a segment with the contexts before and after it
NONE = readonly(np.zeros(3))
NO_PATH = readonly(np.zeros((0, 6)))
UP = readonly((0.0, 0.0, 1.0))


class MotionError(Exception):
    """A motion of one assignment cannot be made; of none where it comes before all of them."""

    def __init__(self, assignment: Assignment | None, reason: str, regrasp: Regrasp | None = None):
        super().__init__(reason)
        self.assignment, self.reason, self.regrasp = assignment, reason, regrasp


class ProgramBuilder:
    """Makes the segments of one schedule; raises MotionError at the first motion that cannot be made."""

    def __init__(
        self,
        workcell: Workcell,
        feed: Feed,
        schedule: Schedule,
        seed: int,
        start: Start | None = None,
        order: Sequence[str] = (),
    ):
        self.workcell, self.schedule, self.seed, self.start = workcell, schedule, seed, start
        self.count = 0
        self.context = self.beginning = beginning(workcell, feed, start, order)

    def run(self) -> Iterator[Made]:
        """Every segment with the contexts before and after it, in an order in which they can run one at a
        time."""
        self.count, self.context = 0, self.beginning
        if self.start is not None:
            yield from self._get_ready(self.start)
        for a, following in zip_longest(self.schedule.assignments, self.schedule.assignments[1:]):
            for n, regrasp in enumerate(a.regrasps):
                try:
                    yield from self._regrasp(a, regrasp, _arm_after(a, n))
                except MotionError as error:
                    raise MotionError(a, error.reason, regrasp) from None
            if not a.in_hand:
                yield from self._fetch(
                    a, Pick(a.piece, a.arm, a.grasp, a.width, a.opened, a.q_before, a.q_pick, a.q_lifted)
                )
            yield from self._insert(a)
            yield from self._let_go(a, following)

    def _get_ready(self, start: Start) -> Iterator[Made]:
        """Holds change as they must, idle arms go home, those that carry a piece get clear of what it
        touches."""
        idle = [arm for arm in range(len(self.workcell.robot.home)) if arm not in self.context.hands.gripped]
        for arm in idle:
            yield from self._clear_away(arm)
        yield from self._change_holds(None, self.schedule.takes, self.schedule.releases)
        for release in self.schedule.releases:
            yield from self._clear_away(release.arm)
        for carried in start.carrying:
            if self._touched(carried.arm) is not None:
                yield self._back_out(carried.arm, carried.piece)

    def _clear_away(self, arm: int) -> Iterator[Made]:
        """An arm that has nothing goes home; from a piece it first goes straight back, opening the hand if
        that is needed."""
        home, hands = self.workcell.robot.home[arm], self.context.hands
        if arm in hands.gripped or np.abs(hands.qs[arm] - home).max() < SMALLEST_JUMP:
            return
        T = self.workcell.robot.tcp(arm, hands.qs[arm])
        who = (arm, min(self.context.poses, key=lambda n: float(np.linalg.norm(self._centre(n) - T[:3, 3]))))
        if self._touched(arm) is None:
            try:
                yield self._around(None, "home", home, 0.0, who)
                return
            except MotionError:  # the hand closes on the way, and there may be a piece between its fingers
                pass
        try:
            yield self._line(None, "retreat", -T[:3, 2] * APPROACH, who)
        except MotionError:
            yield from self._leave(None, who)
        yield self._around(None, "home", home, 0.0, who)

    def _centre(self, piece: str) -> Array:
        assembly = self.workcell.assembly
        return apply(self.context.poses[piece], assembly.pieces[assembly.index(piece)].center_of_mass)

    def _touched(self, arm: int) -> str | None:
        """A piece that the hand of an arm, or the piece in it, is too near to; the name of anything else if
        there is none."""
        hands = self.context.hands
        scene = scene_of(self.workcell, self.context, arm)
        pairs = scene.colliding(self.workcell.configuration(hands, arm, hands.qs[arm]))
        names = [name for pair in pairs for name in pair[:2] if name in self.context.poses]
        return next((name for name in names if name != hands.gripped.get(arm)), names[0] if names else None)

    def _back_out(self, arm: int, piece: str) -> Made:
        """A carried piece that touches something goes back the way it came, or up; what it touches meanwhile
        is left out."""
        reason = ""
        back = [-a.direction * a.length for a in self.schedule.assignments[:1] if a.piece == piece]
        for offset in (*back, UP * LIFT):
            try:
                return self._line(None, "lift", offset, (arm, piece), loose=True)
            except MotionError as error:
                reason = error.reason
        raise MotionError(None, reason)

    def _fetch(self, a: Assignment, pick: Pick) -> Iterator[Made]:
        """From wherever the arm is to the piece in the air."""
        yield from self._take(a, (pick.arm, pick.piece), pick.q_before, pick.q_pick, pick.width, pick.opened)
        yield self._line(a, "lift", UP * LIFT, (pick.arm, pick.piece))

    def _take(
        self,
        a: Assignment | None,
        who: Who,
        q_before: Array,
        q_grasp: Array,
        width: float,
        opened: float | None = None,
    ) -> Iterator[Made]:
        """From wherever the arm is to the hand closed on a piece, wherever that is."""
        yield self._around(a, "transit", q_before, width + 2 * OPENING if opened is None else opened, who)
        yield self._line(a, "approach", self._tool(who[0], q_grasp) * APPROACH, who)
        yield self._wait(a, "grasp", CLOSING, 0.0, who, width)

    def _leave(self, a: Assignment | None, who: Who) -> Iterator[Made]:
        """A hand opens and goes straight back; between the two, what others hold on its piece comes down onto
        that."""
        hands = self.context.hands
        widest = self.workcell.robot.arm(who[0]).hand.opening
        yield self._wait(
            a, "release", OPENING_TIME, min(float(hands.openings[who[0]]) + 2 * OPENING, widest), who
        )
        for arm, held in sorted(self.context.hands.gripped.items()):
            if (
                arm != who[0]
                and {who[1], held} <= self.context.placed
                and self.workcell.carries(who[1], held)
            ):
                yield self._wait(a, "follow", FOLLOWING, np.nan, (arm, held))
        yield self._line(a, "retreat", -self._tool(who[0], hands.qs[who[0]]) * APPROACH, who)

    def _tool(self, arm: int, q: Array) -> Array:
        return self.workcell.robot.tcp(arm, q)[:3, 2]

    def _regrasp(self, a: Assignment, regrasp: Regrasp, following: int) -> Iterator[Made]:
        """What comes before the last pick; an arm that is not the one to act next goes home."""
        who = (regrasp.arm, regrasp.piece)
        if isinstance(regrasp, Square):
            yield from self._take(a, who, regrasp.q_before, regrasp.q_grasp, regrasp.width, regrasp.opened)
            yield from self._leave(a, who)
            return
        if regrasp.pick is not None:
            yield from self._fetch(a, regrasp.pick)
        if isinstance(regrasp, PutDown):
            yield self._around(a, "transfer", regrasp.q_over, who=who)
            yield self._line(a, "lower", -UP * (LIFT - PLACE), who)
            yield self._line(a, "set_down", -UP * PLACE, who)
            yield self._wait(a, "settle", SETTLE, np.nan, who)
            yield from self._leave(a, who)
            if regrasp.arm == following:
                return
        else:
            yield self._around(a, "transfer", regrasp.q_meet, who=who)
            yield from self._take(
                a, (regrasp.receiver, regrasp.piece), regrasp.q_before, regrasp.q_take, regrasp.width
            )
            yield from self._leave(a, who)
        yield self._around(a, "home", self.workcell.robot.home[regrasp.arm], 0.0, who)

    def _insert(self, a: Assignment) -> Iterator[Made]:
        """From the piece in the air to the piece in place, still in the hand."""
        yield self._around(a, "transfer", a.q_ready)
        yield self._line(a, "insert", a.direction * (a.length - a.guarded))
        yield self._line(a, "place", a.direction * a.guarded)
        yield self._wait(a, "settle", SETTLE, np.nan)

    def _let_go(self, a: Assignment, following: Assignment | None) -> Iterator[Made]:
        """The releases and takes of a step; an arm that is not needed next goes home."""
        yield from self._change_holds(a, a.takes, a.releases)
        for release in a.releases:
            busy = release.arm in self.context.hands.gripped
            if not busy and (following is None or first_arm(following) != release.arm):
                yield self._around(
                    a, "home", self.workcell.robot.home[release.arm], 0.0, (release.arm, release.piece)
                )

    def _change_holds(
        self, a: Assignment | None, takes: Sequence[Take], releases: Sequence[Release]
    ) -> Iterator[Made]:
        for n in range(len(releases) + 1):
            for take in takes:
                if take.after == n:
                    yield from self._take(a, (take.arm, take.piece), take.q_before, take.q_hold, take.width)
            if n < len(releases):
                yield from self._leave(a, (releases[n].arm, releases[n].piece))

    # --- one segment ----------------------------------------------------------------------------------------

    def _about(self, a: Assignment | None, who: Who | None) -> tuple[int, int, str]:
        """Step, arm and piece of a segment."""
        if a is not None:
            return a.step, *(who or (a.arm, a.piece))
        assert who is not None and self.start is not None
        return self.start.step - 1, *who

    def _add(self, before: Context, segment: Segment) -> Made:
        self.context = leaving(self.workcell, before, segment)
        return before, segment, self.context

    def _around(
        self, a: Assignment | None, kind: Kind, goal: Array, opening: float = np.nan, who: Who | None = None
    ) -> Made:
        """A motion around obstacles; the hand opens or closes on the way, and every width between must be
        free all along."""
        step, arm, piece = self._about(a, who)
        self.count += 1
        context = entering(self.workcell, self.context, kind, arm, piece)
        widths = widths_to(context, arm, opening)
        scene, start = scene_of(self.workcell, context, arm), context.hands.qs[arm]
        try:
            path = plan_motion(
                self.workcell, scene, context.hands, arm, start, goal, widths, self.seed + 1000 * self.count
            )
        except TransferError as error:
            raise MotionError(
                a, f"{piece}: {kind}: {self._blame(error, context, arm, float(widths.max()))}"
            ) from None
        except TimingError as error:
            raise MotionError(a, f"{piece}: {kind}: {error}") from None
        return self._add(context, Segment(kind, step, arm, piece, readonly(path), NONE, opening, 0.0, 0.0))

    def _blame(self, error: TransferError, context: Context, arm: int, width: float) -> str:
        if error.q is None:
            return "no path within the budget"
        configuration = self.workcell.configuration(context.hands, arm, error.q, width)
        scene = scene_of(self.workcell, context, arm)
        return f"{error.cause} in collision" + (
            f": {' meets '.join(scene.met)}" if scene.collides(configuration) else ""
        )

    def _line(
        self, a: Assignment | None, kind: Kind, offset: Array, who: Who | None = None, loose: bool = False
    ) -> Made:
        step, arm, piece = self._about(a, who)
        context = entering(self.workcell, self.context, kind, arm, piece)
        seen = (
            replace(context, carried={}, poses={n: T for n, T in context.poses.items() if n != piece})
            if loose
            else context
        )
        scene, start = scene_of(self.workcell, seen, arm), context.hands.qs[arm]
        try:
            path = straight_motion(self.workcell, scene, context.hands, arm, start, offset, kind)
        except (LineError, TimingError) as error:
            raise MotionError(a, f"{piece}: {kind}: {error}") from None
        segment = Segment(kind, step, arm, piece, readonly(path), readonly(offset), np.nan, 0.0, 0.0)
        return self._add(context, guarded(self.workcell, segment, context))

    def _wait(
        self,
        a: Assignment | None,
        kind: Kind,
        duration: float,
        opening: float,
        who: Who | None = None,
        width: float = np.nan,
    ) -> Made:
        step, arm, piece = self._about(a, who)
        context = entering(self.workcell, self.context, kind, arm, piece)
        segment = Segment(kind, step, arm, piece, NO_PATH, NONE, opening, duration, 0.0, width)
        return self._add(context, guarded(self.workcell, segment, context))


def _arm_after(a: Assignment, n: int) -> int:
    """The arm that acts after one of the regrasps of a step."""
    if n + 1 == len(a.regrasps):
        return a.arm
    following = a.regrasps[n + 1]
    pick = following if isinstance(following, Square) else following.pick
    return pick.arm if pick is not None else a.arm


def first_arm(a: Assignment) -> int:
    """The arm that acts first in a step."""
    return a.regrasps[0].arm if a.regrasps else a.arm


def guarded(workcell: Workcell, segment: Segment, context: Context) -> Segment:
    """A segment with its guard and its compliance, where it has them."""
    if segment.kind not in GUARDED:
        return segment
    end = segment.path[-1] if len(segment.path) else context.hands.qs[segment.arm]
    jacobian = workcell.robot.jacobian(segment.arm, end)
    compliance = jacobian.T @ np.linalg.inv(jacobian @ jacobian.T + DAMPING**2 * np.eye(6))
    stopped = segment.kind in ("set_down", "follow") or workcell.stopped(
        segment.piece, segment.last_way, context.placed
    )
    return replace(segment, guard=GUARD, compliance=readonly(compliance), beyond=BEYOND if stopped else 0.0)


def scene_of(workcell: Workcell, context: Context, arm: int) -> Scene:
    """The scene in which one arm moves in a context, and nothing else does."""
    return workcell.scene(context.poses, context.hands, arm, context.carried.get(arm), context.touching)


def widths_along(before: Context, segment: Segment) -> Array:
    """Widths [m] that a hand goes through along a segment."""
    return widths_to(before, segment.arm, segment.opening)


def widths_to(context: Context, arm: int, opening: float) -> Array:
    """Widths [m] from that of a hand to another; NaN leaves it as it is."""
    now = float(context.hands.openings[arm])
    return widths_between(now, now if np.isnan(opening) else opening)
