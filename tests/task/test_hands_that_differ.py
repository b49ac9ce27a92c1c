"""A cell whose hands differ: each does what its own hand can, grips with its own force, and is certified with
it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.options import EpisodeOptions
from soma_bullet.pipeline import cell_of, execute, make_program
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.assist import certify_hold
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.store import kept_plan
from soma_bullet.planner.tables import grasp_poses, grasp_table
from soma_bullet.task.actions.action import Action
from soma_bullet.task.actions.hand_over import HandOver
from soma_bullet.task.actions.hold import Hold
from soma_bullet.task.actions.insert import Insert
from soma_bullet.task.actions.pick import Pick
from soma_bullet.task.feed import draw_feed
from soma_bullet.task.schedule import Schedule
from soma_bullet.task.search.scheduler import Scheduler
from soma_bullet.task.workcell import Workcell
from soma_bullet.verdict.judge import judge

MIXED = str(Path(__file__).parents[1] / "data/mixed_pair")
SEEDS = range(4)


@pytest.fixture(scope="module")
def mixed() -> Workcell:
    return Workcell(load_assembly("soma3"), cell_of(EpisodeOptions(cell=MIXED)))


@pytest.fixture(scope="module")
def planned(mixed: Workcell) -> AssemblyPlan:
    return kept_plan(mixed.assembly, mixed.cell.hands, PlannerOptions())


@pytest.fixture(scope="module")
def schedules(mixed: Workcell, planned: AssemblyPlan) -> list[Schedule]:
    feeds = [draw_feed(mixed.assembly, planned, mixed.cell, seed) for seed in SEEDS]
    return [Scheduler(mixed, planned, feed).find() for feed in feeds]


def grips(action: Action) -> tuple[int, str, int, float] | None:
    """Arm, piece, grasp and width of an action that closes a hand by a grasp of a table."""
    if isinstance(action, HandOver):
        return action.receiver, action.piece, action.grasp, action.width
    if isinstance(action, Pick | Insert | Hold):
        return action.arm, action.piece, action.grasp, action.width
    return None


def test_the_hands_differ(mixed: Workcell, planned: AssemblyPlan) -> None:
    one, other = (arm.hand for arm in mixed.cell.arms)
    assert one.opening > other.opening and one.grip_force > other.grip_force
    assert planned.hand_kinds == (0, 1)


def test_each_arm_grips_by_grasps_of_its_own_hand(
    mixed: Workcell, planned: AssemblyPlan, schedules: list[Schedule]
) -> None:
    found = [grip for s in schedules for _, a in s.actions() if (grip := grips(a)) is not None]
    assert {arm for arm, *_ in found} == {0, 1}  # else nothing is shown of one of them
    for arm, piece, grasp, width in found:
        assert grasp_table(planned, piece).kinds[grasp] == planned.hand_kinds[arm]
        assert width == grasp_poses(planned, piece)[1][grasp]
        assert 0 < width <= mixed.cell.arms[arm].hand.opening


def test_holds_are_certified_with_the_hand_that_holds(
    mixed: Workcell, planned: AssemblyPlan, schedules: list[Schedule]
) -> None:
    """The certificate of every hold, worked out again with either hand."""
    arms = set()
    for schedule in schedules:
        for assignment in schedule.assignments:
            for held in (assignment.insert, *assignment.takes):
                if held.certificate is not None:
                    margins = [margin(mixed, planned, assignment.step, arm, held) for arm in (0, 1)]
                    assert held.certificate.margin == pytest.approx(margins[held.arm])
                    assert margins[0] > margins[1]  # the stronger hand's
                    arms.add(held.arm)
    assert arms


def margin(cell: Workcell, plan: AssemblyPlan, k: int, arm: int, held: Insert | Hold) -> float:
    """Of a hold by an arm's hand after step k."""
    assembly, step = cell.assembly, plan.steps[k]
    following = plan.steps[k + 1] if k + 1 < len(plan.steps) else None
    piece, poses = assembly.index(held.piece), grasp_poses(plan, held.piece)[0]
    return certify_hold(
        assembly,
        cell.hand(arm),
        frozenset(assembly.index(s.piece) for s in plan.steps[: k + 1]),
        piece,
        assembly.goals[piece] @ poses[held.grasp],
        "dropped" if step.verdict == "robust" else "frictionless",
        None if following is None else assembly.index(following.piece),
        None if following is None else np.array(following.direction),
        plan.options.load,
        grasp_table(plan, held.piece).contact[held.grasp],
    ).margin


@pytest.mark.slow
def test_different_hands_build_in_physics(mixed: Workcell, planned: AssemblyPlan) -> None:
    """Each hand squeezes with no more than its own force."""
    built = 0
    for seed in (1, 2):
        options = replace(EpisodeOptions(cell=MIXED), seed=seed)
        program = make_program(mixed.assembly, mixed.cell, planned, options)
        log = execute(mixed.assembly, mixed.cell, planned, program, options)
        built += judge(log, mixed.assembly, mixed.cell).success
        for arm, hand in enumerate(arm.hand for arm in mixed.cell.arms):
            forces = log.grips[:, arm]
            assert np.median(forces[forces > 1.0]) < 1.1 * hand.grip_force
    assert built
