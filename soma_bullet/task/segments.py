"""The program as a value: segments, each a timed trajectory or a hand command, and what the cell looks like
around each.

Where pieces and hands are before and after a segment follows from the segments alone: `entering` and
`leaving` are the only places that say what a segment changes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from soma_bullet.frames import Array, inverse, readonly
from soma_bullet.motion.timing import HandLimits
from soma_bullet.task.assignments import Schedule, Start
from soma_bullet.task.feed import Feed
from soma_bullet.task.workcell import TABLE, Hands, Workcell

Kind = Literal[
    "transit",
    "approach",
    "grasp",
    "lift",
    "transfer",
    "insert",
    "place",
    "lower",
    "set_down",
    "settle",
    "release",
    "retreat",
    "home",
    "back_off",
    "follow",
]

DT = 1 / 480  # [s] between samples of a trajectory: the simulator's step
# [m] at the end of an insertion that are slowest; they are guarded, as is more where neighbours come near
PLACE = 0.010
GUARD = 1.0  # [N] change of the wrist's force that ends a placing
BEYOND = 1.5e-3  # [m] that a guarded line goes on beyond its end until it meets what carries the piece
SETTLE = 0.2  # [s] after a placing
FOLLOWING = 0.5  # [s] about, until a hand that follows down is stopped
CLOSING, OPENING_TIME = 0.5, 0.3  # [s] for the hand to grip, and to let go
SPEEDS = {
    "approach": HandLimits(0.25, 1.0),
    "lift": HandLimits(0.20, 1.0),
    "insert": HandLimits(0.20, 1.0),
    "place": HandLimits(0.010, 0.03),
    "lower": HandLimits(0.20, 1.0),
    "set_down": HandLimits(0.010, 0.03),
    "retreat": HandLimits(0.25, 1.0),
}  # [m/s], [m/s2]
THREADING = HandLimits(0.020, 0.06)  # [m/s], [m/s2] of what is guarded before that
GUARDED = ("place", "set_down", "follow")
SLANT = 0.2, 0.98  # downward parts of the directions that count as slanted
DOWN = readonly(np.array((0.0, 0.0, -1.0)))
AROUND = ("transit", "transfer", "home")  # obstacles
MOTIONS = (*AROUND, *SPEEDS)
SMALLEST_JUMP = 1e-4  # [rad] a segment that starts farther from the measured joints is made anew


def _no_joints() -> Array:
    return readonly(np.zeros((0, 6)))


@dataclass(frozen=True, eq=False)
class Segment:
    """One thing that one arm does.

    Attributes:
        kind: what it is; `transit`, `transfer`, `home` go around obstacles; `grasp`, `settle`, `release` are
            waits; the rest are straight lines of the hand. `place` ends at the goal, `set_down` on the table;
            both are guarded, and so is `follow`: a hand that holds a piece in place comes down with it onto
            what another hand has just let go of.
        step: of the plan; arm: index; piece: what it is about.
        path: joints every DT (n, 6) [rad]; empty for waits.
        offset: straight travel of the hand (3,) [m] for lines, else zero.
        opening: distance between the pads [m] that the hand goes to, or NaN to leave it as it is.
        duration: [s] of waits.
        guard: change of the wrist's force [N] that ends the segment, 0 for none.
        width: distance between the pads [m] that is expected after a grasp, else NaN.
        compliance: change of the joints for a small twist of the hand in world axes at the end of a guarded
            line (6, 6), translation [rad/m] before rotation [rad/rad]; empty (0, 6) for the rest.
        beyond: how far a guarded line may go on beyond its end until the piece meets what should stop it
            there [m]: a piece that sits higher in the hand than planned is not let go in the air.
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
    width: float = np.nan
    compliance: Array = field(default_factory=_no_joints)
    beyond: float = 0.0

    @property
    def slanted(self) -> bool:
        """Whether it is a line that comes down at a slant: it then ends straight down."""
        height = float(self.offset[2]) / max(float(np.linalg.norm(self.offset)), 1e-12)
        return -SLANT[1] < height < -SLANT[0]

    @property
    def last_way(self) -> Array:
        """Unit vector (3,) along which a line ends."""
        return DOWN if self.slanted or not self.offset.any() else self.offset / np.linalg.norm(self.offset)

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
        segments: in an order in which they can be executed one at a time.
        after: for every segment the indices of those that must have ended before it starts.
        T_world_assembly: (4, 4).
        stand: footprint of the stand [m].
        start: what it goes on from; None begins with all pieces in the feed.
        alone: planned duration of the same work with one arm at a time [s], ways home left out or put off
            where that is free; NaN where that was not asked.
        in_turn: planned duration of the schedule as it was, one segment at a time [s]; NaN where that was not
            asked.
    """

    cell: str
    assembly: str
    digest: str
    seed: int
    order: tuple[str, ...]
    feed: Feed
    schedule: Schedule
    segments: tuple[Segment, ...]
    after: tuple[tuple[int, ...], ...]
    T_world_assembly: Array
    stand: tuple[float, float]
    start: Start | None = None
    alone: float = np.nan
    in_turn: float = np.nan

    @property
    def makespan(self) -> float:
        """Planned duration [s]."""
        ends: list[float] = []
        for segment, before in zip(self.segments, self.after, strict=True):
            ends.append(max((ends[k] for k in before), default=0.0) + segment.seconds)
        return max(ends, default=0.0)


def one_at_a_time(count: int) -> tuple[tuple[int, ...], ...]:
    """`Program.after` of segments that run one after another."""
    return tuple((k - 1,) if k else () for k in range(count))


# --- what the cell looks like -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Context:
    """Where pieces and hands are when a segment starts or has ended.

    Attributes:
        poses: T_world_piece (4, 4) of all pieces, also of those in hands.
        hands: joints, openings, and what is between the fingers.
        carried: arm -> (piece, T_tcp_piece) of the pieces that move with a hand.
        placed: the pieces that stand at their goals.
        touching: pairs of bodies that the segment means to touch.
    """

    poses: Mapping[str, Array]
    hands: Hands
    carried: Mapping[int, tuple[str, Array]] = field(default_factory=dict)
    placed: frozenset[str] = frozenset()
    touching: frozenset[frozenset[str]] = frozenset()


def beginning(
    workcell: Workcell, feed: Feed, start: Start | None = None, order: Sequence[str] = ()
) -> Context:
    """All pieces in the feed, the arms at home with empty hands; or as found, the first pieces of the order
    in place."""
    if start is None:
        return Context({name: feed.pose(name) for name in feed.names}, workcell.idle())
    placed = frozenset(order[: start.step])
    poses = {
        name: workcell.stands(name, pose) if name in placed else pose for name, pose in start.poses.items()
    }
    hands, carried = start.hands, {}
    for one in start.carrying:
        hands, carried[one.arm] = hands.gripping(one.arm, one.piece), (one.piece, one.T_tcp_piece)
    return Context(poses, hands, carried, placed)


def entering(workcell: Workcell, context: Context, kind: Kind, arm: int, piece: str) -> Context:
    """The context as a segment takes it: a hand near its piece has it between the fingers, what is meant to
    touch may."""
    near = kind in ("approach", "release", "retreat")
    hands = context.hands.gripping(arm, piece) if near else context.hands
    touching: frozenset[frozenset[str]] = frozenset()
    if kind in ("lift", "lower", "set_down"):
        touching = frozenset({frozenset({piece, TABLE})})
    elif kind in ("transfer", "insert", "place"):
        touching = frozenset(pair for pair in workcell.touching if piece in pair)
    return replace(context, hands=hands, touching=touching)


def leaving(workcell: Workcell, before: Context, segment: Segment) -> Context:
    """The context after a segment that went as planned."""
    arm, piece, kind = segment.arm, segment.piece, segment.kind
    hands, poses, carried, placed = before.hands, dict(before.poses), dict(before.carried), before.placed
    q = segment.path[-1] if len(segment.path) else hands.qs[arm]
    hands = hands.with_arm(arm, q, None if np.isnan(segment.opening) or kind == "grasp" else segment.opening)
    if arm in carried:
        name, T_tcp_piece = carried[arm]
        poses[name] = workcell.robot.tcp(arm, q) @ T_tcp_piece
    if kind == "grasp":
        hands = hands.with_arm(arm, q, segment.width).gripping(arm, piece)
        if piece not in placed:
            carried[arm] = (piece, inverse(workcell.robot.tcp(arm, q)) @ poses[piece])
    elif kind == "place":
        poses[piece] = workcell.settled[piece]
        placed |= {piece}
        carried.pop(arm, None)
    elif kind in ("set_down", "release"):
        carried.pop(arm, None)
    elif kind == "retreat":
        hands = hands.gripping(arm, None)
    return Context(poses, hands, carried, placed)


def contexts(workcell: Workcell, program: Program) -> Iterator[tuple[Context, Segment, Context]]:
    """Every segment of a program with the contexts before and after it."""
    context = beginning(workcell, program.feed, program.start, program.order)
    for segment in program.segments:
        before = entering(workcell, context, segment.kind, segment.arm, segment.piece)
        context = leaving(workcell, before, segment)
        yield before, segment, context
