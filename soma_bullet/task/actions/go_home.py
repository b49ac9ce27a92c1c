"""Go home: an arm whose hand is empty goes to where it is in nobody's way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from soma_bullet.task.actions.action import Action, Identity, Step, Steps
from soma_bullet.task.kinds import HOME
from soma_bullet.task.state import CellState

if TYPE_CHECKING:
    from soma_bullet.task.workcell import Workcell


@dataclass(frozen=True, eq=False)
class GoHome(Action):
    """An arm goes home, its hand closing on the way.

    Attributes:
        arm: index.
        piece: what it has just been about.
    """

    arm: int
    piece: str

    @property
    def identity(self) -> Identity:
        return "go home", self.arm

    def steps(self, cell: Workcell, state: CellState) -> Steps:
        return (yield Step(HOME, self.arm, self.piece, cell.robot.home[self.arm], opening=0.0))
