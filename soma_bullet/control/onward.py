"""How an episode goes on from a state as found: by the plan where it begins with what stands, else by another
order from there, else with a piece taken out again that is in the way."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from functools import cached_property

from soma_bullet.errors import NoSolutionError
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.plan import make_plan
from soma_bullet.planner.qualities import Qualities
from soma_bullet.task.actions.action import Identity
from soma_bullet.task.feed import Feed
from soma_bullet.task.limits import Effort
from soma_bullet.task.program.make import recover_program
from soma_bullet.task.program.program import Program
from soma_bullet.task.search_options import SearchOptions
from soma_bullet.task.state import CellState
from soma_bullet.task.workcell import Workcell

ORDERS = 3  # from one set of placed pieces that are tried
SHARES = 5  # of all lines of hands, of which one attempt takes one at most


class Onward:
    """Plans on from whatever stands.

    Args:
        plan: by which it was built so far.
        search: how long is searched each time.
    """

    def __init__(self, workcell: Workcell, plan: AssemblyPlan, search: SearchOptions):
        self.workcell, self.first, self.search = workcell, plan, search

    @cached_property
    def _qualities(self) -> Qualities:
        return Qualities(self.workcell.assembly, self.workcell.cell.hands, self.first.options)

    def program(
        self,
        plan: AssemblyPlan,
        state: CellState,
        displaced: Collection[str],
        seed: Callable[[], int],
        feed: Feed,
        avoid: Collection[Identity],
    ) -> tuple[AssemblyPlan, Program]:
        """A plan that begins with what stands, and the program of its rest.

        Args:
            plan: by which it was built last.
            displaced: pieces that stand, but beside their goals; they stay where all else fails.
            seed: of the next program.
            feed: how exact the places are.
            avoid: insertions that went wrong; they come again where all else fails.

        Raises:
            NoSolutionError: of the first plan that was tried, since the others were its substitutes.
        """
        effort, failures = Effort.of(self.search), list[NoSolutionError]()
        effort.for_order = min(effort.for_order, effort.most // SHARES)
        for candidate, found, refused, cleared in self._candidates(plan, state, displaced, avoid, failures):
            try:
                made = recover_program(
                    self.workcell, candidate, found, seed(), feed.noise, feed.square, effort, refused, cleared
                )
                return candidate, made
            except NoSolutionError as error:
                failures.append(error)
            if effort.exhausted:
                break
        raise failures[0]

    def _candidates(
        self,
        plan: AssemblyPlan,
        state: CellState,
        displaced: Collection[str],
        avoid: Collection[Identity],
        failures: list[NoSolutionError],
    ) -> Iterator[tuple[AssemblyPlan, CellState, Collection[Identity], Collection[str]]]:
        """Plans, the states that they begin with, what they avoid, and what they clear away first; why there
        are no plans is added to the failures."""
        for candidate in self._plans(plan, state, failures):
            yield candidate, state, avoid, ()
        for name in self._removable(plan, state):
            without = replace(state, placed=state.placed - {name})
            for candidate in self._plans(plan, without, failures, 1):
                yield candidate, without, avoid, (name,)
        if displaced:
            left = replace(state, placed=state.placed | set(displaced))
            for candidate in self._plans(plan, left, failures, 1):
                yield candidate, left, avoid, ()
        if avoid:
            for candidate in self._plans(plan, state, failures, 1):
                yield candidate, state, (), ()

    def _plans(
        self, plan: AssemblyPlan, state: CellState, failures: list[NoSolutionError], most: int = ORDERS
    ) -> Iterator[AssemblyPlan]:
        """Plans that begin with what stands, that which is followed already first."""
        tried = frozenset[tuple[str, ...]]()
        if {step.piece for step in plan.steps[: len(state.placed)]} == state.placed:
            tried = frozenset({plan.order})
            yield plan
        done = tuple(step for step in plan.steps if step.piece in state.placed)
        cell, assembly = self.workcell.cell, self.workcell.assembly
        while len(tried) < most:
            try:
                found = make_plan(assembly, cell.hands, plan.options, tried, self._qualities, done)
            except NoSolutionError as error:
                failures.append(error)
                return
            tried |= {found.order}
            yield found

    def _removable(self, plan: AssemblyPlan, state: CellState) -> list[str]:
        """Placed pieces that nothing lies on and no hand holds, those that came last first."""
        placed, carries = state.placed, self.workcell.carries
        held = set(state.held.values())
        free = [n for n in plan.order if n in placed - held and not any(carries(n, up) for up in placed)]
        return free[::-1]
