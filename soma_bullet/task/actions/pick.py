"""Pick: a hand takes a piece from the table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from soma_bullet.frames import Array, inverse, readonly
from soma_bullet.grasp.clearance import OPENING
from soma_bullet.grasp.graph import Grip
from soma_bullet.task.actions.action import Action, Identity, Step, Steps, tool_axis
from soma_bullet.task.kinds import APPROACH, GRASP, LIFT, TRANSIT
from soma_bullet.task.lines import Mover, Spot
from soma_bullet.task.segment import CLOSING, UP
from soma_bullet.task.state import CellState, Stance

if TYPE_CHECKING:
    from soma_bullet.task.search.planning import Fetch, Planning
    from soma_bullet.task.workcell import Workcell


@dataclass(frozen=True, eq=False)
class Pick(Action):
    """A hand takes a piece from the table.

    Attributes:
        piece, arm, grasp: what, by which arm, by which grasp of the piece's table.
        width: distance between the pads [m]; opened: before it.
        q_before, q_pick, q_lifted: joints (n,) before the approach, at the grasp, after the lift.
    """

    piece: str
    arm: int
    grasp: int
    width: float
    opened: float
    q_before: Array
    q_pick: Array
    q_lifted: Array

    @property
    def identity(self) -> Identity:
        return "pick", self.piece, self.arm, self.grasp

    def steps(self, cell: Workcell, state: CellState) -> Steps:
        yield from close(cell, self.arm, self.piece, self.q_before, self.q_pick, self.width, self.opened)
        return (yield Step(LIFT, self.arm, self.piece, self.q_lifted, UP * cell.sizes.lift))


def close(
    cell: Workcell,
    arm: int,
    piece: str,
    q_before: Array,
    q_grasp: Array,
    width: float,
    opened: float | None = None,
) -> Steps:
    """From wherever an arm is to its hand closed on a piece, wherever that is."""
    opening = width + 2 * OPENING if opened is None else opened
    yield Step(TRANSIT, arm, piece, q_before, opening=opening)
    offset = tool_axis(cell, arm, q_grasp) * cell.hand(arm).way_out
    yield Step(APPROACH, arm, piece, q_grasp, offset)
    return (yield Step(GRASP, arm, piece, opening=0.0, duration=CLOSING, width=width))


# --- planning -----------------------------------------------------------------------------------------------


class AloneKey(NamedTuple):
    """Of the picks that an arm can make if the others are out of the way."""

    placed: frozenset[str]
    piece: str
    spot: Spot
    arm: int
    grip: Grip


class BesideKey(NamedTuple):
    """Of the pick that an arm can make beside the others."""

    alone: AloneKey
    stance: Stance


def candidates(
    planning: Planning, fetch: Fetch, spot: Spot, arm: int, grip: Grip
) -> list[tuple[Array, Array]]:
    """Approach and lift (m, n) of every branch that is free of table, stand, pieces and the arm itself."""
    key = AloneKey(fetch.state.placed, fetch.piece, spot, arm, grip)
    return planning.picks_alone.get(key, lambda: list(_alone(planning, fetch, spot, arm, grip)))


def _alone(
    planning: Planning, fetch: Fetch, spot: Spot, arm: int, grip: Grip
) -> Iterator[tuple[Array, Array]]:
    robot, lines = planning.robot, planning.lines
    T_pick = spot.pose @ grip.T_piece_tcp
    state = planning.workcell.idle(fetch.state.poses).gripping(arm, fetch.piece)
    arriving = opened_at(planning, fetch, state, spot, arm, grip, alone=True)
    leaving = carrying(planning, fetch, state, arm, grip, alone=True)
    solutions = robot.inverse(arm, T_pick, robot.home[arm])
    if not len(solutions):
        lines.refuse(fetch.piece, f"{robot.arm(arm).name} arm does not reach the feed")
    way_out, lift = planning.workcell.hand(arm).way_out, planning.sizes.lift
    for q in solutions:
        approach = lines.line("approach", arriving, q, T_pick, -T_pick[:3, 2], way_out)
        if approach is None:
            continue
        lifted = lines.line("lift", leaving, q, T_pick, UP, lift)
        if lifted is not None:
            yield approach, lifted


def check(planning: Planning, fetch: Fetch, spot: Spot, arm: int, grip: Grip) -> Pick | None:
    """How an arm picks the piece at a spot, the other arms being where they are."""
    alone = AloneKey(fetch.state.placed, fetch.piece, spot, arm, grip)
    key = BesideKey(alone, fetch.state.stance)
    return planning.picks.get(key, lambda: _beside(planning, fetch, spot, arm, grip))


def _beside(planning: Planning, fetch: Fetch, spot: Spot, arm: int, grip: Grip) -> Pick | None:
    lines, state = planning.lines, fetch.state.gripping(arm, fetch.piece)
    for approach, lift in candidates(planning, fetch, spot, arm, grip):
        arriving = opened_at(planning, fetch, state, spot, arm, grip)
        leaving = carrying(planning, fetch, state, arm, grip)
        if lines.free("approach", arriving, approach) and lines.free("lift", leaving, lift):
            joints = (readonly(q) for q in (approach[-1], approach[0], lift[-1]))
            opened = planning.opened(fetch.piece, spot, arm, grip)
            return Pick(fetch.piece, arm, grip.number, grip.width, opened, *joints)
    return None


def opened_at(
    planning: Planning,
    fetch: Fetch,
    state: CellState,
    spot: Spot,
    arm: int,
    grip: Grip,
    alone: bool = False,
) -> Mover:
    """An arm with its hand open at a piece that lies at a spot; `state` has that hand on the piece."""
    there = state.moved(fetch.piece, spot.pose)
    scene = planning.lines.scene(there, arm, fetch.piece, spot, alone=alone)
    width = planning.opened(fetch.piece, spot, arm, grip)
    return Mover(fetch.piece, arm, scene, there, width, grip)


def carrying(
    planning: Planning, fetch: Fetch, state: CellState, arm: int, grip: Grip, alone: bool = False
) -> Mover:
    """An arm with the piece near the table; `state` has its hand on the piece."""
    moving = state.carrying(arm, inverse(grip.T_piece_tcp))
    scene = planning.lines.scene(moving, arm, fetch.piece, kind=LIFT, alone=alone)
    return Mover(fetch.piece, arm, scene, moving, grip.width, grip)
