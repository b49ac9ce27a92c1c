"""Push: a hand pushes a piece a short way along the table with closed fingers.

An action that the package does not have, as its user would write it: this file is all there is of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from soma_bullet.frames import Array, apply, inverse, make_transform, readonly, translate
from soma_bullet.grasp.clearance import sweep_hand
from soma_bullet.motion.timing import HandLimits
from soma_bullet.task.actions.action import Action, Identity, Step, Steps
from soma_bullet.task.kinds import APPROACH, RETREAT, TRANSIT, Doing, Kind
from soma_bullet.task.lines import Mover, Spot
from soma_bullet.task.posture import posture_cost
from soma_bullet.task.search.planning import Fetch, Planning
from soma_bullet.task.state import CellState
from soma_bullet.task.workcell import Workcell

LEVEL = 1e-3  # upward part of the normal of a face that stands upright
RUN_UP = 0.03  # [m] from where a hand starts towards a piece, and back from it
ABOVE = 3e-3  # [m] kept between the tips of the fingers and the table
TOUCHING, NEARER = 1e-6, 100  # [m] so near the fingers are at a piece, after so many steps towards it at most
GENTLE = HandLimits(0.05, 0.2)  # [m/s], [m/s2]


def _touched(cell: Workcell, state: CellState, doing: Doing) -> CellState:
    """The piece goes where the hand goes from then on."""
    arm, piece = doing.arm, doing.piece
    T_tcp_piece = inverse(cell.robot.tcp(arm, state.qs[arm])) @ state.poses[piece]
    return state.gripping(arm, piece).carrying(arm, T_tcp_piece)


def _pushed(cell: Workcell, state: CellState, doing: Doing) -> CellState:
    """The piece stays where it is."""
    return state.carrying(doing.arm, None)


TOUCH = Kind("touch", "wait", at_piece=True, fetches=True, change=_touched)
PUSH = Kind("push", "line", GENTLE, touches="table", carries=True, fetches=True, change=_pushed)


@dataclass(frozen=True, eq=False)
class Push(Action):
    """A hand pushes a piece along the table.

    Attributes:
        piece, arm, face: what, by which arm, and the number of the face that is pushed against.
        offset: by which the piece moves (3,) [m].
        q_before, q_touch, q_pushed, q_away: joints (n,) before the approach, at the piece, where it is left,
            and back from there.
    """

    piece: str
    arm: int
    face: int
    offset: Array
    q_before: Array
    q_touch: Array
    q_pushed: Array
    q_away: Array

    @property
    def identity(self) -> Identity:
        return "push", self.piece, self.arm, self.face

    @property
    def regrasps(self) -> bool:
        return True

    def steps(self, cell: Workcell, state: CellState) -> Steps:
        who, run_up = (self.arm, self.piece), RUN_UP * self.offset / np.linalg.norm(self.offset)
        yield Step(TRANSIT, *who, self.q_before, opening=0.0)
        yield Step(APPROACH, *who, self.q_touch, run_up)
        yield Step(TOUCH, *who)
        yield Step(PUSH, *who, self.q_pushed, self.offset)
        return (yield Step(RETREAT, *who, self.q_away, -run_up))


def ways(cell: Workcell, piece: str, pose: Array) -> Array:
    """Unit vectors (n, 3) in which a piece may be pushed: into its faces that stand upright, each once."""
    normals = np.array([facet.normal for facet in cell.body(piece).facets]) @ pose[:3, :3].T
    upright = -normals[np.abs(normals[:, 2]) < LEVEL] * (1.0, 1.0, 0.0)
    return np.array([n for k, n in enumerate(upright) if (upright[:k] @ n < 1.0 - LEVEL).all()]).reshape(
        -1, 3
    )


# --- planning -----------------------------------------------------------------------------------------------


def candidates(planning: Planning, fetch: Fetch) -> list[tuple[int, int]]:
    """Arms and faces to push against, the most comfortable first."""
    cell, piece, pose = planning.workcell, fetch.piece, fetch.source.pose

    def cost(candidate: tuple[int, int]) -> float:
        T = behind(cell, piece, pose, *candidate)
        return np.inf if T is None else round(float(posture_cost(planning.robot, candidate[0], T)), 9)

    faces = range(len(ways(cell, piece, pose)))
    return sorted(((arm, face) for arm in fetch.free for face in faces), key=cost)


def check(planning: Planning, fetch: Fetch, arm: int, face: int, length: float) -> Push | None:
    """How an arm pushes the piece by so much [m]; None with the refusal counted."""
    lines, robot, piece, pose = planning.lines, planning.robot, fetch.piece, fetch.source.pose
    T, way = behind(planning.workcell, piece, pose, arm, face), ways(planning.workcell, piece, pose)[face]
    if T is None:
        lines.refuse(piece, "fingers do not reach the face that they should push against")
        return None
    solutions = robot.inverse(arm, T, robot.home[arm])
    if not len(solutions):
        lines.refuse(piece, f"{robot.arm(arm).name} arm does not reach behind it")
    end, left = translate(T, length * way), Spot(translate(pose, length * way))
    there = fetch.state.moved(piece, pose).gripping(arm, piece)
    for q in solutions:
        arriving = Mover(piece, arm, lines.scene(there, arm, piece, fetch.source), there, 0.0)
        before = lines.line("approach to push", arriving, q, T, -way, RUN_UP)
        if before is None:
            continue
        taken = there.carrying(arm, inverse(T) @ pose)
        pushing = Mover(piece, arm, lines.scene(taken, arm, piece, kind=PUSH), taken, 0.0)
        pushed = lines.line("push", pushing, q, T, way, length)
        if pushed is None:
            continue
        moved = there.moved(piece, left.pose)
        leaving = Mover(piece, arm, lines.scene(moved, arm, piece, left), moved, 0.0)
        away = lines.line("retreat from a push", leaving, pushed[-1], end, -way, RUN_UP)
        if away is not None:
            joints = (readonly(q) for q in (before[-1], q, pushed[-1], away[-1]))
            return Push(piece, arm, face, readonly(length * way), *joints)
    return None


def behind(cell: Workcell, piece: str, pose: Array, arm: int, face: int) -> Array | None:
    """T_world_tcp (4, 4) of a closed hand that reaches straight down to a face of a piece; None where its
    fingers go past."""
    hand, body, way = cell.hand(arm), cell.body(piece), ways(cell, piece, pose)[face]
    down = np.array((0.0, 0.0, -1.0))
    tips = max(float(box.T[2, 3] + np.abs(box.T[2, :3]) @ box.half) for box in hand.boxes(0.0))
    centre = apply(pose, body.center_of_mass) * (1.0, 1.0, 0.0) + (0.0, 0.0, tips + ABOVE)
    far = 2 * body.radius
    T = make_transform(np.column_stack([np.cross(way, down), way, down]), centre - far * way)
    parts, come = [part.moved(pose) for part in body.body_parts], 0.0
    for _ in range(NEARER):  # no farther than there is room
        gap = float(
            sweep_hand(hand, translate(T, come * way)[None], np.zeros(1), 0.0, 0.0).separation(parts)[0]
        )
        if gap < TOUCHING:
            return translate(T, come * way)
        come += gap
        if come > 2 * far:
            break
    return None
