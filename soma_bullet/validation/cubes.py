"""The 240 Soma cubes: are they planned, and has each an order that needs no hold, whichever side is down?"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context
from typing import Any

import numpy as np

from soma_bullet.assembly.model import Assembly
from soma_bullet.assembly.packings import draw_soma_cubes, sides_down, soma_cube
from soma_bullet.assembly.polycubes import cube_rotations
from soma_bullet.errors import SomaBulletError
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.plan import make_plan
from soma_bullet.planner.qualities import Qualities
from soma_bullet.robot.cell import find_hand

HAND = "ur5e_pair"  # whose hand it is
QUANTILES = "smallest, quartiles, largest"


@cache
def _hands() -> HandSet:
    return HandSet.alike(find_hand(HAND))


@dataclass(frozen=True)
class CubePlan:
    """What became of the plan of one cube.

    Attributes:
        number: of the cube.
        seconds, cpu: wall and CPU time [s].
        order: the chosen one.
        score: of it.
        holds: holds in it.
        free_orders: feasible orders that need no hold at any step.
        failure: why there is no plan, else empty.
    """

    number: int
    seconds: float
    cpu: float
    order: tuple[str, ...] = ()
    score: float = 0.0
    holds: int = 0
    free_orders: int = 0
    failure: str = ""


@dataclass(frozen=True)
class CubeTurns:
    """In how many orientations one cube has an order that stands throughout by itself, along straight ways
    in.

    Attributes:
        number: of the cube.
        asked: orientations that were looked at.
        stable: those with such an order.
        gripped: those with such an order whose pieces the hand can grip; None where that was not asked.
        cpu: CPU time [s].
    """

    number: int
    asked: int
    stable: int
    gripped: int | None
    cpu: float


def plan_cube(number: int) -> CubePlan:
    """Plan one of the 240 in the orientation that it is found in."""

    # pieces shared with the other cubes: their facets and parts are made once
    cube, hands = soma_cube(number), _hands()
    start, cpu = time.perf_counter(), time.process_time()
    try:
        plan = make_plan(cube, hands)
    except SomaBulletError as error:
        return CubePlan(
            number, time.perf_counter() - start, time.process_time() - cpu, failure=_first_reasons(str(error))
        )
    times = time.perf_counter() - start, time.process_time() - cpu
    holds = sum(len(step.holds) for step in plan.steps)
    free_orders = sum(row.feasible and row.stable_throughout for row in plan.orders)
    return CubePlan(number, *times, plan.order, plan.score, holds, free_orders)


def _first_reasons(text: str) -> str:
    return "; ".join(line.strip() for line in text.splitlines()[:3])


def turn_cube(number: int, orientations: int, grasps: bool) -> CubeTurns:
    """Look for orders without holds in several orientations of one of the 240."""

    cpu = time.process_time()
    cubes = [soma_cube(number, turn) for turn in (sides_down() if orientations == 6 else cube_rotations())]
    stable = sum(stable_order(cube) is not None for cube in cubes)
    gripped = sum(stable_order(cube, grasps=True) is not None for cube in cubes) if grasps else None
    return CubeTurns(number, len(cubes), stable, gripped, time.process_time() - cpu)


def stable_order(cube: Assembly, grasps: bool = False) -> tuple[int, ...] | None:
    """Some order of a Soma cube along straight ways in, every state of which stands by itself; None if there
    is none.

    It is taken apart from the top, and placed sets that lead nowhere are remembered.

    Args:
        grasps: every piece must have a grasp when it goes in.
    """

    qualities, dead = Qualities(cube, _hands(), PlannerOptions()), set()
    qualities.grasps = _soma_qualities().grasps  # type: ignore[method-assign]  # of a piece alone: the same in every cube
    from_top = [int(k) for k in (-cube.goal_centres[:, 2]).argsort(kind="stable")]

    def take_apart(placed: frozenset[int]) -> tuple[int, ...] | None:
        if not placed:
            return ()
        if placed in dead:
            return None
        if qualities.stability(placed).verdict != "unstable":
            for piece in (k for k in from_top if k in placed):
                rest = placed - {piece}
                if qualities.assemblability(piece, rest).direction is None:
                    continue
                if grasps and not qualities.graspability(piece, rest):
                    continue
                before = take_apart(rest)
                if before is not None:
                    return (*before, piece)
        dead.add(placed)
        return None

    return take_apart(frozenset(from_top))


@cache
def _soma_qualities() -> Qualities:

    return Qualities(soma_cube(0), _hands(), PlannerOptions())


def survey_cubes(
    plans: int, turned: int, orientations: int, grasps: bool, seed: int, jobs: int, done: Callable[[], None]
) -> tuple[list[CubePlan], list[CubeTurns]]:
    """Plan some cubes in full, and turn some, each drawn by the seed, in worker processes.

    Args:
        plans, turned: how many of the 240.
        orientations: 6 (each side down) or 24.
        grasps: whether turned cubes are also asked for orders whose pieces the hand can grip.
        done: is told of each.
    """
    planned: list[CubePlan] = []
    turns: list[CubeTurns] = []
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        work: list[Any] = [
            pool.submit(turn_cube, k, orientations, grasps) for k in draw_soma_cubes(turned, seed)
        ]
        work += [pool.submit(plan_cube, k) for k in draw_soma_cubes(plans, seed)]
        for job in as_completed(work):
            found = job.result()
            (planned if isinstance(found, CubePlan) else turns).append(found)
            done()
    return sorted(planned, key=lambda plan: plan.number), sorted(turns, key=lambda turn: turn.number)


def cube_table(plans: Sequence[CubePlan], turns: Sequence[CubeTurns]) -> str:
    """What was found, in Markdown."""
    lines = ["| Soma cubes | |", "|-|-|"]
    if turns:
        asked = sum(turn.asked for turn in turns)
        found = {"stands throughout": [turn.stable for turn in turns]}
        if turns[0].gripped is not None:
            found["stands throughout and can be gripped"] = [turn.gripped or 0 for turn in turns]
        lines.append(f"| looked at in {turns[0].asked} orientations | {len(turns)} of 240 |")
        for what, counts in found.items():
            lines.append(f"| an order {what}: orientations | {sum(counts)} of {asked} |")
            every, some = sum(count == turns[0].asked for count in counts), sum(count > 0 for count in counts)
            lines.append(f"| ... cubes, in every orientation / in some | {every} / {some} |")
        lines.append(
            f"| CPU time of an orientation, mean | {1e3 * sum(turn.cpu for turn in turns) / asked:.0f} ms |"
        )
    if plans:
        good = [plan for plan in plans if not plan.failure]
        lines += [
            f"| planned in full, in the orientation that the solver finds | {len(plans)} of 240 |",
            f"| planned / no plan | {len(good)} / {len(plans) - len(good)} |",
            f"| with an order without holds | {sum(plan.free_orders > 0 for plan in good)} |",
            f"| whose chosen order needs a hold | {sum(plan.holds > 0 for plan in good)} |",
            f"| orders without holds, of 5,040: {QUANTILES} | "
            f"{_quantiles([plan.free_orders for plan in good])} |",
            f"| score of the chosen order: {QUANTILES} | {_quantiles([plan.score for plan in good])} |",
        ]
        for name, times in (
            ("wall", [plan.seconds for plan in plans]),
            ("CPU", [plan.cpu for plan in plans]),
        ):
            lines.append(
                f"| {name} time of a plan: median, p95 | {np.median(times):.2f} s, "
                f"{np.percentile(times, 95):.2f} s |"
            )
        failed = ", ".join(str(plan.number) for plan in plans if plan.failure)
        lines += [f"| no plan | {failed} |"] if failed else []
    return "\n".join(lines) + "\n"


def _quantiles(values: Sequence[float]) -> str:
    return (
        ", ".join(f"{value:.3g}" for value in np.quantile(values, (0, 0.25, 0.5, 0.75, 1)))
        if values
        else "none"
    )
