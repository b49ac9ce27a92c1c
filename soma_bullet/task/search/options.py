"""A few promising options for each step: grasps of every direction that serve, with the arms that reach by
them."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np

from soma_bullet.frames import Array, Indices, apply
from soma_bullet.grasp.graph import Grip
from soma_bullet.task.actions import insert, pick
from soma_bullet.task.actions.insert import Candidate
from soma_bullet.task.posture import carrying_time, posture_cost, spread
from soma_bullet.task.search.arm_assignment import Option
from soma_bullet.task.search.planning import Fetch, Planning

OPTIONS = 4  # grasps for each arm
AWKWARD = 0.5  # [s] that the cost of a grasp counts as
BEYOND = 5.0  # cost of a grasp for each metre that the wrist is beyond the stand


def options(planning: Planning, k: int, fetch: Fetch) -> list[Option]:
    """Options of a step by grasps that serve at its goal: without regrasps where one also serves where the
    piece is."""
    if fetch.carrying is not None:
        return []
    allowed = planning.allowed(k)
    direct = allowed[planning.clear_at(fetch, fetch.source)[allowed]]
    made = _direct(planning, k, fetch, direct) if len(direct) else _indirect(planning, k, fetch, allowed)
    return list(made)


def _direct(planning: Planning, k: int, fetch: Fetch, indices: Indices) -> Iterator[Option]:
    cost = awkwardness(planning, fetch, indices)
    for arm in fetch.state.arms:
        for candidate, awkward in _best(planning, k, fetch, arm, indices, cost):
            fetching = _at_pick(planning, fetch, arm, candidate.grip)
            if fetching is not None:
                line = insert.nearest(planning, k, candidate, fetching[-1])[0]
                seconds = carrying_time(planning.robot, arm, fetching[-1], line[-1])
                yield _option(arm, candidate, AWKWARD * awkward + seconds, fetching, line)


def _indirect(planning: Planning, k: int, fetch: Fetch, indices: Indices) -> Iterator[Option]:
    """Where the piece changes hands on the way, or is put down; it is as if it were fetched by the steepest
    grasp."""
    graph, arms = planning.graph(fetch.piece), fetch.state.arms
    goal = planning.workcell.settled[fetch.piece] @ graph.poses[indices]
    at_pick = {arm: _steepest(planning, fetch, arm) for arm in arms}
    for arm in arms:
        cost = posture_cost(planning.robot, arm, goal) + 2 * (1 - graph.contact[indices])
        for candidate, awkward in _best(planning, k, fetch, arm, indices, cost):
            line = insert.candidates(planning, k, candidate)[0]
            for giver, fetching in at_pick.items():
                if fetching is not None and (giver != arm or len(arms) == 1):
                    yield _option(giver, candidate, AWKWARD * awkward, fetching, line)


def _steepest(planning: Planning, fetch: Fetch, arm: int) -> Array | None:
    """Joints (3, n) of an arm for a pick by the steepest grasp by which it can have the piece."""
    found = (_at_pick(planning, fetch, arm, grip) for grip in clear_grips(planning, fetch, arm))
    return next((joints for joints in found if joints is not None), None)


def _option(fetcher: int, candidate: Candidate, cost: float, fetching: Array, line: Array) -> Option:
    inserting = np.array([line[0], line[-1]])
    return Option(fetcher, candidate.arm, candidate.grip, cost, fetching, inserting)


def _best(
    planning: Planning, k: int, fetch: Fetch, arm: int, indices: Indices, cost: Array
) -> list[tuple[Candidate, float]]:
    """Candidates that have a free insertion, with their costs; of every direction of the hand the best one
    first."""
    graph, mine = planning.graph(fetch.piece), planning.usable(fetch.piece, arm)[indices]
    indices, cost = indices[mine], cost[mine]
    beyond = _beyond(planning, arm, planning.workcell.settled[fetch.piece] @ graph.poses[indices])
    ranked = spread(graph.poses, indices, cost + BEYOND * beyond)[: 3 * OPTIONS]
    costs = dict(zip(indices.tolist(), cost.tolist(), strict=True))
    found = (c for c in (Candidate(arm, graph.grip(g)) for g in ranked) if insert.candidates(planning, k, c))
    return [(c, costs[c.grip.number]) for c in islice(found, OPTIONS)]


def _at_pick(planning: Planning, fetch: Fetch, arm: int, grip: Grip) -> Array | None:
    """Joints (3, n) of an arm before a pick, at it and after it; None where it cannot pick."""
    picks = pick.candidates(planning, fetch, fetch.source, arm, grip)
    return np.array([picks[0][0][-1], picks[0][0][0], picks[0][1][-1]]) if picks else None


def _beyond(planning: Planning, arm: int, Ts_world_tcp: Array) -> Array:
    """How far [m] an arm has its wrist beyond the stand, seen from its base, with the hand at poses (n, 4,
    4)."""
    middle = planning.workcell.cell.stand_centre[:2]
    reach = planning.robot.reaches[arm]
    way = middle - planning.robot.arm(arm).T_world_base[:2, 3]
    wrists = Ts_world_tcp[:, :2, 3] - reach.wrist * Ts_world_tcp[:, :2, 2]
    return np.maximum((wrists - middle) @ (way / max(float(np.linalg.norm(way)), 1e-9)) + reach.own_side, 0.0)


def clear_grips(planning: Planning, fetch: Fetch, arm: int) -> list[Grip]:
    """Grips by which an arm's hand may have the piece where it is, steepest first, of every direction one."""
    graph = planning.graph(fetch.piece)
    clear = planning.clear_at(fetch, fetch.source) & planning.usable(fetch.piece, arm)
    indices = np.flatnonzero(clear)
    return [graph.grip(g) for g in spread(graph.poses, indices, _tilt(planning, fetch, indices))]


def awkwardness(planning: Planning, fetch: Fetch, indices: Indices) -> Array:
    """Cost (n,) of picking the piece by some of its grasps where it is."""
    graph, source = planning.graph(fetch.piece), fetch.source.pose
    places = (source @ graph.poses[indices])[:, :3, 3]
    reach = np.linalg.norm(places - apply(source, graph.piece.center_of_mass), axis=1)
    aside = reach / planning.sizes.aside
    return np.asarray(aside + (1 - graph.contact[indices]) + 0.5 * _tilt(planning, fetch, indices))


def _tilt(planning: Planning, fetch: Fetch, indices: Indices) -> Array:
    tcp = fetch.source.pose @ planning.graph(fetch.piece).poses[indices]
    return np.asarray(np.arccos(np.clip(-tcp[:, 2, 2], -1, 1)))
