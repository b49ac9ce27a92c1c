"""Put down: a hand puts a piece down on the table in another pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from soma_bullet.frames import Array, readonly
from soma_bullet.grasp.graph import Grip
from soma_bullet.task.actions.action import Action, Identity, Step, Steps
from soma_bullet.task.actions.pick import carrying, opened_at
from soma_bullet.task.actions.release import leave
from soma_bullet.task.kinds import LOWER, SET_DOWN, SETTLE, TRANSFER
from soma_bullet.task.lines import Spot
from soma_bullet.task.places import free_places
from soma_bullet.task.posture import posture_cost
from soma_bullet.task.segment import SETTLING, UP
from soma_bullet.task.state import CellState, Stance

if TYPE_CHECKING:
    from soma_bullet.task.search.planning import Fetch, Planning
    from soma_bullet.task.workcell import Workcell

PLACES = 6  # that are tried for one grasp


@dataclass(frozen=True, eq=False)
class PutDown(Action):
    """A hand puts a piece that it has down on the table in another pose.

    Attributes:
        piece, arm: what, and the arm that has it.
        place: what tells the place from others: numbers of the resting pose, of the place and of the yaw.
        q_over, q_down: joints (n,) over the place and at it; q_away: after the retreat.
        pose_down: T_world_piece (4, 4) there.
    """

    piece: str
    arm: int
    place: tuple[int, ...]
    q_over: Array
    q_down: Array
    q_away: Array
    pose_down: Array

    @property
    def identity(self) -> Identity:
        return "put down", self.piece, self.arm, *self.place

    @property
    def regrasps(self) -> bool:
        return True

    def steps(self, cell: Workcell, state: CellState) -> Steps:
        sizes, who = cell.sizes, (self.arm, self.piece)
        yield Step(TRANSFER, *who, self.q_over)
        yield Step(LOWER, *who, None, -UP * (sizes.lift - sizes.place))
        yield Step(SET_DOWN, *who, self.q_down, -UP * sizes.place)
        state = yield Step(SETTLE, *who, duration=SETTLING)
        return (yield from leave(cell, state, *who, self.q_away))


# --- planning -----------------------------------------------------------------------------------------------


class PlacesKey(NamedTuple):
    """Of the free places of a piece in one of its resting poses."""

    placed: frozenset[str]
    piece: str
    rest: int


class BroughtKey(NamedTuple):
    """Of the places to which a piece may be brought, so that an arm can have it by a grip there."""

    places: PlacesKey
    stance: Stance
    arm: int
    grip: Grip
    first: bool
    last: str


class PutDownKey(NamedTuple):
    """Of the way in which an arm puts a piece down at a spot."""

    placed: frozenset[str]
    stance: Stance
    arm: int
    grip: Grip
    spot: Spot


def places(planning: Planning, fetch: Fetch, rest: int) -> list[Spot]:
    """Free spots of the table for one resting pose of a piece."""
    graph, state = planning.graph(fetch.piece), fetch.state
    others = {name: pose for name, pose in state.poses.items() if name != fetch.piece}
    key = PlacesKey(state.placed, fetch.piece, rest)

    def make() -> list[Spot]:
        found = free_places(planning.workcell, graph.piece, graph.resting[rest], fetch.source.pose, others)
        return [Spot(pose, 0.0, (rest, *name)) for name, pose in found]

    return planning.places.get(key, make)


def candidates(
    planning: Planning, fetch: Fetch, rest: int, arm: int, grip: Grip, before: tuple[str, ...]
) -> list[tuple[Spot, int, Grip]]:
    """Where one resting pose can go, who brings it and how: the most comfortable for both hands, and near,
    first.

    Args:
        arm, grip: that are to have the piece there afterwards.
        before: the regrasps before this one.
    """
    places_key = PlacesKey(fetch.state.placed, fetch.piece, rest)
    key = BroughtKey(places_key, fetch.state.stance, arm, grip, not before, before[-1] if before else "")
    return planning.brought.get(key, lambda: _brought(planning, fetch, rest, arm, grip, before))


def _brought(
    planning: Planning, fetch: Fetch, rest: int, arm: int, grip: Grip, before: tuple[str, ...]
) -> list[tuple[Spot, int, Grip]]:
    spots = places(planning, fetch, rest)
    if not spots:
        planning.lines.refuse(fetch.piece, "no free place on the table")
        return []
    poses = np.array([spot.pose for spot in spots])
    near = np.linalg.norm(poses[:, :2, 3] - fetch.source.pose[:2, 3], axis=1)
    cost = near + posture_cost(planning.robot, arm, poses @ grip.T_piece_tcp)
    allowed = planning.graph(fetch.piece).serving[rest]
    found: list[tuple[float, int, int, Grip]] = []
    for giver in fetch.free:
        for held in planning.givers(fetch, giver, allowed, before):
            total = cost + posture_cost(planning.robot, giver, poses @ held.T_piece_tcp)
            best = np.argsort(np.round(total, 9), kind="stable")[:2]
            found += [(round(float(total[k]), 9), int(k), giver, held) for k in best]
    found.sort(key=lambda item: item[:3])
    return [(spots[k], giver, held) for _, k, giver, held in found[:PLACES]]


def check(planning: Planning, fetch: Fetch, arm: int, grip: Grip, spot: Spot) -> PutDown | None:
    """How an arm that has the piece puts it down at a spot."""
    key = PutDownKey(fetch.state.placed, fetch.state.stance, arm, grip, spot)
    return planning.put_downs.get(key, lambda: _put_down(planning, fetch, arm, grip, spot))


def _put_down(planning: Planning, fetch: Fetch, arm: int, grip: Grip, spot: Spot) -> PutDown | None:
    lines, robot = planning.lines, planning.robot
    T_down = spot.pose @ grip.T_piece_tcp
    state = fetch.state.gripping(arm, fetch.piece)
    leaving = opened_at(planning, fetch, state, spot, arm, grip)
    lowering = carrying(planning, fetch, state, arm, grip)
    way_out, lift = planning.workcell.hand(arm).way_out, planning.sizes.lift
    for q in robot.inverse(arm, T_down, robot.home[arm]):
        lower = lines.line("put-down", lowering, q, T_down, UP, lift)
        if lower is None:
            continue
        away = lines.line("retreat from a put-down", leaving, q, T_down, -T_down[:3, 2], way_out)
        if away is not None:
            over, down, clear = (readonly(q) for q in (lower[-1], lower[0], away[-1]))
            return PutDown(fetch.piece, arm, spot.name, over, down, clear, readonly(spot.pose))
    return None
