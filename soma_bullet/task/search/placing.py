"""How the piece of a step goes into its place: by which grasps and along which lines, and what changes hands
afterwards."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from soma_bullet.frames import Indices, Mask, inverse
from soma_bullet.grasp.clearance import MARGIN, hand_hulls
from soma_bullet.task.actions import hold, insert
from soma_bullet.task.actions.action import Action
from soma_bullet.task.actions.insert import Candidate, Insert
from soma_bullet.task.actions.pick import Pick
from soma_bullet.task.schedule import Assignment
from soma_bullet.task.search.changes import Changes
from soma_bullet.task.search.planning import Planning
from soma_bullet.task.state import CellState


@dataclass(frozen=True, eq=False)
class Placing:
    """The end of a step: how the piece goes in, and what happens afterwards.

    Attributes:
        candidate: arm and grip; insert: the insertion.
        changes: of holds; after: the state then, idle arms at home.
    """

    candidate: Candidate
    insert: Insert
    changes: tuple[Action, ...]
    after: CellState


class Placer:
    """Puts pieces in their places, step by step of a plan."""

    def __init__(self, planning: Planning, changes: Changes):
        self.planning, self.changes = planning, changes

    def refused(self, k: int, candidate: Candidate) -> bool:
        """Whether a later stage has ruled an arm and a grasp out for a step."""
        index = candidate.grip.index
        assert index is not None
        identity = "insert", self.planning.plan.steps[k].piece, candidate.arm, index
        return (k, identity, ()) in self.planning.excluded.steps

    def ruled_out(self, assignment: Assignment) -> bool:
        """Whether a later stage has ruled out a way to do a step."""
        excluded, own = self.planning.excluded.steps, assignment.insert.identity
        chain = identities(assignment)
        return (assignment.step, own, ()) in excluded or (assignment.step, own, chain) in excluded

    def chosen(self, k: int, state: CellState) -> Indices:
        """Grasps of the step's piece that serve at the goal, while it is held, and beside the hands that
        hold."""
        step, lines = self.planning.plan.steps[k], self.planning.lines
        indices = self.planning.allowed(k)
        if not len(indices):
            lines.refuse(step.piece, "no accessible grasp" + (" that may hold it" if step.holds else ""))
            return indices
        clear = self._clear_of_holders(k, state, indices)
        met = int((~clear).sum())
        lines.refuse(step.piece, "hand meets a holding hand or a placed piece on its way in", met)
        return indices[clear]

    def _clear_of_holders(self, k: int, state: CellState, indices: Indices) -> Mask:
        """Whether the hand, swept along the insertion, keeps clear of placed pieces and of the hands that
        hold."""
        planning, cell = self.planning, self.planning.workcell
        step = planning.plan.steps[k]
        graph, way = planning.graph(step.piece), insert.insertion(planning, k)
        goal = cell.goals[step.piece]
        sweep = graph.sweep(goal, indices, way_out=0.0, sweep=way.sweep()[-1])
        obstacles = []
        for name in sorted(state.placed, key=planning.plan.order.index):
            obstacles += [part.moved(cell.goals[name]) for part in cell.body(name).parts]
        clear = np.asarray(sweep.separation(obstacles) > 0.0)
        leaving = graph.sweep(goal, indices)
        for arm, piece in state.held.items():
            T_piece_tcp = inverse(cell.settled[piece]) @ planning.robot.tcp(arm, state.qs[arm])
            holder = hand_hulls(cell.hand(arm), cell.goals[piece] @ T_piece_tcp, float(state.openings[arm]))
            clear &= (sweep.separation(holder) > MARGIN) & (leaving.separation(holder) > MARGIN)
        return clear

    def check(
        self, k: int, state: CellState, candidate: Candidate, picked: Action | None = None
    ) -> Placing | None:
        """Insertion, soon after the pick if there is one, and what follows it; or None with the refusal
        counted."""
        planning, step, certificate = self.planning, self.planning.plan.steps[k], None
        if any(planned.piece == step.piece and not planned.taken for planned in step.holds):
            certificate = hold.holds(planning, k, step.piece, candidate.arm, candidate.grip)
            if certificate is None:
                return None
        if isinstance(picked, Pick):
            lines = insert.nearest(planning, k, candidate, picked.q_lifted)
        else:
            lines = insert.candidates(planning, k, candidate)
        for line in lines:
            if not insert.check(planning, k, state, candidate, line):
                continue
            made = insert.made(planning, k, candidate, line, certificate)
            changed = self.changes.settle(
                k, made.effects(planning.workcell, _in_hand(state, made, candidate))
            )
            if changed is not None:
                return Placing(candidate, made, *changed)
            break
        return None


def _in_hand(state: CellState, made: Insert, candidate: Candidate) -> CellState:
    """The state in which an arm has the piece in its hand, ready to insert it."""
    arm, grip = candidate.arm, candidate.grip
    state = state.with_arm(arm, made.q_ready, grip.width).gripping(arm, made.piece)
    return state.carrying(arm, inverse(grip.T_piece_tcp))


def identities(assignment: Assignment) -> tuple[tuple[str | int, ...], ...]:
    """What tells the regrasps of a step from others, and how they get the piece."""
    last = len(assignment.bring) - 1 if assignment.pick is not None else len(assignment.bring)
    return tuple(action.identity for action in assignment.bring[:last])
