"""Soma cubes that no file lists: planned, and their insertions followed cell by cell."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
import pytest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.assembly.packings import (
    SIDE,
    Packing,
    draw_soma_cubes,
    piece_cells,
    sides_down,
    soma_cube,
    soma_cubes,
)
from soma_bullet.frames import Array, apply
from soma_bullet.grasp.hand import Hand
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.plan import NoPlanError, make_plan

STEP = 0.05  # of a cell, along a way
TOUCH = 0.01  # of a cell: cells that face each other may overlap by this much
DRAWN = draw_soma_cubes(6, 0)


def cells_at_goal(assembly: Assembly) -> Packing:
    """Cells of every piece, from its pose."""
    found = []
    for piece, goal in zip(assembly.pieces, assembly.goals, strict=True):
        centres = apply(goal, np.array(piece_cells(piece), float) * SIDE) / SIDE - (0.0, 0.0, 0.5)
        assert np.allclose(centres, np.rint(centres), atol=1e-9)
        found.append(tuple(sorted((int(x), int(y), int(z)) for x, y, z in np.rint(centres))))
    return tuple(found)


def first_hit(moving: Array, direction: Array, placed: Array, reach: float = 6.0) -> float | None:
    """How far back along its way a piece of cells (m, 3) meets one of (n, 3), or the table; None: nowhere.

    In cells, at steps: two cells overlap where their centres are less than a cell apart along every axis.
    """
    for back in np.arange(0.0, reach, STEP):
        at = moving - back * direction
        if at[:, 2].min() < -TOUCH:
            return float(back)
        if len(placed) and (np.abs(at[:, None] - placed[None]).max(axis=2) < 1.0 - TOUCH).any():
            return float(back)
    return None


def assert_buildable(assembly: Assembly, plan: AssemblyPlan) -> None:
    """Every step of the plan's order goes in without entering anything, and stands."""
    cells = dict(zip(assembly.names, (np.array(c, float) for c in cells_at_goal(assembly)), strict=True))
    placed = np.zeros((0, 3))
    for step in plan.steps:
        assert np.linalg.norm(step.direction) == pytest.approx(1.0)
        assert first_hit(cells[step.piece], np.array(step.direction), placed) is None, step.piece
        assert step.verdict != "unstable" and step.grasps
        placed = np.vstack([placed, cells[step.piece]])
    assert len(placed) == 27


def test_the_check_of_cells_sees_what_is_in_the_way() -> None:
    cell, around = np.zeros((1, 3)), np.array([c for c in product((-1, 0, 1), repeat=3) if any(c)], float)
    down = np.array((0.0, 0.0, -1.0))
    assert first_hit(cell, down, np.zeros((0, 3))) is None
    assert first_hit(cell, -down, np.zeros((0, 3))) == pytest.approx(STEP)  # out through the table
    assert first_hit(cell, down, around) == pytest.approx(STEP)
    well = np.array([c for c in around if tuple(c) != (0, 0, 1)])
    assert first_hit(cell, down, well) is None
    aslant = np.array((1.0, 0.0, -1.0)) / np.sqrt(2)
    assert first_hit(cell, aslant, around[around[:, 0] > -1]) == pytest.approx(STEP)  # hits what lies above
    assert first_hit(cell, aslant, around[(around[:, 0] > -1) & (around[:, 2] < 1)]) is None


@pytest.fixture(scope="module")
def planned(hand: Hand) -> AssemblyPlan:
    """The cube of the examples."""
    return make_plan(load_assembly("cube"), HandSet.alike(hand))


@pytest.mark.slow
def test_the_cube_of_the_examples_needs_no_hold(planned: AssemblyPlan) -> None:
    assert all(step.holds == () for step in planned.steps)
    assert any(row.feasible and row.stable_throughout for row in planned.orders)
    assert len(planned.orders) == 5040
    assert_buildable(load_assembly("cube"), planned)


@pytest.mark.slow
@pytest.mark.parametrize("number", DRAWN)
def test_other_soma_cubes_are_planned(number: int, hand: Hand) -> None:
    """On one of its sides; on another it may happen that the hand reaches none of the pieces that could go in
    last."""
    assert cells_at_goal(soma_cube(number)) == soma_cubes()[number]
    cube, plan = planned_on_some_side(number, hand)
    assert plan.steps[-1].holds == ()
    assert any(row.feasible and row.stable_throughout for row in plan.orders)
    assert_buildable(cube, plan)


def planned_on_some_side(number: int, hand: Hand) -> tuple[Assembly, AssemblyPlan]:
    for turn in sides_down():
        cube = soma_cube(number, turn)
        try:
            plan = make_plan(cube, HandSet.alike(hand))
            if not plan.warnings:
                return cube, plan
        except NoPlanError as error:
            # the orders that stand throughout fail for a grasp, and for nothing else
            assert {row.blocked_by for row in error.rows if row.stable_throughout} <= {
                "graspability",
                "assemblability",
            }
    raise AssertionError(f"cube {number} has no plan on any side")


def size(body: Array, direction: Sequence[float]) -> float:
    """Extent of cells (m, 3) along a unit direction, in cells."""
    return float(np.ptp(body @ direction) + np.abs(direction).sum())


@pytest.mark.slow
def test_every_direction_of_every_order_is_clear(planned: AssemblyPlan) -> None:
    """Over the piece's own size; where there is none, the axes at least are blocked."""
    cube = load_assembly("cube")
    cells = dict(zip(cube.names, (np.array(c, float) for c in cells_at_goal(cube)), strict=True))
    ways = {
        (frozenset(row.order[:k]), piece): direction
        for row in planned.orders
        for k, (piece, direction) in enumerate(zip(row.order, row.directions, strict=True))
    }
    assert len(ways) == 7 * 2**6
    blocked = 0
    for (placed, piece), direction in ways.items():
        others, body = np.vstack([np.zeros((0, 3)), *(cells[name] for name in sorted(placed))]), cells[piece]
        if direction is not None:
            assert first_hit(body, np.array(direction), others, size(body, direction)) is None, (
                placed,
                piece,
                direction,
            )
            continue
        blocked += 1
        for axis in (*np.eye(3), *-np.eye(3)):
            assert first_hit(body, axis, others, size(body, axis)) is not None, (placed, piece, axis)
    assert 0 < blocked < len(ways)
