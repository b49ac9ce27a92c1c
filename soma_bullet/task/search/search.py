"""The search of a schedule with every piece in its place on the table.

A depth-first search over the steps of the plan. Each step tries arms and grasps, cheapest first, and keeps
one only if the hand serves where the piece lies and at the goal, the straight lines of approach, lift,
insertion and retreat are free, hands and arms clear each other, and a hold has its certificate. Where no
grasp serves at both, the piece is put down or handed over on the way. Every refusal is counted."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.holds import Holds
from soma_bullet.task.actions import insert, pick
from soma_bullet.task.actions.action import Action
from soma_bullet.task.actions.insert import Candidate
from soma_bullet.task.feed import Feed
from soma_bullet.task.limits import Effort, TooManyLines
from soma_bullet.task.lines import Lines, Spot
from soma_bullet.task.refusal import Refusals
from soma_bullet.task.schedule import Assignment
from soma_bullet.task.search import direct
from soma_bullet.task.search.arm_assignment import ArmAssignment, Option
from soma_bullet.task.search.chains import BRIEF, CHAINS, Chain, chains
from soma_bullet.task.search.changes import Changes
from soma_bullet.task.search.direct import LOOKED_AT, Bearing, bearing
from soma_bullet.task.search.options import clear_grips, options
from soma_bullet.task.search.placing import Placer, Placing
from soma_bullet.task.search.planning import Excluded, Fetch, Planning
from soma_bullet.task.search.start import StartState, first_step, start_state
from soma_bullet.task.state import CellState, Stance
from soma_bullet.task.workcell import Workcell

SHALLOW = (
    8  # candidates a step; no more, and what one grasp can bring is not regrasped, but for the first piece
)
DEEP = 72  # candidates a step; more, and more goal grasps are regrasped
REGRASPED, WAYS = (
    6,
    2,
)  # goal grasps that are brought about by regrasps, and ways of each kind for one of them


class Search:
    """Searches schedules from given places of the pieces; checks that two schedules share are made once.

    Attributes:
        planning: what its actions plan with.
        beginning: actions that come before the first step.
        deepest: step that it has come to.
        start: what there is before the beginning.
    """

    def __init__(
        self,
        workcell: Workcell,
        plan: AssemblyPlan,
        feed: Feed,
        spots: dict[str, Spot],
        found: CellState | None,
        judged: Holds,
        refusals: Refusals,
        excluded: Excluded,
        effort: Effort,
        beginning: Chain = (),
    ):
        self.workcell, self.plan, self.feed = workcell, plan, feed
        self.lines = Lines(workcell, refusals, effort)
        first = first_step(plan, found)
        poses = found.poses if found is not None else {}
        self.planning = Planning(self.lines, plan, feed, excluded, spots, first, poses)
        self.first, self.deepest = first, first
        self._dead: set[tuple[int, Stance, int]] = set()  # states that no further step follows
        changes = Changes(self.planning, judged)
        self.placer = Placer(self.planning, changes)
        refusals.order = plan.order
        self.start: StartState = start_state(self.planning, changes, found, stowed=bool(beginning))
        for put in self.start.stowed:
            self.planning.spots[put.piece] = Spot(put.pose_down, 0.0, put.place)
        if self.start.stowed:  # what was found before lies elsewhere now
            self.planning.forget()
        self.beginning: Chain = (*self.start.stowed, *beginning)

    def find(self, width: int, lines: int) -> tuple[Assignment, ...] | None:
        """The first schedule among `width` candidates a step, or None, also where it takes more than `lines`
        lines of hands.

        Raises:
            NoSolutionError: a piece is out of reach.
        """
        assignment = self.arms  # its lines do not count
        self.lines.most = self.lines.made + lines
        try:
            state = self._begun(self.first)
            for found in self._search(self.first, state, width, None, assignment):
                return tuple(found)
        except TooManyLines:
            pass
        return None

    def prepare(self, k: int) -> Iterator[Chain]:
        """Ways to lay the piece of step k down so that a grasp for its goal serves, before the first step."""
        self.lines.most = 10**9
        fetch = Fetch(self.plan.steps[k].piece, self._spot(k), self._begun(self.first))
        yield from direct.prepared(self.planning, k, fetch)

    def _begun(self, k: int) -> CellState:
        """The state before step k, the hands as they are at the start, all other pieces where they lie."""
        state, placed = self.start.state, [step.piece for step in self.plan.steps[self.first : k]]
        lying = {step.piece: self.planning.spots[step.piece].pose for step in self.plan.steps[k:]}
        standing = self.planning.standing(k)
        poses = {**state.poses, **lying, **{piece: standing[piece] for piece in placed}}
        return replace(state, poses=poses, placed=state.placed | frozenset(placed))

    def _spot(self, k: int) -> Spot:
        return self.planning.spots[self.plan.steps[k].piece]

    def _fetch(self, k: int, state: CellState) -> Fetch:
        carrying = self.start.carrying if k == self.first else None
        return Fetch(self.plan.steps[k].piece, self._spot(k), state, carrying)

    @cached_property
    def arms(self) -> ArmAssignment:
        """The options of all steps, as if all arms were as at the start."""
        steps = range(self.first, len(self.plan.steps))
        found = {k: options(self.planning, k, self._fetch(k, self._begun(k))) for k in steps}
        return ArmAssignment(self.workcell, found)

    def _search(
        self, k: int, state: CellState, width: int, previous: Option | None, arms: ArmAssignment
    ) -> Iterator[list[Assignment]]:
        """Schedules from step k on, the step before which was done in a known way."""
        self.deepest = max(self.deepest, k)
        if k == len(self.plan.steps):
            yield []
            return
        dead = k, state.stance, width
        if dead in self._dead:
            return
        self.lines.refusals.at(k)
        found = False
        for assignment, after in self._assignments(k, state, width, arms.ranked(k, previous)):
            if self.placer.ruled_out(assignment):
                continue
            done = self._as_option(assignment)
            for rest in self._search(k + 1, after, width, done, arms):
                found = True
                yield [assignment, *rest]
            self.lines.refusals.at(k)
        if not found:
            self._dead.add(dead)

    def _as_option(self, a: Assignment) -> Option:
        """How a step is done, for the one after it."""
        joints = np.array([a.insert.q_goal, a.insert.q_ready])
        grip = self.planning.graph(a.piece).grip(a.insert.grasp)
        return Option(a.arm, a.arm, grip, 0.0, joints, joints)

    def _assignments(
        self, k: int, state: CellState, width: int, ranked: Sequence[Option]
    ) -> Iterator[tuple[Assignment, CellState]]:
        """The ways to do step k: direct ones first, then with regrasps, fewest and quickest first.

        At first a piece that can be had directly is regrasped only by one action, before the first step, and
        to be held from where no arm can have it otherwise: a hand that holds it from there may leave room for
        the next.
        """
        fetch, planning = self._fetch(k, state), self.planning
        unsquared: list[tuple[Assignment, CellState]] = []
        had: set[Bearing] = set()
        for candidate in direct.candidates(planning, k, fetch, self.placer.chosen(k, state), width, ranked):
            for chain, assignment, after in self._directly(k, fetch, candidate):
                had.add(bearing(candidate))
                if len(chain) != 1 or not planning.off(fetch.piece):
                    yield assignment, after
                else:
                    unsquared.append((assignment, after))
        yield from unsquared
        briefly = width <= SHALLOW and fetch.carrying is None and self._served(k, fetch)
        if briefly and (k > self.first or not had):
            return  # other ways to do the steps before come first
        if not briefly and not self._in_reach(fetch):
            reason = f"{fetch.piece} cannot be picked where it is by any arm and grasp"
            raise self.lines.refusals.error("schedule", reason)
        count = REGRASPED if width <= DEEP else 4 * REGRASPED
        placings = self._placings(k, fetch, count, ranked, had if briefly else set())
        for kinds in BRIEF if briefly else CHAINS:
            for placing in placings:
                arm, grip = placing.candidate.arm, placing.candidate.grip
                for chain in itertools.islice(chains(planning, fetch, arm, grip, kinds), WAYS):
                    yield self._assignment(k, placing, chain), placing.after

    def _served(self, k: int, fetch: Fetch) -> bool:
        """Whether the hand can have the piece, where it lies, by a grasp that serves at the goal."""
        return bool(self.planning.clear_at(fetch, fetch.source)[self.planning.allowed(k)].any())

    def _in_reach(self, fetch: Fetch) -> bool:
        """Whether any arm can pick the piece by any grasp at all."""
        return fetch.carrying is not None or any(
            pick.candidates(self.planning, fetch, fetch.source, arm, grip)
            for arm in fetch.state.arms
            for grip in clear_grips(self.planning, fetch, arm)
        )

    def _directly(
        self, k: int, fetch: Fetch, candidate: Candidate
    ) -> Iterator[tuple[Chain, Assignment, CellState]]:
        """The step without regrasps, with what brings the piece."""
        if self.placer.refused(k, candidate):
            return
        for chain in chains(self.planning, fetch, candidate.arm, candidate.grip, ()):
            picked = chain[-1] if chain else None
            placing = self.placer.check(k, fetch.state, candidate, picked)
            if placing is not None:
                yield chain, self._assignment(k, placing, chain), placing.after

    def _placings(
        self, k: int, fetch: Fetch, count: int, ranked: Sequence[Option], known: set[Bearing]
    ) -> list[Placing]:
        """Ways to put the piece in its place, whatever brings it: the options, then the best contact of every
        direction.

        Args:
            known: arms and bearings of hands that are left out.
        """
        found: list[Placing] = []
        indices = self.placer.chosen(k, fetch.state)
        wanted = [c for c in direct.at_goal(self.planning, fetch, indices, ranked) if bearing(c) not in known]
        for candidate in wanted[: LOOKED_AT * count]:
            if self.placer.refused(k, candidate) or not insert.candidates(self.planning, k, candidate):
                continue
            placing = self.placer.check(k, fetch.state, candidate)
            if placing is not None:
                found.append(placing)
                if len(found) == count:
                    break
        return found

    def _assignment(self, k: int, placing: Placing, chain: Chain) -> Assignment:
        beginning: tuple[Action, ...] = self.beginning if k == self.first else ()
        holds = {name: arm for arm, name in placing.after.held.items()}
        return Assignment(k, (*beginning, *chain), placing.insert, placing.changes, holds)
