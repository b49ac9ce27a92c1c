"""An action that the package does not have, in one file: it is planned, followed, timed, executed and
recorded like any other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from soma_bullet.control.execute import Executor
from soma_bullet.control.executive import Executive
from soma_bullet.control.options import Compliance, ExecutionOptions
from soma_bullet.frames import Array, translate
from soma_bullet.grasp.clearance import sweep_hand
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.records import read_npz, write_npz
from soma_bullet.task.feed import Feed
from soma_bullet.task.feed_options import FeedOptions
from soma_bullet.task.kinds import KINDS
from soma_bullet.task.program.builder import ProgramBuilder
from soma_bullet.task.program.overlap.loosen import overlapped
from soma_bullet.task.program.program import Program, moments, one_at_a_time
from soma_bullet.task.refusal import Refusal
from soma_bullet.task.schedule import Schedule
from soma_bullet.task.search.planning import Fetch
from soma_bullet.task.search.scheduler import Scheduler
from soma_bullet.task.state import CellState
from soma_bullet.task.workcell import Workcell
from soma_bullet.verdict.judge import judge
from tests.control.fake import FakeSimulator
from tests.task import push
from tests.task.push import PUSH, TOUCH, Push

LENGTH = 0.03  # [m] by which a piece is pushed
GRAZE = 0.02e-3  # [m] that a hand comes into a piece before that gives way
EXACT = 0.2e-3  # [m] the hand moves less from one sample to the next
NEARBY = 0.1  # [m] from a piece's frame to the middle of the pads: farther, they do not meet


class WithFingers(FakeSimulator):
    """A world whose closed hands push what lies in their way."""

    def command_arm(self, arm: int, q: Array) -> None:
        before = self.tcp(arm)[:3, 3]
        super().command_arm(arm, q)
        T = self.tcp(arm)
        if arm in self.held or self.gaps[arm] > 0.0:
            return
        hand = sweep_hand(self.cell.arms[arm].hand, T[None], np.zeros(1), 0.0, 0.0)
        for name, pose in self.lying.items():
            if np.linalg.norm(pose[:3, 3] - T[:3, 3]) < NEARBY:
                parts = [part.moved(pose) for part in self.workcell.body(name).body_parts]
                if hand.separation(parts)[0] < -GRAZE:
                    self.lying[name] = translate(pose, T[:3, 3] - before)


@pytest.fixture(scope="module")
def scheduler(workcell: Workcell, plan: AssemblyPlan, feed: Feed) -> Scheduler:
    return Scheduler(workcell, plan, feed)


def fetch_of(scheduler: Scheduler, k: int = 0) -> Fetch:
    """The piece of a step where it lies, before anything has happened."""
    planning = scheduler.feed_search.planning
    piece = scheduler.plan.steps[k].piece
    return Fetch(piece, planning.spots[piece], planning.empty(0))


@pytest.fixture(scope="module")
def pushed(scheduler: Scheduler) -> Push:
    """The first push of the first piece that is free, as a search would find it."""
    planning, fetch = scheduler.feed_search.planning, fetch_of(scheduler)
    ways = push.candidates(planning, fetch)
    return next(p for way in ways if (p := push.check(planning, fetch, *way, LENGTH)) is not None)


@pytest.fixture(scope="module")
def start(scheduler: Scheduler) -> CellState:
    return fetch_of(scheduler).state


@pytest.fixture(scope="module")
def pushing(workcell: Workcell, program: Program, pushed: Push, start: CellState) -> Program:
    """A program of nothing but the push, from a state as found."""
    schedule = Schedule((), {}, (pushed,))
    segments = [s for _, s, _ in ProgramBuilder(workcell, program.feed, schedule, 0, start).run()]
    after = one_at_a_time(len(segments))
    return replace(program, schedule=schedule, segments=tuple(segments), after=after, start=start)


# --- planning -----------------------------------------------------------------------------------------------


def test_candidates_are_every_arm_and_face_once(scheduler: Scheduler) -> None:
    ways = push.candidates(scheduler.feed_search.planning, fetch_of(scheduler))
    assert len(ways) == len(set(ways)) >= 2 * 4


def test_a_push_that_is_free_has_its_joints(scheduler: Scheduler, pushed: Push, workcell: Workcell) -> None:
    pose, tcp = scheduler.feed.pose(pushed.piece), workcell.robot.tcp
    way = push.ways(workcell, pushed.piece, pose)[pushed.face]
    np.testing.assert_allclose(pushed.offset, LENGTH * way)
    places = [tcp(pushed.arm, q) for q in (pushed.q_before, pushed.q_touch, pushed.q_pushed, pushed.q_away)]
    for place, shift in zip(places, (-push.RUN_UP, 0.0, LENGTH, LENGTH - push.RUN_UP), strict=True):
        np.testing.assert_allclose(place, translate(places[1], shift * way), atol=5e-6)
    parts = [part.moved(pose) for part in workcell.body(pushed.piece).body_parts]
    hand = sweep_hand(workcell.hand(pushed.arm), places[1][None], np.zeros(1), opening=0.0, way_out=0.0)
    assert hand.separation(parts)[0] == pytest.approx(0.0, abs=1e-5)
    assert hand.above(0.0)[0] == pytest.approx(push.ABOVE, abs=1e-5)
    assert pushed.identity not in {p.identity for p in other_ways(scheduler, pushed)}


def other_ways(scheduler: Scheduler, pushed: Push) -> Iterator[Push]:
    planning, fetch = scheduler.feed_search.planning, fetch_of(scheduler)
    for way in push.candidates(planning, fetch):
        found = push.check(planning, fetch, *way, LENGTH)
        if found is not None and (found.arm, found.face) != (pushed.arm, pushed.face):
            yield found


def test_a_push_that_is_not_free_is_refused_with_the_pair(scheduler: Scheduler, pushed: Push) -> None:
    """Another piece lies where the first is to go."""
    planning = Scheduler(scheduler.workcell, scheduler.plan, scheduler.feed).feed_search.planning
    piece, other = (step.piece for step in scheduler.plan.steps[:2])
    ahead = translate(scheduler.feed.pose(piece), 1.5 * pushed.offset)
    state = planning.empty(0).moved(other, ahead)
    fetch = Fetch(piece, planning.spots[piece], state)
    refusals = planning.lines.refusals
    before = sum(refusals.counts.values())
    assert push.check(planning, fetch, pushed.arm, pushed.face, LENGTH) is None
    met = [r for r in refusals.counts if r.pair is not None and other in r.pair]
    assert met and sum(refusals.counts.values()) > before
    assert all(isinstance(r, Refusal) and r.piece == piece for r in met)


# --- effects and segments -----------------------------------------------------------------------------------


def assert_pushed(start: CellState, after: CellState, pushed: Push) -> None:
    """The piece is farther along the table; all else, and the hand, is as before."""
    for name, pose in start.poses.items():
        shift = pushed.offset if name == pushed.piece else np.zeros(3)
        np.testing.assert_allclose(after.poses[name], translate(pose, shift), atol=1e-5)
    assert after.gripped == {} and after.carried == {} and after.placed == start.placed
    np.testing.assert_allclose(after.qs[pushed.arm], pushed.q_away, atol=1e-5)
    assert (after.qs[1 - pushed.arm] == start.qs[1 - pushed.arm]).all()


def test_its_effects_follow_from_its_steps(workcell: Workcell, start: CellState, pushed: Push) -> None:
    assert_pushed(start, pushed.effects(workcell, start), pushed)


def test_it_becomes_segments(workcell: Workcell, pushing: Program, start: CellState, pushed: Push) -> None:
    kinds = [s.kind for s in pushing.segments]
    assert [kind.name for kind in kinds] == ["transit", "approach", "touch", "push", "retreat"]
    for before, segment, _ in moments(workcell, pushing):
        if segment.kind.moves:
            np.testing.assert_allclose(segment.path[0], before.qs[pushed.arm], atol=1e-9)
        if segment.kind is PUSH:
            assert before.gripped == {pushed.arm: pushed.piece} and pushed.arm in before.carried
            speed = np.linalg.norm(segment.offset) / segment.seconds
            assert 0.5 * push.GENTLE.speed < speed < push.GENTLE.speed
    *_, (_, _, after) = moments(workcell, pushing)
    assert_pushed(start, after, pushed)


def test_arms_at_the_same_time_leave_it_as_it_is(workcell: Workcell, pushing: Program) -> None:
    together = overlapped(workcell, pushing)
    assert [s.kind for s in together.segments] == [s.kind for s in pushing.segments]


# --- execution ----------------------------------------------------------------------------------------------


def test_it_is_executed(
    workcell: Workcell, plan: AssemblyPlan, pushing: Program, start: CellState, pushed: Push
) -> None:
    world = WithFingers(workcell, start.poses)
    executor = Executor(world, pushing, workcell.sizes, Compliance(), 10)
    executive = Executive(workcell, plan, pushing, executor, FeedOptions(), ExecutionOptions())
    assert executive._run(pushing) is None
    assert {record.outcome for record in executor.recorder.segments} == {"as planned"}
    assert_pushed(start, executive.state, pushed)
    for name, pose in world.piece_poses().items():
        np.testing.assert_allclose(pose, executive.state.poses[name], atol=EXACT)


def test_a_task_of_which_it_is_a_part_is_built(
    workcell: Workcell, plan: AssemblyPlan, pushing: Program, scheduler: Scheduler, pushed: Push
) -> None:
    """The piece is pushed, and picked from where it lies then."""
    feed = scheduler.feed
    poses = np.array(feed.poses)
    poses[feed.names.index(pushed.piece), :3, 3] += pushed.offset
    found = Scheduler(workcell, plan, replace(feed, poses=poses)).find()
    first, *rest = found.assignments
    schedule = replace(found, assignments=(replace(first, bring=(pushed, *first.bring)), *rest))
    segments = [s for _, s, _ in ProgramBuilder(workcell, feed, schedule, 0).run()]
    after = one_at_a_time(len(segments))
    whole = replace(pushing, schedule=schedule, segments=tuple(segments), after=after, start=None)
    world = WithFingers(workcell, {name: feed.pose(name) for name in feed.names})
    executor = Executor(world, whole, workcell.sizes, Compliance(), 10)
    ended = Executive(workcell, plan, whole, executor, FeedOptions(), ExecutionOptions()).run()
    executor.settle()
    log = executor.log(ended)
    verdict = judge(log, workcell.assembly, workcell.cell)
    assert verdict.success, verdict.causes
    assert {event.kind for event in log.events} == {"looked"}


# --- records ------------------------------------------------------------------------------------------------


def test_it_is_written_and_read_back(pushing: Program, pushed: Push, tmp_path: Path) -> None:
    write_npz(pushing.schedule, tmp_path / "schedule.npz")
    (read,) = read_npz(Schedule, tmp_path / "schedule.npz").changes
    assert isinstance(read, Push) and read.identity == pushed.identity
    np.testing.assert_array_equal(read.q_pushed, pushed.q_pushed)
    write_npz(pushing, tmp_path / "one.npz")
    again = read_npz(Program, tmp_path / "one.npz")
    assert [s.kind for s in again.segments if s.kind in (TOUCH, PUSH)] == [TOUCH, PUSH]
    assert all(s.kind is KINDS[s.kind.name] for s in again.segments)
    write_npz(again, tmp_path / "two.npz")
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()
