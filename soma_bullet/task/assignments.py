"""The schedule as a value: for each step who brings the piece and how, who holds it, who lets go."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from soma_bullet.frames import Array
from soma_bullet.planner.assist import HoldCertificate
from soma_bullet.task.workcell import Hands


@dataclass(frozen=True, eq=False)
class Pick:
    """A hand takes a piece from the table.

    Attributes:
        piece, arm, grasp: what, by which arm, by which grasp of the piece's table.
        width: distance between the pads [m]; opened: before it.
        q_before, q_pick, q_lifted: joints (6,) before the approach, at the grasp, after the lift.
    """

    piece: str
    arm: int
    grasp: int
    width: float
    opened: float
    q_before: Array
    q_pick: Array
    q_lifted: Array


@dataclass(frozen=True, eq=False)
class Square:
    """A hand closes on a piece as it lies, opens again and goes back: that centres the piece between the pads
    and trues it up.

    Attributes:
        piece, arm: what, and by which arm.
        width: distance between the pads [m]; opened: before it.
        q_before, q_grasp: joints (6,) before the approach, and after the retreat; at the grasp.
    """

    piece: str
    arm: int
    width: float
    opened: float
    q_before: Array
    q_grasp: Array


@dataclass(frozen=True, eq=False)
class PutDown:
    """A hand puts a piece down on the table in another pose.

    Attributes:
        piece, arm: what, and the arm that has it.
        pick: how it got it, None where it has it already.
        q_over, q_down: joints (6,) over the place and at it; q_away: after the retreat.
        pose_down: T_world_piece (4, 4) there.
    """

    piece: str
    arm: int
    pick: Pick | None
    q_over: Array
    q_down: Array
    q_away: Array
    pose_down: Array


@dataclass(frozen=True, eq=False)
class HandOver:
    """A hand gives a piece to the other in the air.

    Attributes:
        piece, arm: what, and the arm that gives.
        pick: how it got it, None where it has it already.
        q_meet: joints (6,) of the giver while the piece changes hands; q_clear: after its retreat.
        receiver, grasp, width: the arm that takes it, by which grasp of the piece's table, distance between
            its pads [m].
        q_before, q_take: joints (6,) of the receiver before its approach and at the grasp.
        pose_met: T_world_piece (4, 4) meanwhile.
    """

    piece: str
    arm: int
    pick: Pick | None
    q_meet: Array
    q_clear: Array
    receiver: int
    grasp: int
    width: float
    q_before: Array
    q_take: Array
    pose_met: Array


Regrasp = PutDown | HandOver | Square


@dataclass(frozen=True, eq=False)
class Take:
    """A free hand takes hold of a piece that stands in place.

    Attributes:
        arm, piece, grasp: which hand, what, by which grasp of the piece's table.
        width: distance between the pads [m].
        q_before, q_hold: joints (6,) before the approach and at the grasp.
        after: how many of the step's releases come first.
        certificate: of the hold.
    """

    arm: int
    piece: str
    grasp: int
    width: float
    q_before: Array
    q_hold: Array
    after: int
    certificate: HoldCertificate


@dataclass(frozen=True, eq=False)
class Release:
    """A hand lets go of a piece in place and retreats.

    Attributes:
        arm, piece: index and name.
        q_end: joints (6,) at the end of the retreat.
    """

    arm: int
    piece: str
    q_end: Array


@dataclass(frozen=True, eq=False)
class Assignment:
    """One step of the schedule.

    Attributes:
        step: index of the plan's step.
        piece, arm, grasp: what is inserted, by which arm, by which grasp of the piece's table.
        width: distance between the pads [m]; opened: before the last grasp.
        regrasps: what brings the piece into reach of that grasp, or squares it, in this order.
        in_hand: the arm has the piece in that grasp already after them; it need not be picked.
        q_before: joints (6,) before the approach to the last grasp; q_pick: at it; q_lifted: after the lift.
        q_goal: joints at the goal (6,); q_ready: where the insertion starts.
        direction: unit assembly direction in the world (3,).
        length: of the insertion [m]; guarded: of its last, slow part.
        holds: piece -> arm after the step.
        takes: holds taken up on pieces in place.
        releases: in this order.
        certificate: of the hold that this grasp becomes, if it does.
    """

    step: int
    piece: str
    arm: int
    grasp: int
    width: float
    opened: float
    regrasps: tuple[Regrasp, ...]
    in_hand: bool
    q_before: Array
    q_pick: Array
    q_lifted: Array
    q_ready: Array
    q_goal: Array
    direction: Array
    length: float
    guarded: float
    holds: dict[str, int]
    takes: tuple[Take, ...]
    releases: tuple[Release, ...]
    certificate: HoldCertificate | None


@dataclass(frozen=True, eq=False)
class Schedule:
    """Who does what.

    Attributes:
        assignments: one for each step of the plan from the start on.
        takes, releases: of holds, before the first of them, where a state as found asks for it.
        rejections: how often each reason ruled out a grasp, an arm or a hold on the way.
    """

    assignments: tuple[Assignment, ...]
    rejections: dict[str, int]
    takes: tuple[Take, ...] = ()
    releases: tuple[Release, ...] = ()


@dataclass(frozen=True, eq=False)
class Carried:
    """A piece in a hand in the air: its name, the arm, T_tcp_piece (4, 4)."""

    piece: str
    arm: int
    T_tcp_piece: Array


@dataclass(frozen=True, eq=False)
class Start:
    """A state to go on from.

    Attributes:
        step: index of the first step that is still to be done; the pieces of the steps before it are in
            place.
        poses: T_world_piece (4, 4) of every piece, as found.
        hands: joints and openings, as found; `gripped` names the pieces in place that are held.
        carrying: what hands have in the air.
    """

    step: int
    poses: Mapping[str, Array]
    hands: Hands
    carrying: tuple[Carried, ...] = ()


def key(assignment: Assignment) -> tuple[object, ...]:
    """What tells one way to do a step from the others: step, arm, grasp, then its regrasps."""
    chain: list[object] = []
    for regrasp in assignment.regrasps:
        pick = None if isinstance(regrasp, Square) else regrasp.pick
        chain += [regrasp.piece, regrasp.arm, pick.grasp if pick is not None else -1, whereabouts(regrasp)]
    return assignment.step, assignment.arm, assignment.grasp, *chain


def way(prologue: Sequence[Regrasp]) -> tuple[object, ...]:
    """What tells some regrasps before the first step from others."""
    return ("prologue", *((r.piece, r.arm, whereabouts(r)) for r in prologue))


def whereabouts(regrasp: Regrasp) -> bytes:
    """Where a piece is left, or changes hands, or is squared."""
    if isinstance(regrasp, PutDown):
        return regrasp.pose_down.tobytes()
    return (regrasp.q_grasp if isinstance(regrasp, Square) else regrasp.pose_met).tobytes()
