"""What is ruled out after it failed, and what is not."""

from __future__ import annotations

from dataclasses import replace

import pytest

from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.task.actions.action import Action
from soma_bullet.task.actions.hand_over import HandOver
from soma_bullet.task.actions.insert import Candidate
from soma_bullet.task.actions.square import Square
from soma_bullet.task.feed import Feed
from soma_bullet.task.schedule import Schedule
from soma_bullet.task.search.scheduler import Scheduler
from soma_bullet.task.workcell import Workcell
from tests.feeds import APART, CROWDED, laid


def blamed(which: str, schedule: Schedule) -> Action:
    first = schedule.assignments[0]
    bring = {"hand over": first.bring[-1], "first": first.bring[0]}
    action = {"pick": first.pick, "insert": first.insert, **bring}[which]
    assert action is not None
    return action


@pytest.mark.parametrize("which", ["pick", "insert"])
def test_an_insertion_that_is_to_blame_is_ruled_out_however_the_piece_comes(
    which: str, workcell: Workcell, plan: AssemblyPlan, feed: Feed
) -> None:
    scheduler = Scheduler(workcell, plan, feed)
    found = scheduler.find()
    first = found.assignments[0]
    scheduler.rule_out(first, blamed(which, found))
    placer = scheduler.feed_search.placer
    assert placer.ruled_out(first) and placer.ruled_out(replace(first, bring=()))
    grip = scheduler.feed_search.planning.graph(first.piece).grip(first.insert.grasp)
    assert placer.refused(0, Candidate(first.arm, grip))
    assert not placer.refused(1, Candidate(first.arm, grip))
    assert not placer.refused(0, Candidate(1 - first.arm, grip))
    again = scheduler.find().assignments[0]
    assert again.insert.identity != first.insert.identity


def test_an_insertion_that_is_to_blame_is_ruled_out_also_where_the_piece_was_handed_over(
    workcell: Workcell, plan: AssemblyPlan
) -> None:
    scheduler = Scheduler(workcell, plan, laid(workcell, plan, CROWDED))
    first = scheduler.find().assignments[0]
    assert first.regrasps
    scheduler.rule_out(first, first.insert)
    placer = scheduler.feed_search.placer
    assert placer.ruled_out(first) and placer.ruled_out(replace(first, bring=()))


@pytest.mark.parametrize("which", ["hand over", "first"])
def test_a_way_to_bring_a_piece_is_ruled_out_by_itself(
    which: str, workcell: Workcell, plan: AssemblyPlan
) -> None:
    scheduler = Scheduler(workcell, plan, laid(workcell, plan, CROWDED))
    found = scheduler.find()
    first = found.assignments[0]
    assert isinstance(first.bring[-1], HandOver)
    scheduler.rule_out(first, blamed(which, found))
    placer = scheduler.feed_search.placer
    assert placer.ruled_out(first) and not placer.ruled_out(replace(first, bring=()))
    grip = scheduler.feed_search.planning.graph(first.piece).grip(first.insert.grasp)
    assert not placer.refused(0, Candidate(first.arm, grip))
    again = scheduler.find().assignments[0]
    assert [a.identity for a in again.bring] != [a.identity for a in first.bring]


def test_a_squaring_is_ruled_out_by_itself(workcell: Workcell, plan: AssemblyPlan) -> None:
    scheduler = Scheduler(workcell, plan, laid(workcell, plan, APART, (0.5, 0.5)))
    first = scheduler.find().assignments[0]
    square = first.bring[0]
    assert isinstance(square, Square)
    scheduler.rule_out(first, square)
    assert scheduler.excluded.actions == {square.identity} and not scheduler.excluded.steps
    again = scheduler.find().assignments[0]
    assert again.insert.identity == first.insert.identity
    assert square.identity not in [action.identity for action in again.bring]
