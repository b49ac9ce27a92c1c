"""Hand over: a hand gives a piece to another in the air."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from soma_bullet.frames import Array, apply, readonly
from soma_bullet.grasp.clearance import OPENING
from soma_bullet.grasp.graph import Grip
from soma_bullet.task.actions.action import Action, Identity, Step, Steps
from soma_bullet.task.actions.pick import carrying, close
from soma_bullet.task.actions.release import leave
from soma_bullet.task.kinds import TRANSFER
from soma_bullet.task.lines import Mover, Spot
from soma_bullet.task.places import meeting_poses
from soma_bullet.task.state import CellState, Stance

if TYPE_CHECKING:
    from soma_bullet.task.search.planning import Fetch, Planning
    from soma_bullet.task.workcell import Workcell

MEETINGS, BRANCHES = 6, 4  # that are tried for one pair of grasps, and joints of either arm there


@dataclass(frozen=True, eq=False)
class HandOver(Action):
    """A hand gives a piece that it has to another in the air.

    Attributes:
        piece, arm: what, and the arm that gives.
        meeting: number of the pose in which they meet, among those of these two grasps.
        q_meet: joints (n,) of the giver while the piece changes hands; q_clear: after its retreat.
        receiver, grasp, width: the arm that takes it, by which grasp of the piece's table, distance between
            its pads [m].
        q_before, q_take: joints (m,) of the receiver before its approach and at the grasp.
        pose_met: T_world_piece (4, 4) meanwhile.
    """

    piece: str
    arm: int
    meeting: int
    q_meet: Array
    q_clear: Array
    receiver: int
    grasp: int
    width: float
    q_before: Array
    q_take: Array
    pose_met: Array

    @property
    def identity(self) -> Identity:
        return "hand over", self.piece, self.arm, self.receiver, self.grasp, self.meeting

    @property
    def regrasps(self) -> bool:
        return True

    def steps(self, cell: Workcell, state: CellState) -> Steps:
        yield Step(TRANSFER, self.arm, self.piece, self.q_meet)
        state = yield from close(cell, self.receiver, self.piece, self.q_before, self.q_take, self.width)
        return (yield from leave(cell, state, self.arm, self.piece, self.q_clear))


# --- planning -----------------------------------------------------------------------------------------------


class MeetKey(NamedTuple):
    """Of the way in which two hands meet."""

    placed: frozenset[str]
    stance: Stance
    giver: int
    held: Grip
    arm: int
    grip: Grip


def candidates(
    planning: Planning, fetch: Fetch, arm: int, grip: Grip, before: tuple[str, ...]
) -> Iterator[tuple[int, Grip]]:
    """Arms that may give the piece to an arm that is to have it by a grip, and how they have it."""
    allowed = planning.graph(fetch.piece).together(grip.number)
    for giver in fetch.free:
        if giver != arm:
            for held in planning.givers(fetch, giver, allowed, before):
                yield giver, held


def check(planning: Planning, fetch: Fetch, giver: int, held: Grip, arm: int, grip: Grip) -> HandOver | None:
    """How an arm that has the piece by one grip gives it to another arm by another grip."""
    key = MeetKey(fetch.state.placed, fetch.state.stance, giver, held, arm, grip)
    return planning.hand_overs.get(key, lambda: _meet(planning, fetch, giver, held, arm, grip))


def _meet(planning: Planning, fetch: Fetch, giver: int, held: Grip, arm: int, grip: Grip) -> HandOver | None:
    piece, source = planning.graph(fetch.piece).piece, fetch.source.pose
    grasps = (held.T_piece_tcp, grip.T_piece_tcp)
    com = piece.center_of_mass
    poses = meeting_poses(planning.robot, (giver, arm), grasps, apply(source, com), com)
    for number, pose in enumerate(poses[:MEETINGS]):
        met = _meet_at(planning, fetch, Spot(pose, 0.0, (number,)), giver, held, arm, grip)
        if met is not None:
            return met
    planning.lines.refuse(fetch.piece, "no free pose to hand over")
    return None


def _meet_at(
    planning: Planning, fetch: Fetch, spot: Spot, giver: int, held: Grip, arm: int, grip: Grip
) -> HandOver | None:
    robot, lines, piece = planning.robot, planning.lines, fetch.piece
    T_give, T_take = spot.pose @ held.T_piece_tcp, spot.pose @ grip.T_piece_tcp
    gives = robot.inverse(giver, T_give, robot.home[giver])[:BRANCHES]
    takes = robot.inverse(arm, T_take, robot.home[arm])[:BRANCHES]
    if not len(gives) or not len(takes):
        return None
    giving = fetch.state.gripping(giver, piece)
    carried = carrying(planning, fetch, giving, giver, held)
    both = giving.gripping(arm, piece).moved(piece, spot.pose)
    ways = [planning.workcell.hand(k).way_out for k in (giver, arm)]
    for q_meet in gives:
        if not lines.free("hand-over", carried, q_meet[None]):
            continue
        waiting = both.with_arm(giver, q_meet, held.width)
        taking = lines.scene(waiting, arm, piece, spot)
        taker = Mover(piece, arm, taking, waiting, grip.width + 2 * OPENING, grip)
        for q_take in takes:
            name = "approach to a hand-over"
            approach = lines.line(name, taker, q_take, T_take, -T_take[:3, 2], ways[1])
            if approach is None:
                continue
            held_by_both = waiting.with_arm(arm, q_take, grip.width)
            leaving = lines.scene(held_by_both, giver, piece, spot)
            leaver = Mover(piece, giver, leaving, held_by_both, held.width + 2 * OPENING, held)
            name = "retreat from a hand-over"
            away = lines.line(name, leaver, q_meet, T_give, -T_give[:3, 2], ways[0])
            if away is not None:
                joints = [readonly(q) for q in (q_meet, away[-1], approach[-1], q_take)]
                return HandOver(
                    piece, giver, spot.name[0], joints[0], joints[1],
                    arm, grip.number, grip.width, joints[2], joints[3], readonly(spot.pose),
                )  # fmt: skip
    return None
