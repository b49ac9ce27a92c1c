"""The best order of a plan that has a program: an order without one is ruled out, and the next best is
tried."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from soma_bullet.errors import NoSolutionError
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.store import kept_plan
from soma_bullet.task.feed import Feed
from soma_bullet.task.limits import Effort
from soma_bullet.task.program.make import make_program
from soma_bullet.task.program.program import Program
from soma_bullet.task.refusal import Refusals
from soma_bullet.task.search.scheduler import Scheduler
from soma_bullet.task.search_options import SearchOptions
from soma_bullet.task.workcell import Workcell

# of the best score: before orders below, the better ones are searched again, so many times longer
POOR, THOROUGH = 0.2, 3


def program_of_best_order(
    workcell: Workcell,
    plan: AssemblyPlan,
    feed: Callable[[AssemblyPlan], Feed],
    seed: int,
    options: SearchOptions,
    progress: Callable[[str], None] | None = None,
) -> tuple[AssemblyPlan, Program]:
    """The plan of the best order that has a program, and that program.

    Args:
        plan: of the best order; feed: where the pieces lie, given a plan.

    Raises:
        NoSolutionError: none has one, with the step that the search came to, and what blocked there.
    """
    effort = Effort.of(options)
    refusals, schedulers = Refusals(), dict[tuple[str, ...], Scheduler]()
    for candidate, times in _candidates(workcell, plan, options.orders):
        if effort.exhausted:
            break
        order = candidate.order
        if order not in schedulers:
            laid_out = feed(candidate)
            schedulers[order] = Scheduler(workcell, candidate, laid_out, None, effort, refusals)
        scheduler = schedulers[order]
        scheduler.order_lines = times * effort.for_order
        try:
            made = make_program(workcell, candidate, scheduler.feed, seed, progress, scheduler=scheduler)
        except NoSolutionError:
            scheduler.forget()  # of its searches; what it has ruled out it keeps
            effort.scenes.forget()
        else:
            return candidate, made
    count, name = len(schedulers), workcell.assembly.name
    ended = f" within {options.lines} lines of hands (--search.lines)" if effort.exhausted else ""
    raise refusals.error("schedule", f"none of the {count} best orders of {name} has a schedule{ended}")


def _candidates(workcell: Workcell, plan: AssemblyPlan, most: int) -> Iterator[tuple[AssemblyPlan, int]]:
    """Plans of different orders, best first, and how many times longer than once each is searched: before far
    worse orders the better ones again."""
    best, better, excluded = plan.score, list[AssemblyPlan](), frozenset[tuple[str, ...]]()
    for _ in range(most):
        if plan.score < POOR * best:
            yield from ((earlier, THOROUGH) for earlier in better)
            better = []
        yield plan, 1
        if plan.score >= POOR * best:
            better.append(plan)
        excluded |= {plan.order}
        try:
            plan = kept_plan(workcell.assembly, workcell.cell.hands, plan.options, excluded)
        except NoSolutionError:
            break
    yield from ((earlier, THOROUGH) for earlier in better)
