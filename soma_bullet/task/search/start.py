"""Where a search begins: what is in place, what hands hold and carry, what is laid down before all else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from soma_bullet.frames import inverse, readonly
from soma_bullet.grasp.graph import Grip
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.task.actions import put_down
from soma_bullet.task.actions.action import Action
from soma_bullet.task.actions.put_down import PutDown
from soma_bullet.task.posture import posture_cost
from soma_bullet.task.search.changes import Changes
from soma_bullet.task.search.planning import Fetch, Planning
from soma_bullet.task.state import CellState

PLACES = 12  # that are tried for one resting pose of a piece that is laid down


@dataclass(frozen=True, eq=False)
class StartState:
    """What there is before the first step.

    Attributes:
        state: what is where; arms that hold nothing in place count as at home, also those that carry
            something.
        changes: of holds, where the state as found asks for them.
        carrying: arm and grip of the piece of the first step, if a hand has it.
        stowed: how what else hands carry is laid down, one after the other.
    """

    state: CellState
    changes: tuple[Action, ...] = ()
    carrying: tuple[int, Grip] | None = None
    stowed: tuple[PutDown, ...] = ()


def first_step(plan: AssemblyPlan, state: CellState | None) -> int:
    """The step of a plan that comes first in a state: all before it are done."""
    if state is None:
        return 0
    steps = plan.steps
    return next((k for k, step in enumerate(steps) if step.piece not in state.placed), len(steps))


def start_state(planning: Planning, changes: Changes, found: CellState | None, stowed: bool) -> StartState:
    """Where a search begins, all pieces on the table or from a state as found.

    Args:
        found: the state; None where nothing is in place yet, and hands are empty.
        stowed: what hands carry has been laid down already.

    Raises:
        NoSolutionError: the hands cannot go on from how they hold, or lay down what they have.
    """
    if found is None:
        return StartState(planning.empty(0))
    state, actions = _standing(planning, found), tuple[Action, ...]()
    if planning.first:
        changed = changes.settle(planning.first - 1, state)
        if changed is None:
            raise planning.lines.refusals.error("schedule", "the hands cannot go on from how they hold")
        actions, state = changed
    if stowed or not found.carried:
        return StartState(state, actions)
    return StartState(state, actions, *_in_hands(planning, found, state))


def _standing(planning: Planning, found: CellState) -> CellState:
    """What is in place and held; arms that hold nothing in place count as at home."""
    poses = {**found.poses, **planning.standing(planning.first)}
    state = replace(found, poses=poses, gripped=found.held, carried={})
    return state.empty_handed(planning.robot.home)


def _in_hands(
    planning: Planning, found: CellState, standing: CellState
) -> tuple[tuple[int, Grip] | None, tuple[PutDown, ...]]:
    """The piece of the first step in its hand, and how the others are laid down."""
    kept: tuple[int, Grip] | None = None
    state, later = standing, list[tuple[int, str, Grip]]()
    for arm in sorted(found.carried):
        piece, grip = found.gripped[arm], _grip(planning, found, arm)
        if piece == planning.plan.steps[planning.first].piece:
            kept = arm, grip
        else:
            later.append((arm, piece, grip))
        if len(found.carried) > 1:  # it stands still with what it has while another lays something down
            state = state.with_arm(arm, found.qs[arm], grip.width).gripping(arm, piece)
    puts: tuple[PutDown, ...] = ()
    for arm, piece, grip in later:
        state = state.gripping(arm, None)
        source = planning.spots[piece]
        fetch = Fetch(piece, source, state.with_arm(arm, planning.robot.home[arm], 0.0), (arm, grip))
        puts = (*puts, _put_down(planning, fetch, puts))
        state = fetch.state.moved(piece, puts[-1].pose_down)
    return kept, puts


def _grip(planning: Planning, found: CellState, arm: int) -> Grip:
    """How a hand has what it carries."""
    graph, T_piece_tcp = planning.graph(found.gripped[arm]), inverse(found.carried[arm])
    index, _, _ = graph.nearest(T_piece_tcp, planning.usable(found.gripped[arm], arm))
    return Grip(index, readonly(T_piece_tcp), float(found.openings[arm]), float(graph.contact[index]))


def _put_down(planning: Planning, fetch: Fetch, before: Sequence[PutDown]) -> PutDown:
    """How an arm lays down what it carries, after others have done so."""
    assert fetch.carrying is not None
    arm, grip = fetch.carrying
    for rest in range(len(planning.graph(fetch.piece).resting)):
        spots = put_down.places(planning, fetch, rest)
        Ts = np.array([spot.pose for spot in spots]).reshape(-1, 4, 4) @ grip.T_piece_tcp
        cost = posture_cost(planning.robot, arm, Ts)
        for n in np.argsort(np.round(cost, 9), kind="stable")[:PLACES]:
            put = put_down.check(planning, fetch, arm, grip, spots[n])
            if put is None:
                continue
            if tuple(p.identity for p in (*before, put)) not in planning.excluded.beginnings:
                return put
    reason = f"{fetch.piece} is in a hand and can be put down nowhere"
    raise planning.lines.refusals.error("schedule", reason)
