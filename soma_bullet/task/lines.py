"""Straight lines of a hand in the scenes of a search: each is free, or is refused with its reason."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from soma_bullet.frames import Array
from soma_bullet.grasp.graph import Grip
from soma_bullet.motion.line import LineError, line_back
from soma_bullet.robot.collision import Scene
from soma_bullet.task.kinds import Kind
from soma_bullet.task.limits import Effort, TooManyLines
from soma_bullet.task.refusal import Refusal, Refusals
from soma_bullet.task.state import CellState
from soma_bullet.task.workcell import Workcell


@dataclass(frozen=True, eq=False)
class Spot:
    """A place of a piece.

    Attributes:
        pose: T_world_piece (4, 4).
        off: how far any point of the piece may be from there, along the table [m].
        name: what tells it from other places of the piece, as the number of its resting pose, of its place
            and of its yaw.
    """

    pose: Array
    off: float = 0.0
    name: tuple[int, ...] = ()


class SceneKey(NamedTuple):
    """What tells one scene of a search from the others; what lies where is the same in all of them.

    Attributes:
        placed: pieces in place; piece: what the lines are about, and where, if it does not move with the
            hand.
        kind: of segment, for what may be touched; None for nothing.
        arm: that moves; gripped: by the others; alone: the others are left out.
    """

    placed: frozenset[str]
    piece: str
    spot: Spot | None
    kind: Kind | None
    arm: int
    gripped: tuple[tuple[int, str], ...]
    alone: bool


@dataclass(frozen=True, eq=False)
class Mover:
    """What moves along a line, and what it is about.

    Attributes:
        piece: name, for the reasons.
        arm: index.
        scene: what it must keep clear of.
        state: joints and openings of the rest.
        width: distance between its own pads [m].
        grip: of the piece, where it has one.
    """

    piece: str
    arm: int
    scene: Scene
    state: CellState
    width: float
    grip: Grip | None = None


class Lines:
    """Makes and checks lines, keeps scenes, counts refusals; of one search."""

    def __init__(self, workcell: Workcell, refusals: Refusals, effort: Effort):
        self.workcell, self.robot, self.refusals, self.effort = workcell, workcell.robot, refusals, effort
        self.number = next(effort.serial)
        self.made, self.most = 0, 10**9  # lines of this search alone

    def refuse(self, piece: str, cause: str, count: int = 1) -> None:
        """Count a refusal that no line shows."""
        self.refusals.add(Refusal(piece, "", cause), count)

    def scene(
        self,
        state: CellState,
        arm: int,
        about: str,
        spot: Spot | None = None,
        kind: Kind | None = None,
        alone: bool = False,
    ) -> Scene:
        """The scene in which an arm moves.

        Args:
            about: the piece that it is about, at `spot` if it does not move with the hand.
            kind: of segment, for what it may touch.
        """
        others = () if alone else tuple(sorted(state.gripped.items()))
        key = SceneKey(state.placed, about, spot, kind, arm, others, alone)
        touching = kind.touching(self.workcell, about) if kind is not None else frozenset()
        scene: Scene = self.effort.scenes.get(
            (self.number, key), lambda: self.workcell.scene(state, arm, touching, alone)
        )
        for piece, T_tcp_piece in self.workcell.carried(state, arm).items():
            scene.attach(piece, arm, T_tcp_piece)
        return scene

    def forget(self) -> None:
        """What lies where has changed: no scene is as it was."""
        self.number = next(self.effort.serial)

    def line(self, name: str, m: Mover, q: Array, T: Array, away: Array, length: float) -> Array | None:
        """Joints (m, n) of a free line from q at T, along the unit vector `away` (3,) for `length` [m]; None
        where none is."""
        return self.along(
            name, m, lambda collides: line_back(self.robot, m.arm, q, T, away, length, collides)
        )

    def along(self, name: str, m: Mover, make: Callable[[Callable[[Array], bool]], Array]) -> Array | None:
        """The joints that `make` gives with a check of collisions, unless it raises LineError."""
        if self.made >= self.most:
            raise TooManyLines
        self.effort.spend()
        self.made += 1
        try:
            return make(self._check(m))
        except LineError as error:
            self._refuse_line(name, m, error.cause, error.q)
            return None

    def free(self, name: str, m: Mover, line: Array) -> bool:
        """Whether the joints (m, n) of a line are free."""
        self.effort.spend()
        collides = self._check(m)
        for q in line:
            if collides(q):
                self._refuse_line(name, m, "collision", q)
                return False
        return True

    def _check(self, m: Mover) -> Callable[[Array], bool]:
        """Whether the mover collides at joints (n,)."""
        configuration = self.workcell.configuration(m.state, m.arm, m.state.qs[m.arm], m.width)
        slots = self.robot.arm_slots(m.arm)

        def collides(q: Array) -> bool:
            configuration[slots] = q
            return m.scene.collides(configuration)

        return collides

    def _refuse_line(self, name: str, m: Mover, cause: str, q: Array | None) -> None:
        """Count a refusal for its cause, a collision as that of the pair that has just been found."""
        arm, grasp = self.robot.arm(m.arm).name, m.grip.index if m.grip is not None else None
        if cause != "collision" or q is None:
            self.refusals.add(Refusal(m.piece, name, cause), 1, arm, grasp)
            return
        pair = m.scene.met

        def distance() -> tuple[float, float]:
            configuration = self.workcell.configuration(m.state, m.arm, np.asarray(q), m.width)
            return m.scene.distance(pair, configuration)

        self.refusals.add(Refusal(m.piece, name, cause, pair), 1, arm, grasp, distance)
