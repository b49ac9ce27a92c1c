"""Candidates of a step, cheapest first: arms and grasps that serve where the piece is and at the goal."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from soma_bullet.frames import Indices
from soma_bullet.task.actions import insert, pick
from soma_bullet.task.actions.insert import Candidate
from soma_bullet.task.posture import bearings, posture_cost, spread
from soma_bullet.task.search.arm_assignment import Option
from soma_bullet.task.search.chains import Chain, Regrasps, chains
from soma_bullet.task.search.options import awkwardness
from soma_bullet.task.search.planning import Fetch, Planning

LOOKED_AT = 12  # as many candidates as are wanted are looked at before the piece is regrasped instead
PREPARED = 6  # goal grasps, twice, for which a piece is laid down before the first step
PREPARATIONS: tuple[Regrasps, ...] = (("put down",), ("hand over", "put down"), ("put down", "put down"))
NEAREST, STRAIGHTEST = (
    4e-3,
    np.deg2rad(8.0),
)  # [m], [rad] a carried piece sits in one of its grasps within this
Bearing = tuple[float, ...]


def bearing(candidate: Candidate) -> Bearing:
    """The arm, and the direction from which its hand has the piece."""
    return candidate.arm, *bearings(candidate.grip.T_piece_tcp[None])[0]


def candidates(
    planning: Planning, k: int, fetch: Fetch, chosen: Indices, width: int, ranked: Sequence[Option]
) -> Iterator[Candidate]:
    """Grasps that serve where the piece is and at the goal, with arms: the options, then of every direction
    one.

    Args:
        chosen: grasps that serve at the goal; width: how many candidates; ranked: the options.
    """
    if fetch.carrying is not None:
        yield from _carried(planning, k, fetch)
        return
    graph = planning.graph(fetch.piece)
    clear = planning.clear_at(fetch, fetch.source)[chosen]
    touched = int((~clear).sum())
    planning.lines.refuse(fetch.piece, "hand touches the table or a piece at the feed", touched)
    indices = chosen[clear]
    indices = indices[np.argsort(np.round(awkwardness(planning, fetch, indices), 9), kind="stable")]
    groups: dict[Bearing, list[Candidate]] = {}  # each may fail as a whole
    usable = {arm: planning.usable(fetch.piece, arm) for arm in _arms(fetch, ranked, fetching=True)}
    for g, direction in zip(indices.tolist(), bearings(graph.poses[indices]), strict=True):
        for arm, mine in usable.items():
            if mine[g]:
                groups.setdefault((arm, *direction), []).append(Candidate(arm, graph.grip(g)))
    found = 0
    first = _first_of(ranked, True, fetch, indices)
    for candidate in _distinct(itertools.chain(first, _in_turn(groups.values())))[: LOOKED_AT * width]:
        arm, grip = candidate.arm, candidate.grip
        if insert.candidates(planning, k, candidate) and pick.candidates(
            planning, fetch, fetch.source, arm, grip
        ):
            yield candidate
            found += 1
            if found == width:
                return


def at_goal(planning: Planning, fetch: Fetch, indices: Indices, ranked: Sequence[Option]) -> list[Candidate]:
    """Candidates to insert the piece, whatever brings it: the options, then the best contact of every
    direction."""
    graph, goal = planning.graph(fetch.piece), planning.workcell.settled[fetch.piece]
    turns = []
    for arm in _arms(fetch, ranked, fetching=False):
        mine = indices[planning.usable(fetch.piece, arm)[indices]]
        cost = posture_cost(planning.robot, arm, goal @ graph.poses[mine]) + 2 * (1 - graph.contact[mine])
        turns.append([Candidate(arm, graph.grip(g)) for g in spread(graph.poses, mine, cost)])
    return _distinct(itertools.chain(_first_of(ranked, False, fetch, indices), _in_turn(turns)))


def prepared(planning: Planning, k: int, fetch: Fetch) -> Iterator[Chain]:
    """Ways to lay the piece of step k down so that a grasp for its goal serves."""
    graph, chosen = planning.graph(fetch.piece), planning.allowed(k)
    goal, turns = planning.workcell.settled[fetch.piece], []
    for arm in fetch.free:
        mine = chosen[planning.usable(fetch.piece, arm)[chosen]]
        cost = posture_cost(planning.robot, arm, goal @ graph.poses[mine]) - graph.contact[mine]
        turns.append([Candidate(arm, graph.grip(g)) for g in spread(graph.poses, mine, cost)])
    looked_at = list(_in_turn(turns))[: LOOKED_AT * PREPARED]
    usable = [c for c in looked_at if insert.candidates(planning, k, c)][: 2 * PREPARED]
    for regrasps in PREPARATIONS:
        for candidate in usable:
            ways = chains(planning, fetch, candidate.arm, candidate.grip, regrasps)
            for chain in itertools.islice(ways, 1):
                yield chain[:-1]  # the last pick comes later


def _carried(planning: Planning, k: int, fetch: Fetch) -> Iterator[Candidate]:
    """The piece goes in by the grip that an arm has of it, if that is one of those that serve."""
    assert fetch.carrying is not None
    arm, grip = fetch.carrying
    usable = planning.usable(fetch.piece, arm)
    index, off, turned = planning.graph(fetch.piece).nearest(grip.T_piece_tcp, usable)
    if index in planning.plan.steps[k].grasps and off < NEAREST and turned < STRAIGHTEST:
        yield Candidate(arm, grip)
    else:
        planning.lines.refuse(fetch.piece, "it sits in the hand as no grasp for the goal has it")


def _first_of(ranked: Sequence[Option], direct: bool, fetch: Fetch, indices: Indices) -> list[Candidate]:
    """Candidates of the options, among some grasps and the free arms: as they are, or as what inserts after
    regrasps."""
    chosen = set(indices.tolist())
    serving = [o for o in ranked if o.grip.index in chosen and o.inserter in fetch.free]
    return _distinct(Candidate(o.inserter, o.grip) for o in serving if not direct or o.fetcher == o.inserter)


def _arms(fetch: Fetch, ranked: Sequence[Option], fetching: bool) -> list[int]:
    """Free arms, the one first that is to fetch the piece of a step, or to insert it."""
    wished = [o.fetcher if fetching else o.inserter for o in ranked]
    return sorted(fetch.free, key=lambda arm: wished.index(arm) if arm in wished else len(wished))


def _in_turn(groups: Iterable[Sequence[Candidate]]) -> Iterator[Candidate]:
    """The first of every group, then the second, and so on."""
    for turn in itertools.zip_longest(*groups):
        yield from (candidate for candidate in turn if candidate is not None)


def _distinct(found: Iterable[Candidate]) -> list[Candidate]:
    """The candidates, each arm and grasp once."""
    kept: dict[tuple[int, int | None], Candidate] = {}
    for candidate in found:
        kept.setdefault((candidate.arm, candidate.grip.index), candidate)
    return list(kept.values())
