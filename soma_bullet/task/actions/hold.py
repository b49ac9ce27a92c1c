"""Hold: a free hand takes hold of a piece that stands in place, and keeps it there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from soma_bullet.frames import Array, readonly
from soma_bullet.grasp.clearance import OPENING
from soma_bullet.grasp.graph import Grip
from soma_bullet.planner.assembly_plan import Hold as PlannedHold
from soma_bullet.planner.assist import SMALLEST_MARGIN, HoldCertificate, certify_hold
from soma_bullet.planner.equilibrium import FIRM
from soma_bullet.task.actions.action import Action, Identity, Steps
from soma_bullet.task.actions.pick import close
from soma_bullet.task.lines import Mover
from soma_bullet.task.posture import posture_cost, spread
from soma_bullet.task.state import CellState

if TYPE_CHECKING:
    from soma_bullet.task.search.planning import Planning
    from soma_bullet.task.workcell import Workcell

TAKES = 40  # grasps that are tried to take a piece in place


@dataclass(frozen=True, eq=False)
class Hold(Action):
    """A free hand takes hold of a piece that stands in place.

    Attributes:
        arm, piece, grasp: which hand, what, by which grasp of the piece's table.
        width: distance between the pads [m].
        q_before, q_hold: joints (n,) before the approach and at the grasp.
        certificate: of the hold.
    """

    arm: int
    piece: str
    grasp: int
    width: float
    q_before: Array
    q_hold: Array
    certificate: HoldCertificate

    @property
    def identity(self) -> Identity:
        return "hold", self.piece, self.arm, self.grasp

    def steps(self, cell: Workcell, state: CellState) -> Steps:
        return (yield from close(cell, self.arm, self.piece, self.q_before, self.q_hold, self.width))


# --- planning -----------------------------------------------------------------------------------------------


class CertificateKey(NamedTuple):
    """Of what a hold by an arm's hand can take after a step."""

    step: int
    piece: str
    arm: int
    grip: Grip


def certificate(planning: Planning, k: int, piece: str, arm: int, grip: Grip) -> HoldCertificate:
    """What a hold on a piece in place by an arm's hand can take after step k."""

    def make() -> HoldCertificate:
        assembly, steps = planning.workcell.assembly, planning.plan.steps
        following = steps[k + 1] if k + 1 < len(steps) else None
        placed = frozenset(assembly.index(s.piece) for s in steps[: k + 1])
        held = assembly.index(piece)
        return certify_hold(
            assembly,
            planning.workcell.hand(arm),
            placed,
            held,
            assembly.goals[held] @ grip.T_piece_tcp,
            "dropped" if steps[k].verdict in FIRM else "frictionless",
            None if following is None else assembly.index(following.piece),
            None if following is None else np.array(following.direction),
            planning.plan.options.load,
            grip.contact,
        )

    return planning.certificates.get(CertificateKey(k, piece, arm, grip), make)


def holds(planning: Planning, k: int, piece: str, arm: int, grip: Grip) -> HoldCertificate | None:
    """The certificate of a hold after step k, None where it would slip."""
    found = certificate(planning, k, piece, arm, grip)
    if found.margin >= SMALLEST_MARGIN:
        return found
    about = planning.plan.steps[k].piece
    on = "the hold" if about == piece else f"the hold on {piece}"
    planning.lines.refuse(about, f"{on} would slip (margin below {SMALLEST_MARGIN:g})")
    return None


def candidates(planning: Planning, k: int, state: CellState, hold: PlannedHold) -> Iterator[tuple[int, Grip]]:
    """Free arms and grips by which they may take a piece, the most comfortable first."""
    if not state.free:
        planning.lines.refuse(planning.plan.steps[k].piece, f"no hand is free to take {hold.piece}")
    graph, indices = planning.graph(hold.piece), np.array(sorted(hold.grasps), int)
    for arm in state.free:
        mine = indices[planning.usable(hold.piece, arm)[indices]]
        Ts = state.poses[hold.piece] @ graph.poses[mine]
        cost = posture_cost(planning.robot, arm, Ts) - (mine == hold.grasp)
        for g in spread(graph.poses, mine, cost)[:TAKES]:
            yield arm, graph.grip(g)


def check(planning: Planning, k: int, state: CellState, piece: str, arm: int, grip: Grip) -> Hold | None:
    """How a free arm takes hold of a piece in place after step k."""
    proof = holds(planning, k, piece, arm, grip)
    if proof is None:
        return None
    robot, about = planning.robot, planning.plan.steps[k].piece
    gripping = state.gripping(arm, piece)
    scene = planning.lines.scene(gripping, arm, about)
    T = state.poses[piece] @ grip.T_piece_tcp
    mover = Mover(about, arm, scene, gripping, grip.width + 2 * OPENING, grip)
    way_out = planning.workcell.hand(arm).way_out
    for q in robot.inverse(arm, T, robot.home[arm]):
        line = planning.lines.line(f"approach to hold {piece}", mover, q, T, -T[:3, 2], way_out)
        if line is not None:
            joints = readonly(line[-1]), readonly(line[0])
            return Hold(arm, piece, grip.number, grip.width, *joints, proof)
    return None
