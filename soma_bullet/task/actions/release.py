"""Release: a hand lets go of a piece in place, what others hold on it comes down, and it goes straight
back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from soma_bullet.frames import Array, readonly
from soma_bullet.grasp.clearance import OPENING
from soma_bullet.task.actions.action import Action, Identity, Step, Steps, tool_axis
from soma_bullet.task.actions.follow import Follow
from soma_bullet.task.kinds import RELEASE, RETREAT
from soma_bullet.task.lines import Mover
from soma_bullet.task.segment import OPENING_TIME
from soma_bullet.task.state import CellState

if TYPE_CHECKING:
    from soma_bullet.task.search.planning import Planning
    from soma_bullet.task.workcell import Workcell


@dataclass(frozen=True, eq=False)
class Release(Action):
    """A hand lets go of a piece in place and retreats.

    Attributes:
        arm, piece: index and name.
        q_end: joints (n,) at the end of the retreat.
    """

    arm: int
    piece: str
    q_end: Array

    @property
    def identity(self) -> Identity:
        return "release", self.piece, self.arm

    def steps(self, cell: Workcell, state: CellState) -> Steps:
        return (yield from leave(cell, state, self.arm, self.piece, self.q_end))


def leave(
    cell: Workcell, state: CellState, arm: int, piece: str, q_end: Array | None, way: float | None = None
) -> Steps:
    """A hand opens and goes straight back; between the two, what others hold on its piece follows down."""
    opening = min(float(state.openings[arm]) + 2 * OPENING, cell.hand(arm).opening)
    state = yield Step(RELEASE, arm, piece, opening=opening, duration=OPENING_TIME)
    for holder, held in sorted(state.gripped.items()):
        if holder != arm and {piece, held} <= state.placed and cell.carries(piece, held):
            state = yield from Follow(holder, held).steps(cell, state)
    away = -tool_axis(cell, arm, state.qs[arm]) * (cell.hand(arm).way_out if way is None else way)
    return (yield Step(RETREAT, arm, piece, q_end, away))


# --- planning -----------------------------------------------------------------------------------------------


def candidates(state: CellState, wanted: Mapping[str, object]) -> list[str]:
    """The pieces that are held and need not be any more."""
    return sorted(piece for piece in state.held.values() if piece not in wanted)


def check(planning: Planning, state: CellState, piece: str, about: str) -> Release | None:
    """How the hand that holds a piece leaves it straight.

    Args:
        about: the piece of the step that it belongs to.
    """
    arm = state.holder(piece)
    assert arm is not None
    scene = planning.lines.scene(state, arm, about)
    q, T = state.qs[arm], planning.robot.tcp(arm, state.qs[arm])
    mover = Mover(about, arm, scene, state, float(state.openings[arm]) + 2 * OPENING)
    way_out = planning.workcell.hand(arm).way_out
    line = planning.lines.line(f"retreat from {piece}", mover, q, T, -T[:3, 2], way_out)
    return None if line is None else Release(arm, piece, readonly(line[-1]))
