"""A hand that takes hold of a piece in place, after an insertion that is not its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soma_bullet.planner.assembly_plan import AssemblyPlan, Hold
from soma_bullet.planner.assist import HoldCertificate
from soma_bullet.planner.options import HoldLoad
from soma_bullet.planner.plan import make_plan
from soma_bullet.planner.tables import grasp_poses, grasp_table
from soma_bullet.robot.model import Cell
from soma_bullet.task.feed import draw_feed
from soma_bullet.task.feed_options import FeedOptions
from soma_bullet.task.program.make import make_program
from soma_bullet.task.program.program import Program, moments
from soma_bullet.task.workcell import Workcell
from tests.blocks import assembly, box

AFTER = 1  # the step after which the first piece is taken
WIDE, TALL = 0.025, 0.1  # [m] of the posts


@pytest.fixture(scope="module")
def case(cell: Cell) -> tuple[Workcell, AssemblyPlan, Program]:
    """Three posts beside each other, and a plan that asks for the first to be held while the last one
    comes."""
    posts = [
        box((WIDE, WIDE, TALL), "one"),
        box((WIDE, WIDE, TALL), "two"),
        box((WIDE, WIDE, TALL / 2), "three"),
    ]
    whole = assembly(posts, [(-0.06, 0, TALL / 2), (0.06, 0, TALL / 2), (0, 0.06, TALL / 4)])
    plan, workcell = make_plan(whole, cell.hands), Workcell(whole, cell)
    name = plan.order[0]
    table = grasp_table(plan, name)
    not_asked = HoldCertificate(1.0, HoldLoad(), 40.0, 0.5, (0.0,) * 6)
    hold = Hold(name, tuple(range(len(table.widths))), True, 0, not_asked)
    steps = list(plan.steps)
    steps[AFTER] = replace(steps[AFTER], holds=(hold,))
    plan = replace(plan, steps=tuple(steps))
    feed = draw_feed(whole, plan, cell, 0, FeedOptions(layout="rows"))
    return workcell, plan, make_program(workcell, plan, feed, 0)


def test_a_free_hand_takes_it(case: tuple[Workcell, AssemblyPlan, Program]) -> None:
    workcell, plan, program = case
    a, following = program.schedule.assignments[AFTER : AFTER + 2]
    (take,) = a.takes
    assert take.piece == plan.order[0] and a.holds == {take.piece: take.arm}
    assert take.certificate.margin >= 1
    assert following.arm != take.arm and take.piece in [r.piece for r in following.releases]
    at = workcell.robot.tcp(take.arm, take.q_hold)
    np.testing.assert_allclose(
        at, workcell.settled[take.piece] @ grasp_poses(plan, take.piece)[0][take.grasp], atol=2e-6
    )


def test_its_segments(case: tuple[Workcell, AssemblyPlan, Program]) -> None:
    """The hand comes after the insertion has settled, and leaves after the next one."""
    workcell, _, program = case
    take = program.schedule.assignments[AFTER].takes[0]
    mine = [(s.step, s.kind.name) for s in program.segments if s.piece == take.piece and s.step >= AFTER]
    assert mine[:3] == [(AFTER, "transit"), (AFTER, "approach"), (AFTER, "grasp")]
    assert mine[3:5] == [(AFTER + 1, "release"), (AFTER + 1, "retreat")]
    for before, segment, after in moments(workcell, program):
        if segment.kind.name == "grasp" and segment.piece == take.piece and segment.step == AFTER:
            assert after.gripped[take.arm] == take.piece and take.arm not in after.carried
            assert before.placed == after.placed and take.piece in after.placed
