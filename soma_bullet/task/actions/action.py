"""What all actions have in common: they are made of steps, and change the state of the cell by them."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field, is_dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from soma_bullet.frames import Array
from soma_bullet.records import register_family
from soma_bullet.task.kinds import Kind, as_planned
from soma_bullet.task.segment import NOWHERE
from soma_bullet.task.state import CellState

if TYPE_CHECKING:
    from soma_bullet.task.workcell import Workcell

Identity = tuple[str | int, ...]


@dataclass(frozen=True, eq=False)
class Step:
    """One segment to be.

    Attributes:
        kind, arm, piece: see Segment.
        q_end: joints (n,) [rad] in which it ends; where a motion around obstacles goes, or what a line was
            checked to end in; None for waits.
        offset: straight travel (3,) [m] of lines.
        opening: distance between the pads [m] that the hand goes to, None to leave it as it is.
        duration: [s] of waits.
        width: distance between the pads [m] that is expected after a grasp.
        bears: force [N] with which the piece may press on what it meets.
    """

    kind: Kind
    arm: int
    piece: str
    q_end: Array | None = None
    offset: Array = field(default_factory=lambda: NOWHERE)
    opening: float | None = None
    duration: float = 0.0
    width: float | None = None
    bears: float = np.inf


Steps = Generator[Step, CellState, CellState]


class Action:
    """One thing that hands do. Subclasses are frozen dataclasses; each is recorded under its class's name."""

    family: ClassVar[dict[str, type[Action]]] = {}
    piece: str
    arm: int

    def __init_subclass__(cls) -> None:
        Action.family[cls.__name__] = cls

    @property
    def identity(self) -> Identity:
        """What tells it from other ways to do the same: what is ruled out is ruled out by this."""
        raise NotImplementedError

    @property
    def regrasps(self) -> bool:
        """Whether the piece is somewhere else, or in another hand, afterwards, but not in place."""
        return False

    def steps(self, cell: Workcell, state: CellState) -> Steps:
        """What it is made of. Each step is told the state after it; returns the last."""
        raise NotImplementedError

    def effects(self, cell: Workcell, state: CellState) -> CellState:
        """The state after it, if it goes as planned."""
        steps = self.steps(cell, state)
        try:
            step = next(steps)
            while True:
                state = as_planned(cell, state, step)
                step = steps.send(state)
        except StopIteration as stop:
            after: CellState = stop.value
            return after


register_family(Action, Action.family)


def alike(one: Action, other: Action) -> bool:
    """Whether two actions do the same, joint by joint."""
    return _equal(one, other)


def _equal(one: object, other: object) -> bool:
    if one is other:
        return True
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return bool(np.array_equal(one, other))
    if type(one) is type(other) and is_dataclass(one):
        return all(_equal(a, b) for a, b in zip(vars(one).values(), vars(other).values(), strict=True))
    return bool(one == other)


def tool_axis(cell: Workcell, arm: int, q: Array) -> Array:
    """The approach direction (3,) of a hand in the world."""
    return np.asarray(cell.robot.tcp(arm, q)[:3, 2])
