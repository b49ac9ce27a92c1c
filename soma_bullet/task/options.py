"""A few promising options for each step: grasps of every direction that serve, with the arms that reach by
them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from soma_bullet.frames import Array, Indices, apply
from soma_bullet.robot.kinematics import Robot
from soma_bullet.task.fetch import Fetcher, View
from soma_bullet.task.motions import CARRYING
from soma_bullet.task.spots import comfort, spread
from soma_bullet.task.tracing import Grip
from soma_bullet.task.turns import Option
from soma_bullet.task.workcell import Workcell

OPTIONS = 4  # grasps for each arm
AWKWARD = 0.5  # [s] that the cost of a grasp counts as
BEYOND = 5.0  # cost of a grasp for each metre that the wrist is beyond the stand
WRIST, NEAR = (
    0.25,
    0.05,
)  # [m] from the pads back to the wrist; before the stand's middle, where beyond begins


@dataclass(frozen=True, eq=False)
class Candidate:
    """An arm, and the grip by which it inserts a piece."""

    arm: int
    grip: Grip


Lines = Callable[
    [int, Candidate], list[Array]
]  # joints (n, 6) along the free insertions of a step, from the goal back


class OptionFinder:
    """Finds the options of single steps."""

    def __init__(self, workcell: Workcell, fetcher: Fetcher, lines: Lines):
        self.workcell, self.robot, self.fetcher, self.lines = workcell, fetcher.robot, fetcher, lines

    def options(self, k: int, view: View, allowed: Indices) -> list[Option]:
        """Options of a step by grasps that serve at its goal: without regrasps where one also serves where
        the piece is."""
        if view.carrying is not None:
            return []
        direct = allowed[self.fetcher.clear_at(view, view.source)[allowed]]
        return list(self._direct(k, view, direct) if len(direct) else self._indirect(k, view, allowed))

    def _direct(self, k: int, view: View, indices: Indices) -> Iterator[Option]:
        cost = self.awkwardness(view, indices)
        for arm in range(len(self.workcell.cell.arms)):
            for candidate, awkward in self._best(k, view, arm, indices, cost):
                fetching = self._at_pick(view, arm, candidate.grip)
                if fetching is not None:
                    line = self.nearest(k, candidate, fetching[-1])[0]
                    seconds = carrying_time(self.robot, arm, fetching[-1], line[-1])
                    yield self._option(arm, candidate, AWKWARD * awkward + seconds, fetching, line)

    def _indirect(self, k: int, view: View, indices: Indices) -> Iterator[Option]:
        """Where the piece changes hands on the way, or is put down; it is as if it were fetched by the
        steepest grasp."""
        graph, arms = self.fetcher.graph(view.piece), range(len(self.workcell.cell.arms))
        goal = self.workcell.settled[view.piece] @ graph.poses[indices]
        held, tilt = self.clear_grasps(view)
        grips = [graph.grip(g) for g in spread(graph.poses, held, tilt)]
        at_pick = {
            arm: next((q for grip in grips if (q := self._at_pick(view, arm, grip)) is not None), None)
            for arm in arms
        }
        for arm in arms:
            cost = comfort(self.robot, arm, goal) + 2 * (1 - graph.contact[indices])
            for candidate, awkward in self._best(k, view, arm, indices, cost):
                line = self.lines(k, candidate)[0]
                for giver, fetching in at_pick.items():
                    if fetching is not None and (giver != arm or len(arms) == 1):
                        yield self._option(giver, candidate, AWKWARD * awkward, fetching, line)

    def _option(
        self, fetcher: int, candidate: Candidate, cost: float, fetching: Array, line: Array
    ) -> Option:
        return Option(fetcher, candidate.arm, candidate.grip, cost, fetching, np.array([line[0], line[-1]]))

    def _best(
        self, k: int, view: View, arm: int, indices: Indices, cost: Array
    ) -> list[tuple[Candidate, float]]:
        """Candidates that have a free insertion, with their costs; of every direction of the hand the best
        one first."""
        graph = self.fetcher.graph(view.piece)
        beyond = self._beyond(arm, self.workcell.settled[view.piece] @ graph.poses[indices])
        ranked = spread(graph.poses, indices, cost + BEYOND * beyond)[: 3 * OPTIONS]
        costs = dict(zip(indices.tolist(), cost.tolist(), strict=True))
        candidates = (Candidate(arm, graph.grip(g)) for g in ranked)
        return [
            (c, costs[c.grip.index]) for c in islice((c for c in candidates if self.lines(k, c)), OPTIONS)
        ]

    def _at_pick(self, view: View, arm: int, grip: Grip) -> Array | None:
        """Joints (3, 6) of an arm before a pick, at it and after it; None where it cannot pick."""
        picks = self.fetcher.picks_alone(view, view.source, arm, grip)
        return np.array([picks[0][0][-1], picks[0][0][0], picks[0][1][-1]]) if picks else None

    def _beyond(self, arm: int, Ts_world_tcp: Array) -> Array:
        """How far [m] an arm has its wrist beyond the stand, seen from its base, with the hand at poses (n,
        4, 4)."""
        middle = self.workcell.cell.stand_centre[:2]
        way = middle - self.robot.arm(arm).T_world_base[:2, 3]
        wrists = Ts_world_tcp[:, :2, 3] - WRIST * Ts_world_tcp[:, :2, 2]
        return np.maximum((wrists - middle) @ (way / max(float(np.linalg.norm(way)), 1e-9)) + NEAR, 0.0)

    def nearest(self, k: int, candidate: Candidate, q: Array) -> list[Array]:
        """The free insertions of a step, the one first that is reached soonest from joints (6,)."""
        seconds = lambda line: round(carrying_time(self.robot, candidate.arm, q, line[-1]), 9)  # noqa: E731
        return sorted(self.lines(k, candidate), key=seconds)

    def clear_grasps(self, view: View) -> tuple[Indices, Array]:
        """Grasps that serve where the piece is, and how tilted the hand is [rad]."""
        indices = np.flatnonzero(self.fetcher.clear_at(view, view.source))
        return indices, self._tilt(view, indices)

    def awkwardness(self, view: View, indices: Indices) -> Array:
        """Cost (n,) of picking the piece by some of its grasps where it is."""
        graph = self.fetcher.graph(view.piece)
        places = (view.source @ graph.poses[indices])[:, :3, 3]
        reach = np.linalg.norm(places - apply(view.source, graph.piece.center_of_mass), axis=1)
        return np.asarray(reach / 0.03 + (1 - graph.contact[indices]) + 0.5 * self._tilt(view, indices))

    def _tilt(self, view: View, indices: Indices) -> Array:
        tcp = view.source @ self.fetcher.graph(view.piece).poses[indices]
        return np.asarray(np.arccos(np.clip(-tcp[:, 2, 2], -1, 1)))


def carrying_time(robot: Robot, arm: int, start: Array, goal: Array) -> float:
    """How long [s] an arm takes along a straight edge between joints (6,) with a piece in its hand."""
    far = np.abs(goal - start)
    velocity, acceleration = CARRYING * robot.arm(arm).velocity, CARRYING * robot.arm(arm).acceleration
    ramps = velocity**2 / acceleration
    seconds = np.where(far < ramps, 2 * np.sqrt(far / acceleration), far / velocity + velocity / acceleration)
    return float(seconds.max())
