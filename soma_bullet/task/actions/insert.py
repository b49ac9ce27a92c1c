"""Insert: a hand brings the piece that it has to its place, and stays on it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from soma_bullet.frames import Array, inverse, readonly
from soma_bullet.grasp.graph import Grip
from soma_bullet.planner.assist import HoldCertificate
from soma_bullet.task.actions.action import Action, Identity, Step, Steps
from soma_bullet.task.guarded import guarded_length
from soma_bullet.task.insertion import Insertion, StraightInsertion
from soma_bullet.task.kinds import INSERT, PLACE, SETTLE, TRANSFER
from soma_bullet.task.lines import Mover
from soma_bullet.task.posture import carrying_time
from soma_bullet.task.segment import SETTLING
from soma_bullet.task.state import CellState

if TYPE_CHECKING:
    from soma_bullet.task.search.planning import Planning
    from soma_bullet.task.workcell import Workcell


@dataclass(frozen=True, eq=False)
class Insert(Action):
    """A hand brings the piece that it has to its place.

    Attributes:
        piece, arm, grasp: what, by which arm, by which grasp of the piece's table.
        width: distance between the pads [m].
        q_ready, q_goal: joints (n,) where the insertion starts, and at the goal.
        way: of the piece.
        certificate: of the hold that the grasp becomes, if it does.
    """

    piece: str
    arm: int
    grasp: int
    width: float
    q_ready: Array
    q_goal: Array
    way: StraightInsertion
    certificate: HoldCertificate | None

    @property
    def identity(self) -> Identity:
        return "insert", self.piece, self.arm, self.grasp

    def steps(self, cell: Workcell, state: CellState) -> Steps:
        who = self.arm, self.piece
        yield Step(TRANSFER, *who, self.q_ready)
        for kind, offset in self.way.parts():
            yield Step(kind, *who, self.q_goal if kind is PLACE else None, offset, bears=self.way.bears)
        return (yield Step(SETTLE, *who, duration=SETTLING))


# --- planning -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Candidate:
    """An arm, and the grip by which it inserts a piece."""

    arm: int
    grip: Grip


class LinesKey(NamedTuple):
    """Of the insertions of a step that an arm can make if the others are out of the way."""

    step: int
    arm: int
    grip: Grip


def insertion(planning: Planning, k: int) -> Insertion:
    """The way of the piece of a step."""
    return planning.insertions.get(k, lambda: _insertion(planning, k))


def _insertion(planning: Planning, k: int) -> StraightInsertion:
    cell, step = planning.workcell, planning.plan.steps[k]
    direction, length = readonly(step.direction), step.way + planning.sizes.run_in
    guarded = guarded_length(cell, step.piece, np.array(direction), length, planning.standing(k))
    return StraightInsertion(step.piece, cell.settled[step.piece], direction, length, guarded, step.bears)


def candidates(planning: Planning, k: int, candidate: Candidate) -> list[Array]:
    """Joints (m, n) along the insertions of all branches that are free of table, stand, pieces and the arm
    itself, from the goal back."""
    key = LinesKey(k, candidate.arm, candidate.grip)
    return planning.insertion_lines.get(key, lambda: list(_alone(planning, k, candidate)))


def _alone(planning: Planning, k: int, candidate: Candidate) -> Iterator[Array]:
    robot, arm = planning.robot, candidate.arm
    way = insertion(planning, k)
    mover = _mover(planning, k, planning.empty(k), candidate, alone=True)
    T_piece_tcp = candidate.grip.T_piece_tcp
    solutions = robot.inverse(arm, way.pose(1.0) @ T_piece_tcp, robot.home[arm])
    if not len(solutions):
        planning.lines.refuse(way.piece, f"{robot.arm(arm).name} arm does not reach the goal")
    for q in solutions:
        make = partial(way.line, robot, arm, T_piece_tcp, q)
        line = planning.lines.along("insertion", mover, make)
        if line is not None:
            yield line


def nearest(planning: Planning, k: int, candidate: Candidate, q: Array) -> list[Array]:
    """The free insertions of a step, the one first that is reached soonest from joints (n,)."""

    def seconds(line: Array) -> float:
        return round(carrying_time(planning.robot, candidate.arm, q, line[-1]), 9)

    return sorted(candidates(planning, k, candidate), key=seconds)


def check(planning: Planning, k: int, state: CellState, candidate: Candidate, line: Array) -> bool:
    """Whether an insertion is free of the other arms too, as they are."""
    return planning.lines.free("insertion", _mover(planning, k, state, candidate), line)


def made(
    planning: Planning, k: int, candidate: Candidate, line: Array, certificate: HoldCertificate | None
) -> Insert:
    """The action of an insertion along a line, joints (m, n) from the goal back."""
    way = insertion(planning, k)
    assert isinstance(way, StraightInsertion)
    grip, joints = candidate.grip, (readonly(line[-1]), readonly(line[0]))
    return Insert(way.piece, candidate.arm, grip.number, grip.width, *joints, way, certificate)


def _mover(planning: Planning, k: int, state: CellState, candidate: Candidate, alone: bool = False) -> Mover:
    piece, arm, grip = planning.plan.steps[k].piece, candidate.arm, candidate.grip
    state = state.gripping(arm, piece).carrying(arm, inverse(grip.T_piece_tcp))
    scene = planning.lines.scene(state, arm, piece, kind=INSERT, alone=alone)
    return Mover(piece, arm, scene, state, grip.width, grip)
