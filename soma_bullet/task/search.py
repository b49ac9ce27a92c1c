"""The search of a schedule with every piece in its place on the table.

A depth-first search over the steps of the plan. Each step tries arms and grasps, cheapest first, and keeps
one only if the hand serves where the piece lies and at the goal, the straight lines of approach, lift,
insertion and retreat are free, hands and arms clear each other, and a hold has its certificate. Where no
grasp serves at both, the piece is put down or handed over on the way. Every rejection is counted under its
reason."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from soma_bullet.errors import NoSolutionError
from soma_bullet.frames import Array, Indices, readonly
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.task.assignments import Assignment, HandOver, Pick, Regrasp, Start, key
from soma_bullet.task.feed import Feed
from soma_bullet.task.fetch import CHAINS, Action, Fetcher, View
from soma_bullet.task.holding import State
from soma_bullet.task.options import Candidate
from soma_bullet.task.outset import set_out
from soma_bullet.task.placing import RUN_IN, Placer, Placing
from soma_bullet.task.spots import bearings, comfort, spread
from soma_bullet.task.tracing import Effort, TooManyLines, Tracer
from soma_bullet.task.turns import Option, Turns
from soma_bullet.task.workcell import Workcell

LOOKED_AT = 12  # as many candidates as are wanted are looked at before the piece is regrasped instead
# candidates a step; no more, and what one grasp can bring is not regrasped, but for the first piece, briefly
SHALLOW = 8
DEEP = 72  # candidates a step; more, and more goal grasps are regrasped
REGRASPED, WAYS = (
    6,
    2,
)  # goal grasps that are brought about by regrasps, and ways of each kind for one of them
BRIEF = tuple(chain for chain in CHAINS if len(chain) == 1)
PREPARATIONS: tuple[tuple[Action, ...], ...] = (
    ("put down",),
    ("hand over", "put down"),
    ("put down", "put down"),
)
NEAREST, STRAIGHTEST = (
    4e-3,
    np.deg2rad(8.0),
)  # [m], [rad] a carried piece sits in one of its grasps within this


class Search:
    """Searches schedules from given poses of the pieces; checks that two schedules share are made once.

    Attributes:
        poses: T_world_piece of every piece once `prologue` is done.
        prologue: regrasps that come before the first step.
        excluded: what a later stage ruled out: (step, arm, grasp), or the `key` of a way to regrasp.
        outset: what there is before the prologue.
    """

    def __init__(
        self,
        workcell: Workcell,
        plan: AssemblyPlan,
        feed: Feed,
        poses: dict[str, Array],
        start: Start | None,
        rejections: Counter[str],
        excluded: set[tuple[object, ...]],
        effort: Effort,
        prologue: tuple[Regrasp, ...] = (),
    ):
        self.workcell, self.plan, self.start = workcell, plan, start
        self.robot = workcell.robot
        self.rejections, self.excluded = rejections, excluded
        self.tracer = Tracer(workcell, self.rejections, effort)
        self.fetcher = Fetcher(self.tracer, plan, feed, excluded)
        self.hand = self.fetcher.hand
        self.poses = dict(poses)
        self.first = 0 if start is None else start.step
        self.placer = Placer(self.tracer, plan, self.fetcher, self.poses, self.first)
        self.finder = self.placer.finder
        self._dead: set[tuple[object, ...]] = set()  # states that no further step follows
        self.deepest = self.first  # step that the search has come to
        self.outset = set_out(self.placer, start, stowed=bool(prologue))
        self.poses.update({put.piece: put.pose_down for put in self.outset.stowed})
        self.prologue = (*self.outset.stowed, *prologue)
        self.fetcher.moved = frozenset(regrasp.piece for regrasp in self.prologue)

    def find(self, width: int, lines: int) -> tuple[Assignment, ...] | None:
        """The first schedule among `width` candidates a step, or None, also where it takes more than `lines`
        lines of hands.

        Raises:
            NoSolutionError: a piece is out of reach.
        """
        turns = self.turns  # their lines do not count
        self.tracer.most_lines = self.tracer.lines + lines
        try:
            for assignments in self._search(self.first, self.outset.state, width, None, turns):
                if self.prologue and assignments:
                    assignments[0] = replace(
                        assignments[0], regrasps=(*self.prologue, *assignments[0].regrasps)
                    )
                return tuple(assignments)
        except TooManyLines:
            pass
        return None

    def prepare(self, k: int) -> Iterator[tuple[Regrasp, ...]]:
        """Ways to lay the piece of step k down so that a grasp for its goal serves, before the first step."""
        self.tracer.most_lines = 10**9
        view = self._view(k, self.outset.state)
        lying = {name: pose for name, pose in self.placer.lying(self.first - 1).items() if name != view.piece}
        view = replace(view, step=-2 - k, lying=lying)
        graph = self.fetcher.graph(view.piece)
        chosen = np.array(sorted(self.placer.allowed(k)), int)
        turns = []
        for arm in view.free:
            cost = (
                comfort(self.robot, arm, self.workcell.settled[view.piece] @ graph.poses[chosen])
                - graph.contact[chosen]
            )
            turns.append([Candidate(arm, graph.grip(g)) for g in spread(graph.poses, chosen, cost)])
        candidates = [c for turn in itertools.zip_longest(*turns) for c in turn if c is not None]
        usable = [c for c in candidates[: LOOKED_AT * REGRASPED] if self.placer.lines_in(k, c)][
            : 2 * REGRASPED
        ]
        for actions in PREPARATIONS:
            for candidate in usable:
                ways = self.fetcher.chains(view, candidate.arm, candidate.grip, actions)
                yield from (regrasps for regrasps, _ in itertools.islice(ways, 1))

    def _search(
        self, k: int, state: State, width: int, previous: Option | None, turns: Turns
    ) -> Iterator[list[Assignment]]:
        """Schedules from step k on, the step before which was done in a known way."""
        self.deepest = max(self.deepest, k)
        if k == len(self.plan.steps):
            yield []
            return
        view, found = self._view(k, state), False
        if (*view.key, width) in self._dead:
            return
        for assignment, after in self._assignments(k, state, view, width, turns.ranked(k, previous)):
            if key(assignment) in self.excluded or key(assignment)[:3] in self.excluded:
                continue
            done = self._as_option(assignment)
            for rest in self._search(k + 1, after, width, done, turns):
                found = True
                yield [assignment, *rest]
        if not found:
            self._dead.add((*view.key, width))

    def _as_option(self, a: Assignment) -> Option:
        """How a step is done, for the one after it."""
        joints, grip = np.array([a.q_goal, a.q_ready]), self.fetcher.graph(a.piece).grip(a.grasp)
        return Option(a.arm, a.arm, grip, 0.0, joints, joints)

    def _assignments(
        self, k: int, state: State, view: View, width: int, ranked: Sequence[Option]
    ) -> Iterator[tuple[Assignment, State]]:
        """The ways to do step k: direct ones first, then with regrasps, fewest and quickest first.

        At first a piece that can be had directly is regrasped only by one action, before the first step, and
        to be held from where no arm can have it otherwise: a hand that holds it from there may leave room for
        the next."""
        unsquared: list[tuple[Assignment, State]] = []
        direct: set[tuple[float, ...]] = set()
        for candidate in self._direct(k, state, view, width, ranked):
            for assignment, after in self._directly(k, state, view, candidate):
                direct.add(_bearing(candidate))
                if assignment.regrasps or assignment.in_hand or not self.fetcher.off(view.piece):
                    yield assignment, after
                else:
                    unsquared.append((assignment, after))
        yield from unsquared
        briefly = width <= SHALLOW and view.carrying is None and self._served(k, view)
        if briefly and (k > self.first or not direct):
            return  # other ways to do the steps before come first
        if not briefly and not self._in_reach(view):
            reason = f"{view.piece} cannot be picked where it is by any arm and grasp"
            raise NoSolutionError("schedule", reason, self.rejections)
        count = REGRASPED if width <= DEEP else 4 * REGRASPED
        placings = self._placings(k, state, count, ranked, direct if briefly else set())
        for actions in BRIEF if briefly else CHAINS:
            for placing in placings:
                candidate = placing.candidate
                ways = self.fetcher.chains(view, candidate.arm, candidate.grip, actions)
                for regrasps, pick in itertools.islice(ways, WAYS):
                    yield self._assignment(k, view, placing, regrasps, pick), placing.after

    def _served(self, k: int, view: View) -> bool:
        """Whether the hand can have the piece, where it lies, by a grasp that serves at the goal."""
        return bool(self.fetcher.clear_at(view, view.source)[sorted(self.placer.allowed(k))].any())

    def _view(self, k: int, state: State) -> View:
        piece = self.plan.steps[k].piece
        free = tuple(arm for arm in range(len(self.workcell.cell.arms)) if arm not in state.hands.gripped)
        carrying = self.outset.carried if k == self.first else None
        return View(
            k, piece, self.poses[piece], carrying, self.placer.lying(k), state.placed, state.hands, free
        )

    # --- candidates, cheapest first -------------------------------------------------------------------------

    def _in_reach(self, view: View) -> bool:
        """Whether any arm can pick the piece by any grasp at all."""
        graph = self.fetcher.graph(view.piece)
        grips = [graph.grip(int(g)) for g in spread(graph.poses, *self.finder.clear_grasps(view))]
        arms = range(len(self.workcell.cell.arms))
        return view.carrying is not None or any(
            self.fetcher.picks_alone(view, view.source, arm, grip) for grip in grips for arm in arms
        )

    @cached_property
    def turns(self) -> Turns:
        """The options of all steps, as if both arms were free at each of them."""
        options = {}
        for k in range(self.first, len(self.plan.steps)):
            view = self._view(k, self.outset.state)
            options[k] = self.finder.options(k, view, np.array(sorted(self.placer.allowed(k)), int))
        return Turns(self.workcell, options)

    def _first_of(
        self, ranked: Sequence[Option], direct: bool, view: View, indices: Indices
    ) -> list[Candidate]:
        """Candidates of the options, among some grasps and the free arms: as they are, or as what inserts
        after regrasps."""
        chosen = set(indices.tolist())
        serving = [o for o in ranked if o.grip.index in chosen and o.inserter in view.free]
        return _distinct(
            Candidate(o.inserter, o.grip) for o in serving if not direct or o.fetcher == o.inserter
        )

    def _arms(self, view: View, ranked: Sequence[Option], fetching: bool = True) -> list[int]:
        """Free arms, the one first that is to fetch the piece of a step, or to insert it."""
        wished = [o.fetcher if fetching else o.inserter for o in ranked]
        return sorted(view.free, key=lambda arm: wished.index(arm) if arm in wished else len(wished))

    def _direct(
        self, k: int, state: State, view: View, width: int, ranked: Sequence[Option]
    ) -> Iterator[Candidate]:
        """Grasps that serve where the piece is and at the goal, with arms: the options, then of every
        direction one."""
        if view.carrying is not None:
            yield from self._carried_candidate(k, view)
            return
        graph, indices = self.fetcher.graph(view.piece), self.placer.chosen(k, state)
        clear = self.fetcher.clear_at(view, view.source)[indices]
        touched = int((~clear).sum())
        self.tracer.reject(view.piece, "hand touches the table or a piece at the feed", touched)
        indices = indices[clear]
        cost = self.finder.awkwardness(view, indices)
        arms = self._arms(view, ranked)
        groups: dict[
            tuple[float, ...], list[Candidate]
        ] = {}  # by arm and direction of the hand: each may fail as a whole
        indices = indices[np.argsort(np.round(cost, 9), kind="stable")]
        for g, direction in zip(indices.tolist(), bearings(graph.poses[indices]), strict=True):
            for arm in arms:
                groups.setdefault((arm, *direction), []).append(Candidate(arm, graph.grip(g)))
        found = 0
        turns = (c for turn in itertools.zip_longest(*groups.values()) for c in turn if c is not None)
        first = self._first_of(ranked, True, view, indices)
        for candidate in _distinct(itertools.chain(first, turns))[: LOOKED_AT * width]:
            arm, grip = candidate.arm, candidate.grip
            if self.placer.lines_in(k, candidate) and self.fetcher.picks_alone(view, view.source, arm, grip):
                yield candidate
                found += 1
                if found == width:
                    return

    def _carried_candidate(self, k: int, view: View) -> Iterator[Candidate]:
        """The piece goes in by the grip that an arm has of it, if that is one of those that serve."""
        assert view.carrying is not None
        arm, grip = view.carrying
        index, off, turned = self.fetcher.graph(view.piece).nearest(grip.T_piece_tcp)
        if index in self.plan.steps[k].grasps and off < NEAREST and turned < STRAIGHTEST:
            yield Candidate(arm, grip)
        else:
            self.tracer.reject(view.piece, "it sits in the hand as no grasp for the goal has it")

    # --- one step -------------------------------------------------------------------------------------------

    def _directly(
        self, k: int, state: State, view: View, candidate: Candidate
    ) -> Iterator[tuple[Assignment, State]]:
        """The step without regrasps."""
        if (k, candidate.arm, candidate.grip.index) in self.excluded:
            return
        for regrasps, pick in self.fetcher.chains(view, candidate.arm, candidate.grip, ()):
            placing = self.placer.placing(k, state, candidate, pick)
            if placing is not None:
                yield self._assignment(k, view, placing, regrasps, pick), placing.after

    def _placings(
        self, k: int, state: State, count: int, ranked: Sequence[Option], known: set[tuple[float, ...]]
    ) -> list[Placing]:
        """Ways to put the piece in its place, whatever brings it: the options, then the best contact of every
        direction.

        Args:
            known: what `_bearing` gives for arms and hands that are left out.
        """
        graph, indices = self.fetcher.graph(self.plan.steps[k].piece), self.placer.chosen(k, state)
        goal, found = self.workcell.settled[self.plan.steps[k].piece], []
        turns = []
        view = self._view(k, state)
        for arm in self._arms(view, ranked, fetching=False):
            cost = comfort(self.robot, arm, goal @ graph.poses[indices]) + 2 * (1 - graph.contact[indices])
            turns.append([Candidate(arm, graph.grip(g)) for g in spread(graph.poses, indices, cost)])
        candidates = (c for turn in itertools.zip_longest(*turns) for c in turn if c is not None)
        first = self._first_of(ranked, False, view, indices)
        wanted = (c for c in itertools.chain(first, candidates) if _bearing(c) not in known)
        for candidate in _distinct(wanted)[: LOOKED_AT * count]:
            if (k, candidate.arm, candidate.grip.index) in self.excluded or not self.placer.lines_in(
                k, candidate
            ):
                continue
            placing = self.placer.placing(k, state, candidate)
            if placing is not None:
                found.append(placing)
                if len(found) == count:
                    break
        return found

    def _assignment(
        self, k: int, view: View, placing: Placing, regrasps: tuple[Regrasp, ...], pick: Pick | None
    ) -> Assignment:
        step, candidate = self.plan.steps[k], placing.candidate
        if pick is not None:
            opened, q_before, q_pick, q_lifted = pick.opened, pick.q_before, pick.q_pick, pick.q_lifted
        elif regrasps and isinstance(regrasps[-1], HandOver):
            opened, q_before, q_pick, q_lifted = (
                np.nan,
                regrasps[-1].q_before,
                regrasps[-1].q_take,
                regrasps[-1].q_take,
            )
        else:
            assert self.start is not None
            opened, q_before = np.nan, readonly(self.start.hands.qs[candidate.arm])
            q_pick = q_lifted = q_before
        return Assignment(
            step=k,
            piece=step.piece,
            arm=candidate.arm,
            grasp=candidate.grip.index,
            width=candidate.grip.width,
            opened=opened,
            regrasps=regrasps,
            in_hand=pick is None,
            q_before=q_before,
            q_pick=q_pick,
            q_lifted=q_lifted,
            q_ready=readonly(placing.q_ready),
            q_goal=readonly(placing.q_goal),
            direction=readonly(step.direction),
            length=step.way + RUN_IN,
            guarded=self.placer.guarded(k),
            holds={name: arm for arm, name in placing.after.hands.gripped.items()},
            takes=placing.takes,
            releases=placing.releases,
            certificate=placing.certificate,
        )


def _bearing(candidate: Candidate) -> tuple[float, ...]:
    """The arm, and the direction from which its hand has the piece."""
    return candidate.arm, *bearings(candidate.grip.T_piece_tcp[None])[0]


def _distinct(candidates: Iterable[Candidate]) -> list[Candidate]:
    """The candidates, each arm and grasp once."""
    found: dict[tuple[int, int], Candidate] = {}
    for candidate in candidates:
        found.setdefault((candidate.arm, candidate.grip.index), candidate)
    return list(found.values())
