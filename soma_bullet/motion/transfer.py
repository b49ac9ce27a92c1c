"""Collision-free joint paths between two configurations of one arm.

A straight edge to the nearest goal first, then RRT-Connect (J. Kuffner, S. LaValle, ICRA 2000; OMPL), then
random shortcuts and blended corners. Bounded by a count of checks, never by a clock: the same seed gives the
same path."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from soma_bullet.frames import Array, readonly

EDGE_STEP = 0.02  # [rad] largest joint step between checked states
SHORTCUTS = 40  # attempts
LEAST_GAIN = 0.01  # of the path's length; a shortcut that would save less is not worth its checks
BLEND = 0.1  # [rad] radius of a blended corner
ROOM = 1.2  # [rad] the planner may leave the box of starts and goals by this

Check = Callable[[Array], bool]


class TransferError(Exception):
    """No path: `cause` is `start`, `goal` (in collision) or `budget` (none found within the checks)."""

    def __init__(self, cause: str, q: Array | None = None):
        super().__init__(cause)
        self.cause, self.q = cause, q


@dataclass(frozen=True)
class TransferOptions:
    """Budget of one search.

    Attributes:
        checks: collision checks after which the search gives up.
        seed: of the planner and of the shortcuts.
        step: largest joint step between checked states of an edge [rad].
    """

    checks: int = 40_000
    seed: int = 0
    step: float = EDGE_STEP


def edge_free(start: Array, end: Array, collides: Check, step: float = EDGE_STEP) -> bool:
    """Whether the straight joint edge between two configurations (6,) is free; its start is taken as
    checked."""
    count = max(1, int(np.ceil(np.abs(end - start).max() / step)))
    return not any(collides(q) for q in start + (end - start) * _far_halves_first(count))


@lru_cache(maxsize=1024)
def _far_halves_first(count: int) -> Array:
    """Places (count, 1) of the states along an edge, in an order in which a blocked edge is found soon."""
    order = sorted(range(1, count + 1), key=lambda k: k & -k, reverse=True)
    return readonly(np.array(order)[:, None] / count)


def plan_transfer(
    start: Array, goals: Array, lower: Array, upper: Array, collides: Check, options: TransferOptions
) -> Array:
    """Waypoints (m, 6) from `start` (6,) to one of `goals` (k, 6).

    Args:
        lower, upper: joint limits (6,) [rad].
        collides: whether a configuration (6,) is in collision.

    Raises:
        TransferError
    """
    if collides(start):
        raise TransferError("start", start)
    free = [goal for goal in goals if not collides(goal)]
    if not free:
        raise TransferError("goal", goals[0] if len(goals) else None)
    for goal in sorted(free, key=lambda g: float(np.abs(g - start).max())):
        if edge_free(start, goal, collides, options.step):
            return np.array([start, goal])
    path = _rrt_connect(start, np.array(free), lower, upper, collides, options)
    return _shortcut(path, collides, np.random.default_rng(options.seed), options.step)


def _rrt_connect(
    start: Array, goals: Array, lower: Array, upper: Array, collides: Check, options: TransferOptions
) -> Array:
    from ompl import base as ob
    from ompl import geometric as og
    from ompl import util as ou

    n = len(start)
    ou.noOutputHandler()
    ou.RNG.setSeed(max(options.seed, 1))  # zero would mean "any"
    space = ob.RealVectorStateSpace(n)
    bounds = ob.RealVectorBounds(n)
    low = np.maximum(np.vstack([goals, start]).min(axis=0) - ROOM, lower)
    high = np.minimum(np.vstack([goals, start]).max(axis=0) + ROOM, upper)
    for k in range(n):
        bounds.setLow(k, float(low[k]))
        bounds.setHigh(k, float(high[k]))
    space.setBounds(bounds)
    setup = og.SimpleSetup(space)
    information = setup.getSpaceInformation()
    spent = [0]

    def counted(q: Array) -> bool:
        spent[0] += 1
        return collides(q)

    class Edges(ob.MotionValidator):  # type: ignore[misc]
        def __init__(self, si: object):
            super().__init__(si)

        def checkMotion(self, a: object, b: object, last: object = None) -> bool:  # noqa: N802 (OMPL's name)
            return edge_free(np.array(a[0:n]), np.array(b[0:n]), counted, options.step)  # type: ignore[index]

    setup.setStateValidityChecker(lambda state: not counted(np.array(state[0:n])))
    information.setMotionValidator(Edges(information))
    state = space.allocState()
    for k in range(n):
        state[k] = float(start[k])
    setup.setStartState(state)
    region = ob.GoalStates(information)
    for goal in goals:
        target = space.allocState()
        for k in range(n):
            target[k] = float(goal[k])
        region.addState(target)
    setup.setGoal(region)
    setup.setPlanner(og.RRTConnect(information))
    setup.solve(ob.PlannerTerminationCondition(lambda: spent[0] > options.checks))
    if not setup.haveExactSolutionPath():
        raise TransferError("budget")
    return np.array([np.array(s[0:n]) for s in setup.getSolutionPath().getStates()])


def _shortcut(path: Array, collides: Check, rng: np.random.Generator, step: float) -> Array:
    """Replace random stretches by straight edges where those are free."""
    points = list(path)
    for _ in range(SHORTCUTS):
        if len(points) < 3:
            break
        lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        first, second = np.sort(rng.uniform(0, lengths[-1], 2))
        i, j = np.searchsorted(lengths, first, "right") - 1, np.searchsorted(lengths, second, "right") - 1
        j = min(j, len(points) - 2)
        if j <= i:
            continue
        a = points[i] + (points[i + 1] - points[i]) * (first - lengths[i]) / (lengths[i + 1] - lengths[i])
        b = points[j] + (points[j + 1] - points[j]) * (second - lengths[j]) / (lengths[j + 1] - lengths[j])
        saved = second - first - float(np.linalg.norm(b - a))
        if saved >= LEAST_GAIN * lengths[-1] and edge_free(a, b, collides, step):
            points = [*points[: i + 1], a, b, *points[j + 1 :]]
    return _without_crumbs(np.array(points), collides, step)


def _without_crumbs(path: Array, collides: Check, step: float) -> Array:
    """The path without close inner waypoints that a free edge can skip: they would make tight corners."""
    points = list(_without_repeats(path))
    k = 1
    while k < len(points) - 1:
        short = (
            min(np.abs(points[k] - points[k - 1]).max(), np.abs(points[k + 1] - points[k]).max()) < 2 * BLEND
        )
        if short and edge_free(points[k - 1], points[k + 1], collides, step):
            del points[k]
        else:
            k += 1
    return np.array(points)


def _without_repeats(path: Array) -> Array:
    keep = np.concatenate([[True], np.abs(np.diff(path, axis=0)).max(axis=1) > 1e-9])
    return path[keep]


def blend_corners(path: Array, collides: Check, radius: float = BLEND) -> Array:
    """Dense points (n, 6) of a path (m, 6) with every corner replaced by a parabola that stays free.

    A corner whose parabola collides is blended more tightly.
    """
    path = _without_repeats(path)
    pieces = [path[:1]]
    for before, corner, after in zip(path[:-2], path[1:-1], path[2:], strict=True):
        r = radius
        while True:
            a = corner + (before - corner) * min(0.5, r / np.linalg.norm(before - corner))
            b = corner + (after - corner) * min(0.5, r / np.linalg.norm(after - corner))
            t = np.linspace(0, 1, 11)[:, None]
            curve = (1 - t) ** 2 * a + 2 * t * (1 - t) * corner + t**2 * b
            if r < 1e-3 or not any(collides(q) for q in curve):
                break
            r /= 2
        pieces.append(curve)
    pieces.append(path[-1:])
    corners = _without_repeats(np.vstack(pieces))
    dense = [corners[:1]]
    for a, b in zip(corners[:-1], corners[1:], strict=True):
        count = max(1, int(np.ceil(np.abs(b - a).max() / EDGE_STEP)))
        dense.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return np.vstack(dense)
