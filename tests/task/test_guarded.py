"""How much of an insertion is slow: from where the piece comes near what stands there."""

from __future__ import annotations

import numpy as np
import pytest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.hulls import Hull
from soma_bullet.assembly.separation import swept_separation
from soma_bullet.frames import Array
from soma_bullet.planner.store import kept_plan
from soma_bullet.robot.model import Cell
from soma_bullet.task.guarded import FREE, guarded_length, last_near
from soma_bullet.task.workcell import Workcell


@pytest.mark.parametrize("name", ["soma3", "soma4", "dowel", "dovetail", "crate"])
def test_it_is_what_samples_along_the_way_say(name: str, cell: Cell) -> None:
    assembly = load_assembly(name)
    workcell, plan = Workcell(assembly, cell), kept_plan(assembly, cell.hands)
    sizes = workcell.sizes
    for k, step in enumerate(plan.steps):
        standing = {s.piece: workcell.settled[s.piece] for s in plan.steps[:k]}

        def body(n: str) -> list[Hull]:
            return [part.moved(workcell.settled[n]) for part in assembly.pieces[assembly.index(n)].body_parts]

        moving, fixed, away = (
            body(step.piece),
            [part for n in standing for part in body(n)],
            -np.array(step.direction),
        )
        length = step.way + workcell.sizes.run_in
        last = last_near(moving, away, length, fixed, sizes.near)
        for s in np.arange(0.0, length, 1e-3):
            gap = (
                swept_separation([part.moved(_shift(s * away)) for part in moving], np.zeros(3), fixed)
                if fixed
                else np.inf
            )
            assert gap >= sizes.near - 1e-9 or s <= last + 1e-9
        guarded = guarded_length(workcell, step.piece, np.array(step.direction), length, standing)
        assert max(sizes.place, min(last + sizes.before_near, length - FREE)) <= guarded + 1e-9
        assert sizes.place <= guarded <= max(sizes.place, length - FREE)


def _shift(by: Array) -> Array:
    moved = np.eye(4)
    moved[:3, 3] = by
    return moved


def test_a_peg_is_guarded_in_its_hole(cell: Cell) -> None:
    assembly = load_assembly("dowel")
    workcell, plan = Workcell(assembly, cell), kept_plan(assembly, cell.hands)
    step = plan.steps[-1]
    standing = {s.piece: workcell.settled[s.piece] for s in plan.steps[:-1]}
    assert (
        guarded_length(
            workcell, step.piece, np.array(step.direction), step.way + workcell.sizes.run_in, standing
        )
        > 2 * workcell.sizes.place
    )
