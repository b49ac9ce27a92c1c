"""How a piece goes into its place: an insertion as a value. A straight line is one kind of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from soma_bullet.frames import Array, translate
from soma_bullet.motion.line import Check, line_back
from soma_bullet.robot.kinematics import Robot
from soma_bullet.task.kinds import INSERT, PLACE, Kind


class Insertion(Protocol):
    """A way of a piece to its goal. Another kind of way is another class with these members."""

    @property
    def piece(self) -> str:
        """Its name."""

    def pose(self, s: float) -> Array:
        """T_world_piece (4, 4) at a fraction of the way: 0 where it begins, 1 at the goal."""

    def sweep(self) -> Array:
        """Shifts (m, 3) [m] from the goal to the corners of the way: the piece sweeps what is between two."""

    def line(self, robot: Robot, arm: int, T_piece_tcp: Array, q_goal: Array, collides: Check) -> Array:
        """Joints (m, n) of an arm along the way, from q_goal (n,) back to its beginning.

        Raises:
            LineError: the first state that fails, with the cause.
        """

    def parts(self) -> Iterator[tuple[Kind, Array]]:
        """The kinds of segments that it is made of, each with its straight travel (3,) [m], in order."""


@dataclass(frozen=True, eq=False)
class StraightInsertion:
    """Along one straight line.

    Attributes:
        piece: its name.
        goal: T_world_piece (4, 4) where it settles.
        direction: unit assembly direction in the world (3,).
        length: of the way [m]; guarded: of its last, slow part.
        bears: force [N] with which the piece may press on what is placed.
    """

    piece: str
    goal: Array
    direction: Array
    length: float
    guarded: float
    bears: float

    def pose(self, s: float) -> Array:
        return translate(self.goal, -self.direction * self.length * (1.0 - s))

    def sweep(self) -> Array:
        return np.array([np.zeros(3), -self.direction * self.length])

    def line(self, robot: Robot, arm: int, T_piece_tcp: Array, q_goal: Array, collides: Check) -> Array:
        return line_back(robot, arm, q_goal, self.goal @ T_piece_tcp, -self.direction, self.length, collides)

    def parts(self) -> Iterator[tuple[Kind, Array]]:
        yield INSERT, self.direction * (self.length - self.guarded)
        yield PLACE, self.direction * self.guarded
