"""The kinds of segments: how each moves, what it may touch, and what it changes.

This is the only place that says what a segment changes. The search follows the steps of an action with it,
the program its segments, the executive what has been run. An action that needs another kind defines it in its
own file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, Protocol

from soma_bullet.frames import Array, inverse
from soma_bullet.motion.timing import HandLimits
from soma_bullet.records import register_names
from soma_bullet.task.state import CellState

if TYPE_CHECKING:
    from soma_bullet.task.workcell import Workcell

TABLE = "table"
Touching = frozenset[frozenset[str]]


class Doing(Protocol):
    """What an effect is a function of: a step of an action, or a segment of a program.

    Attributes:
        kind, arm, piece: of it.
        q_end: joints (n,) [rad] of the arm after it, None where it stays where it is.
        opening: distance between the pads [m] that the hand goes to, None where it stays as it is.
        width: distance between the pads [m] after a grasp.
    """

    @property
    def kind(self) -> Kind: ...
    @property
    def arm(self) -> int: ...
    @property
    def piece(self) -> str: ...
    @property
    def q_end(self) -> Array | None: ...
    @property
    def opening(self) -> float | None: ...
    @property
    def width(self) -> float | None: ...


Change = Callable[["Workcell", CellState, Doing], CellState]


def _nothing(cell: Workcell, state: CellState, doing: Doing) -> CellState:
    return state


@dataclass(frozen=True)
class Kind:
    """One kind of segment.

    Attributes:
        name: as records and logs have it.
        way: `around` obstacles, a straight `line` of the hand, or a `wait`.
        limits: of the hand's speed along a line.
        guarded: the wrist's force ends it.
        near: the hand is at its piece, which counts as between the fingers.
        touches: what the piece may touch meanwhile: the `table`, its neighbours at the `goal`, or `nothing`.
        carries: the piece moves with the hand from start to end.
        unladen: the hand is away from the piece that the segment is about.
        fetches: it may be one of those that bring a piece into the hand.
        at_piece: it changes what holds the piece, where that stands in place.
        assembles: it changes the assembly.
        ends: what the end of a guarded line is: the `goal`, the `table`, or `rest` on whatever is there.
        change: what else it changes, beside where arm, hand and what it carries are.
    """

    name: str
    way: Literal["around", "line", "wait"]
    limits: HandLimits | None = None
    guarded: bool = False
    near: bool = False
    touches: Literal["nothing", "table", "goal"] = "nothing"
    carries: bool = False
    unladen: bool = False
    fetches: bool = False
    at_piece: bool = False
    assembles: bool = False
    ends: Literal["", "goal", "table", "rest"] = ""
    change: Change = field(default=_nothing, repr=False, compare=False)

    def __post_init__(self) -> None:
        if KINDS.setdefault(self.name, self) != self:
            raise ValueError(f"there is another kind of segments called {self.name!r}")

    def __str__(self) -> str:
        return self.name

    @property
    def moves(self) -> bool:
        """Whether the arm moves along a path."""
        return self.way != "wait"

    @property
    def around(self) -> bool:
        """Whether the path goes around obstacles."""
        return self.way == "around"

    def touching(self, cell: Workcell, piece: str) -> Touching:
        """Pairs of bodies that it means to touch."""
        if self.touches == "table":
            return frozenset({frozenset({piece, TABLE})})
        if self.touches == "goal":
            return frozenset(pair for pair in cell.touching if piece in pair)
        return frozenset()

    def before(self, state: CellState, arm: int, piece: str) -> CellState:
        """The state as its scene has it: a hand at its piece has it between its fingers."""
        return state.gripping(arm, piece) if self.near else state

    def after(self, cell: Workcell, state: CellState, doing: Doing) -> CellState:
        """The state after a segment that went as planned, from that before it."""
        arm = doing.arm
        q = state.qs[arm] if doing.q_end is None else doing.q_end
        state = state.with_arm(arm, q, doing.opening)
        if arm in state.carried:
            state = state.moved(state.gripped[arm], cell.robot.tcp(arm, q) @ state.carried[arm])
        return self.change(cell, state, doing)


KINDS: dict[str, Kind] = {}  # by name
register_names(Kind, KINDS)


def _closed(cell: Workcell, state: CellState, doing: Doing) -> CellState:
    """The hand has the piece; what is not in place moves with it from then on."""
    arm, piece = doing.arm, doing.piece
    state = state.with_arm(arm, state.qs[arm], doing.width).gripping(arm, piece)
    if piece in state.placed:
        return state
    return state.carrying(arm, inverse(cell.robot.tcp(arm, state.qs[arm])) @ state.poses[piece])


def _placed(cell: Workcell, state: CellState, doing: Doing) -> CellState:
    """The piece stands in place, where it settles."""
    state = state.moved(doing.piece, cell.settled[doing.piece]).placing(doing.piece)
    return state.carrying(doing.arm, None)


def _let_go(cell: Workcell, state: CellState, doing: Doing) -> CellState:
    """The piece stays where it is."""
    return state.carrying(doing.arm, None)


def _left(cell: Workcell, state: CellState, doing: Doing) -> CellState:
    """The hand is away from the piece."""
    return state.gripping(doing.arm, None)


FAST = HandLimits(0.25, 1.0)  # [m/s], [m/s2]
BRISK = HandLimits(0.20, 1.0)
SLOW = HandLimits(0.010, 0.03)

TRANSIT = Kind("transit", "around", unladen=True, fetches=True)
APPROACH = Kind("approach", "line", FAST, near=True, at_piece=True, fetches=True)
GRASP = Kind("grasp", "wait", at_piece=True, fetches=True, change=_closed)
LIFT = Kind("lift", "line", BRISK, touches="table", carries=True, fetches=True)
TRANSFER = Kind("transfer", "around", touches="goal", carries=True, fetches=True)
INSERT = Kind("insert", "line", BRISK, touches="goal", carries=True, assembles=True)
PLACE = Kind(
    "place",
    "line",
    SLOW,
    guarded=True,
    touches="goal",
    carries=True,
    assembles=True,
    ends="goal",
    change=_placed,
)
LOWER = Kind("lower", "line", BRISK, touches="table", carries=True)
SET_DOWN = Kind(
    "set_down", "line", SLOW, guarded=True, touches="table", carries=True, ends="table", change=_let_go
)
SETTLE = Kind("settle", "wait", at_piece=True)
RELEASE = Kind("release", "wait", near=True, at_piece=True, change=_let_go)
FOLLOW = Kind("follow", "wait", guarded=True, at_piece=True, ends="rest")
RETREAT = Kind("retreat", "line", FAST, near=True, change=_left)
HOME = Kind("home", "around", unladen=True)
BACK_OFF = Kind("back_off", "line", FAST)


def as_planned(cell: Workcell, state: CellState, doing: Doing) -> CellState:
    """The state after a step or a segment, from that before it."""
    return doing.kind.after(cell, state, doing)
