"""Straight lines of a hand in the scenes of a schedule's search; whatever is rejected is counted under its
reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from soma_bullet.frames import Array
from soma_bullet.motion.line import LineError, line_back
from soma_bullet.robot.collision import Scene
from soma_bullet.task.workcell import Hands, Workcell

APPROACH = 0.06  # [m] straight approach to a grasp and retreat from it
LIFT = 0.06  # [m] straight up from the table
UP = np.array([0.0, 0.0, 1.0])


class TooManyLines(Exception):
    """A search has traced as many lines as it may."""


@dataclass
class Effort:
    """What the searches of one schedule have done together: lines made or checked so far, and how many there
    may be at most."""

    lines: int = 0
    most: int = 10**9

    @property
    def spent(self) -> bool:
        """Whether there may be no more."""
        return self.lines >= self.most


@dataclass(frozen=True, eq=False)
class Grip:
    """One grasp of a piece.

    Attributes:
        index: in the piece's table.
        T_piece_tcp: (4, 4).
        width: distance between the pads [m].
        contact: fraction of the pad on the piece.
    """

    index: int
    T_piece_tcp: Array
    width: float
    contact: float


@dataclass(frozen=True, eq=False)
class Mover:
    """What moves along a line, and what it is about.

    Attributes:
        piece: name, for the reasons.
        arm: index.
        scene: what it must keep clear of.
        hands: joints and openings of the rest.
        width: distance between its own pads [m].
    """

    piece: str
    arm: int
    scene: Scene
    hands: Hands
    width: float


class Tracer:
    """Makes and checks lines, keeps scenes, counts rejections."""

    def __init__(self, workcell: Workcell, rejections: Counter[str], effort: Effort | None = None):
        self.effort = effort or Effort()
        self.workcell, self.robot, self.rejections = workcell, workcell.robot, rejections
        self._scenes: dict[tuple[object, ...], Scene] = {}
        self.lines, self.most_lines = 0, 10**9

    def reject(self, piece: str, reason: str, count: int = 1) -> None:
        """Count a rejection."""
        self.rejections[f"{piece}: {reason}"] += count

    def scene(
        self,
        key: tuple[object, ...],
        poses: Mapping[str, Array],
        hands: Hands,
        arm: int,
        carried: tuple[str, Array] | None = None,
        touching: frozenset[frozenset[str]] = frozenset(),
        alone: bool = False,
    ) -> Scene:
        """A scene, or the one made for the same key with the piece put differently into the hand.

        The key stands for the poses and the touching pairs.
        """
        others = () if alone else tuple(sorted(hands.gripped.items()))
        key = (*key, arm, others, alone)
        if key not in self._scenes:
            self._scenes[key] = self.workcell.scene(poses, hands, arm, carried, touching, alone)
        elif carried is not None:
            self._scenes[key].attach(carried[0], arm, carried[1])
        return self._scenes[key]

    def line(self, name: str, m: Mover, q: Array, T: Array, away: Array, length: float) -> Array | None:
        """Joints (n, 6) of a free line from q at T, along the unit vector `away` (3,) for `length` [m]; None
        where none is."""
        if self.lines >= self.most_lines or self.effort.spent:
            raise TooManyLines
        self.lines += 1
        self.effort.lines += 1
        try:
            return line_back(self.robot, m.arm, q, T, away, length, self._check(m))
        except LineError as error:
            self._reject_line(name, m, error.cause)
            return None

    def free(self, name: str, m: Mover, line: Array) -> bool:
        """Whether the joints (n, 6) of a line are free."""
        if self.effort.spent:
            raise TooManyLines
        self.effort.lines += 1
        collides = self._check(m)
        if any(collides(q) for q in line):
            self._reject_line(name, m, "collision")
            return False
        return True

    def _check(self, m: Mover) -> Callable[[Array], bool]:
        """Whether the mover collides at joints (6,)."""
        configuration = self.workcell.configuration(m.hands, m.arm, m.hands.qs[m.arm], m.width)
        slots = self.robot.arm_slots(m.arm)

        def collides(q: Array) -> bool:
            configuration[slots] = q
            return m.scene.collides(configuration)

        return collides

    def _reject_line(self, name: str, m: Mover, cause: str) -> None:
        """Count a rejection for its cause, a collision as that of the pair that has just been found."""
        self.reject(m.piece, f"{name}: " + (" meets ".join(m.scene.met) if cause == "collision" else cause))
