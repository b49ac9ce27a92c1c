"""The schedule: grasps that the plan allows, two hands that take turns, holds with evidence, releases that
let nothing fall."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soma_bullet.assembly.model import Assembly
from soma_bullet.errors import NoSolutionError
from soma_bullet.frames import readonly
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.equilibrium import classify
from soma_bullet.task import placing, schedule, search
from soma_bullet.task.assignments import HandOver, PutDown, Schedule
from soma_bullet.task.feed import Feed, draw_feed
from soma_bullet.task.feed_options import FeedOptions
from soma_bullet.task.grasps import grasp_poses
from soma_bullet.task.holding import SMALLEST_MARGIN
from soma_bullet.task.schedule import Scheduler
from soma_bullet.task.tracing import APPROACH, LIFT
from soma_bullet.task.workcell import Workcell

SEEDS = (0, 1)


@pytest.fixture(scope="module")
def scheduled(workcell: Workcell, plan: AssemblyPlan) -> dict[int, tuple[Feed, Schedule]]:
    found = {}
    for seed in SEEDS:
        feed = draw_feed(workcell.assembly, plan, workcell.cell, seed, FeedOptions(poses="preferred"))
        found[seed] = feed, Scheduler(workcell, plan, feed).find()
    return found


@pytest.fixture(params=SEEDS)
def case(
    request: pytest.FixtureRequest, scheduled: dict[int, tuple[Feed, Schedule]]
) -> tuple[Feed, Schedule]:
    return scheduled[request.param]


def test_every_step_of_the_plan_is_assigned(case: tuple[Feed, Schedule], plan: AssemblyPlan) -> None:
    _, schedule = case
    assert [(a.step, a.piece) for a in schedule.assignments] == list(enumerate(plan.order))
    for a, step in zip(schedule.assignments, plan.steps, strict=True):
        np.testing.assert_allclose(a.direction, step.direction)
        assert a.length > step.way


def test_grasps_are_the_plans(case: tuple[Feed, Schedule], plan: AssemblyPlan, workcell: Workcell) -> None:
    for a, step in zip(case[1].assignments, plan.steps, strict=True):
        assert a.grasp in step.grasps
        for hold in step.holds:
            if hold.piece == a.piece:
                assert a.grasp in hold.grasps
        assert a.width == grasp_poses(plan, a.piece)[1][a.grasp]
        assert 0 < a.width <= workcell.cell.arms[a.arm].hand.opening


def test_held_is_what_the_plan_holds(case: tuple[Feed, Schedule], plan: AssemblyPlan) -> None:
    for a, step in zip(case[1].assignments, plan.steps, strict=True):
        assert set(a.holds) == {hold.piece for hold in step.holds}
    assert case[1].assignments[-1].holds == {}


def test_the_holder_does_not_insert(case: tuple[Feed, Schedule]) -> None:
    before: dict[str, int] = {}
    for a in case[1].assignments:
        assert a.arm not in before.values()
        assert len(set(a.holds.values())) == len(a.holds)
        assert {release.arm for release in a.releases} | set(a.holds.values()) == {a.arm, *before.values()}
        before = a.holds


def test_holds_have_their_certificate(case: tuple[Feed, Schedule]) -> None:
    for a in case[1].assignments:
        assert (a.certificate is not None) == (a.piece in a.holds)
        if a.certificate is not None:
            assert a.certificate.margin >= SMALLEST_MARGIN
            assert a.certificate.load.push > 0


def test_letting_go_lets_nothing_fall(case: tuple[Feed, Schedule], soma3: Assembly) -> None:
    placed: set[str] = set()
    held: set[str] = set()
    for a in case[1].assignments:
        placed, held = placed | {a.piece}, held | {a.piece}
        for release in a.releases:
            held = held - {release.piece}
            indices = (frozenset(soma3.index(name) for name in names) for names in (placed, held))
            assert classify(soma3, *indices).verdict != "unstable"
        assert held == set(a.holds)


def test_joints_reach_what_they_are_for(
    case: tuple[Feed, Schedule], plan: AssemblyPlan, workcell: Workcell
) -> None:
    feed, schedule = case
    for a in schedule.assignments:
        grasp, tcp = grasp_poses(plan, a.piece)[0][a.grasp], lambda q, arm=a.arm: workcell.robot.tcp(arm, q)
        pick, goal = feed.pose(a.piece) @ grasp, workcell.settled[a.piece] @ grasp
        np.testing.assert_allclose(tcp(a.q_pick), pick, atol=2e-6)
        np.testing.assert_allclose(tcp(a.q_goal), goal, atol=2e-6)
        np.testing.assert_allclose(tcp(a.q_before)[:3, 3], pick[:3, 3] - APPROACH * pick[:3, 2], atol=2e-6)
        np.testing.assert_allclose(tcp(a.q_lifted)[:3, 3], pick[:3, 3] + (0, 0, LIFT), atol=2e-6)
        np.testing.assert_allclose(tcp(a.q_ready)[:3, 3], goal[:3, 3] - a.length * a.direction, atol=2e-6)
        for q in (
            a.q_before,
            a.q_pick,
            a.q_lifted,
            a.q_ready,
            a.q_goal,
            *(r.q_end for r in a.releases if r.arm == a.arm),
        ):
            arm = workcell.robot.arm(a.arm)
            assert (q >= arm.lower).all() and (q <= arm.upper).all()


@pytest.mark.slow
def test_the_same_search_finds_the_same(
    workcell: Workcell, plan: AssemblyPlan, scheduled: dict[int, tuple[Feed, Schedule]]
) -> None:
    feed, schedule = scheduled[SEEDS[0]]
    again = Scheduler(workcell, plan, feed).find()
    for a, b in zip(schedule.assignments, again.assignments, strict=True):
        assert (a.arm, a.grasp, a.holds) == (b.arm, b.grasp, b.holds)
        assert (a.q_pick.tobytes(), a.q_goal.tobytes()) == (b.q_pick.tobytes(), b.q_goal.tobytes())
    assert schedule.rejections == again.rejections


def test_what_is_excluded_is_not_found_again(
    workcell: Workcell, plan: AssemblyPlan, scheduled: dict[int, tuple[Feed, Schedule]]
) -> None:
    feed, schedule = scheduled[SEEDS[0]]
    first = schedule.assignments[0]
    scheduler = Scheduler(workcell, plan, feed)
    scheduler.excluded.add((0, first.arm, first.grasp))
    found = scheduler.find().assignments[0]
    assert (found.arm, found.grasp) != (first.arm, first.grasp)


@pytest.mark.slow
def test_a_piece_out_of_reach(workcell: Workcell, plan: AssemblyPlan, feed: Feed) -> None:
    poses = np.array(feed.poses)
    poses[feed.names.index("BigL"), :2, 3] = (0.0, 2.0)
    with pytest.raises(NoSolutionError) as caught:
        Scheduler(workcell, plan, replace(feed, poses=readonly(poses))).find()
    reasons = {reason for reason, count in caught.value.reasons.items() if count > 0}
    assert {"BigL: left arm does not reach the feed", "BigL: right arm does not reach the feed"} <= reasons
    assert caught.value.stage == "schedule"
    assert "does not reach the feed" in str(caught.value)


@pytest.mark.slow
def test_pieces_are_laid_down_where_the_search_comes_farther(
    workcell: Workcell, plan: AssemblyPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Z not being handed over, BigL can only be brought to it from some places, and smallL then lies badly as
    well."""
    monkeypatch.setattr(search, "BRIEF", ())
    scheduler = Scheduler(workcell, plan, draw_feed(workcell.assembly, plan, workcell.cell, 2001))
    schedule = scheduler.find()
    moved = [regrasp for a in schedule.assignments for regrasp in a.regrasps if isinstance(regrasp, PutDown)]
    assert [regrasp.piece for regrasp in moved] == ["BigL", "smallL"]
    scheduler.rule_out(schedule.assignments[0], moved[0])
    other = [
        regrasp
        for a in scheduler.find().assignments
        for regrasp in a.regrasps
        if isinstance(regrasp, PutDown)
    ]
    assert all(not np.allclose(regrasp.pose_down, moved[0].pose_down) for regrasp in other)


def test_a_piece_is_handed_over_to_be_held_from_elsewhere(workcell: Workcell, plan: AssemblyPlan) -> None:
    """However an arm picks Z where it lies, the hand that holds it leaves BigL no room."""
    scheduler = Scheduler(workcell, plan, draw_feed(workcell.assembly, plan, workcell.cell, 8409))
    regrasps = [[type(regrasp) for regrasp in a.regrasps] for a in scheduler.find().assignments]
    assert regrasps == [[HandOver], [], []]
    assert set(scheduler._searches) == {()}  # in the first attempt of the first round


def test_a_search_without_success_ends(
    workcell: Workcell, plan: AssemblyPlan, feed: Feed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a certain count of lines, the same each time."""
    monkeypatch.setattr(placing.Placer, "placing", lambda self, k, state, candidate: None)
    monkeypatch.setattr(schedule, "MOST_LINES", 150)
    counts = []
    for _ in range(2):
        scheduler = Scheduler(workcell, plan, feed)
        with pytest.raises(NoSolutionError):
            scheduler.find()
        counts.append((scheduler._effort.lines, dict(scheduler.rejections)))
    assert counts[0] == counts[1] and counts[0][0] <= 150
