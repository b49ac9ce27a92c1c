"""Follow: a hand that holds a piece in place comes down with it onto what another hand has just let go of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from soma_bullet.task.actions.action import Action, Identity, Step, Steps
from soma_bullet.task.kinds import FOLLOW
from soma_bullet.task.segment import FOLLOWING
from soma_bullet.task.state import CellState

if TYPE_CHECKING:
    from soma_bullet.task.workcell import Workcell


@dataclass(frozen=True, eq=False)
class Follow(Action):
    """A hand that holds a piece follows it down until it rests. How far is felt, not planned.

    Attributes:
        arm, piece: index and name.
    """

    arm: int
    piece: str

    @property
    def identity(self) -> Identity:
        return "follow", self.piece, self.arm

    def steps(self, cell: Workcell, state: CellState) -> Steps:
        return (yield Step(FOLLOW, self.arm, self.piece, duration=FOLLOWING))
