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
from soma_bullet.planner.assist import SMALLEST_MARGIN
from soma_bullet.planner.equilibrium import classify
from soma_bullet.planner.tables import grasp_poses
from soma_bullet.task.actions.hand_over import HandOver
from soma_bullet.task.actions.put_down import PutDown
from soma_bullet.task.feed import Feed
from soma_bullet.task.limits import Effort
from soma_bullet.task.schedule import Schedule
from soma_bullet.task.search import placing, search
from soma_bullet.task.search.scheduler import Scheduler
from soma_bullet.task.workcell import Workcell
from tests.feeds import APART, ASKEW, AWKWARD, CROWDED, UNSERVED, laid

FEEDS = {"apart": APART, "askew": ASKEW}


@pytest.fixture(scope="module")
def scheduled(workcell: Workcell, plan: AssemblyPlan) -> dict[str, tuple[Feed, Schedule]]:
    feeds = {name: laid(workcell, plan, pieces) for name, pieces in FEEDS.items()}
    return {name: (feed, Scheduler(workcell, plan, feed).find()) for name, feed in feeds.items()}


@pytest.fixture(params=FEEDS)
def case(
    request: pytest.FixtureRequest, scheduled: dict[str, tuple[Feed, Schedule]]
) -> tuple[Feed, Schedule]:
    return scheduled[request.param]


def test_every_step_of_the_plan_is_assigned(case: tuple[Feed, Schedule], plan: AssemblyPlan) -> None:
    _, schedule = case
    assert [(a.step, a.piece) for a in schedule.assignments] == list(enumerate(plan.order))
    for a, step in zip(schedule.assignments, plan.steps, strict=True):
        np.testing.assert_allclose(a.insert.way.direction, step.direction)
        assert a.insert.way.length > step.way


def test_grasps_are_the_plans(case: tuple[Feed, Schedule], plan: AssemblyPlan, workcell: Workcell) -> None:
    for a, step in zip(case[1].assignments, plan.steps, strict=True):
        assert a.insert.grasp in step.grasps
        for hold in step.holds:
            if hold.piece == a.piece:
                assert a.insert.grasp in hold.grasps
        assert a.insert.width == grasp_poses(plan, a.piece)[1][a.insert.grasp]
        assert 0 < a.insert.width <= workcell.cell.arms[a.arm].hand.opening


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
        assert (a.insert.certificate is not None) == (a.piece in a.holds)
        if a.insert.certificate is not None:
            assert a.insert.certificate.margin >= SMALLEST_MARGIN
            assert a.insert.certificate.load.push > 0


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
        grasp, tcp = (
            grasp_poses(plan, a.piece)[0][a.insert.grasp],
            lambda q, arm=a.arm: workcell.robot.tcp(arm, q),
        )
        lift, out = workcell.sizes.lift, workcell.hand(a.arm).way_out
        pick, goal = feed.pose(a.piece) @ grasp, workcell.settled[a.piece] @ grasp
        np.testing.assert_allclose(tcp(a.pick.q_pick), pick, atol=2e-6)
        np.testing.assert_allclose(tcp(a.insert.q_goal), goal, atol=2e-6)
        np.testing.assert_allclose(tcp(a.pick.q_before)[:3, 3], pick[:3, 3] - out * pick[:3, 2], atol=2e-6)
        np.testing.assert_allclose(tcp(a.pick.q_lifted)[:3, 3], pick[:3, 3] + (0, 0, lift), atol=2e-6)
        np.testing.assert_allclose(
            tcp(a.insert.q_ready)[:3, 3], goal[:3, 3] + a.insert.way.sweep()[-1], atol=2e-6
        )
        for q in (
            a.pick.q_before,
            a.pick.q_pick,
            a.pick.q_lifted,
            a.insert.q_ready,
            a.insert.q_goal,
            *(r.q_end for r in a.releases if r.arm == a.arm),
        ):
            arm = workcell.robot.arm(a.arm)
            assert (q >= arm.lower).all() and (q <= arm.upper).all()


@pytest.mark.slow
def test_the_same_search_finds_the_same(
    workcell: Workcell, plan: AssemblyPlan, scheduled: dict[str, tuple[Feed, Schedule]]
) -> None:
    feed, schedule = scheduled["apart"]
    again = Scheduler(workcell, plan, feed).find()
    for a, b in zip(schedule.assignments, again.assignments, strict=True):
        assert (a.arm, a.insert.grasp, a.holds) == (b.arm, b.insert.grasp, b.holds)
        assert (a.pick.q_pick == b.pick.q_pick).all() and (a.insert.q_goal == b.insert.q_goal).all()
    assert schedule.rejections == again.rejections


def test_what_is_excluded_is_not_found_again(
    workcell: Workcell, plan: AssemblyPlan, scheduled: dict[str, tuple[Feed, Schedule]]
) -> None:
    feed, schedule = scheduled["apart"]
    first = schedule.assignments[0]
    scheduler = Scheduler(workcell, plan, feed)
    scheduler.excluded.steps.add((0, first.insert.identity, ()))
    found = scheduler.find().assignments[0]
    assert found.insert.identity != first.insert.identity


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


def put_downs(schedule: Schedule) -> list[PutDown]:
    return [r for a in schedule.assignments for r in a.regrasps if isinstance(r, PutDown)]


@pytest.mark.parametrize("yaw", [0.0, 120.0])
def test_a_piece_that_no_grasp_serves_is_laid_down_before_the_other_hand_holds(
    yaw: float, workcell: Workcell, plan: AssemblyPlan
) -> None:
    """While the first piece is held one arm alone could bring the second, and cannot turn it."""
    second = plan.order[1]
    feed = laid(workcell, plan, {**UNSERVED, second: replace(UNSERVED[second], yaw=yaw)})
    assert feed.regrasps_needed == 1
    first, *rest = Scheduler(workcell, plan, feed).find().assignments
    down = next(r for r in first.regrasps if isinstance(r, PutDown))
    assert down.piece == second and not any(a.regrasps for a in rest)
    grasp = grasp_poses(plan, second)[0][rest[0].insert.grasp]
    np.testing.assert_allclose(
        workcell.robot.tcp(rest[0].arm, rest[0].pick.q_pick), down.pose_down @ grasp, atol=2e-6
    )


@pytest.mark.slow
def test_pieces_are_laid_down_where_the_search_comes_farther(
    workcell: Workcell, plan: AssemblyPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whose turn comes while a hand holds, each once, before the first step; what is ruled out is not
    proposed again."""
    monkeypatch.setattr(search, "BRIEF", ())  # no piece is handed over just to be held from elsewhere
    scheduler = Scheduler(workcell, plan, laid(workcell, plan, AWKWARD))
    held_before = {plan.order[k + 1] for k, step in enumerate(plan.steps[:-1]) if step.holds}
    seen = set()
    for _ in range(2):
        schedule = scheduler.find()
        first, *rest = schedule.assignments
        moved = put_downs(schedule)
        assert moved and not any(isinstance(r, PutDown) for a in rest for r in a.regrasps)
        pieces = [down.piece for down in moved]
        assert len(set(pieces)) == len(pieces) and set(pieces) <= held_before
        beginning = tuple(action.identity for action in first.bring)
        assert not seen & {beginning[:n] for n in range(len(beginning) + 1)}
        at = next(n for n, action in enumerate(first.bring) if action is moved[0])
        seen.add(beginning[: at + 1])
        scheduler.rule_out(first, moved[0])


def test_a_piece_is_handed_over_to_be_held_from_elsewhere(workcell: Workcell, plan: AssemblyPlan) -> None:
    """However an arm picks the first piece where it lies, its hand would leave the second no room."""
    scheduler = Scheduler(workcell, plan, laid(workcell, plan, CROWDED))
    assert scheduler.feed.regrasps_needed == 0
    first, *rest = scheduler.find().assignments
    (regrasp,) = first.regrasps
    assert isinstance(regrasp, HandOver) and regrasp.receiver == first.arm != regrasp.arm
    assert not any(a.regrasps for a in rest)
    assert set(scheduler._searches) == {()}  # in the first attempt of the first round


def test_a_search_without_success_ends(
    workcell: Workcell, plan: AssemblyPlan, feed: Feed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a certain count of lines, the same each time."""
    monkeypatch.setattr(placing.Placer, "check", lambda self, k, state, candidate, picked=None: None)
    counts = []
    for _ in range(2):
        scheduler = Scheduler(workcell, plan, feed, effort=Effort(150))
        with pytest.raises(NoSolutionError):
            scheduler.find()
        counts.append((scheduler.effort.lines, dict(scheduler.refusals.counts)))
    assert counts[0] == counts[1] and counts[0][0] <= 150
