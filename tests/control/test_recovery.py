"""What goes wrong is found again, on a world without physics: pieces that drop, jam, or fall over, and hands
that are interrupted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from soma_bullet.control.execute import Executor, Observation
from soma_bullet.control.executive import RECOVERIES, Executive
from soma_bullet.control.onward import Onward
from soma_bullet.control.options import Compliance, ExecutionOptions
from soma_bullet.control.perception import Perception
from soma_bullet.control.placement import AGAIN
from soma_bullet.control.recovery import FALLEN_DEG, Recovery, Trouble
from soma_bullet.errors import NoSolutionError
from soma_bullet.frames import Array, apply, inverse, make_transform, rotation_about, translate
from soma_bullet.grasp.clearance import OPENING
from soma_bullet.task.feed_options import FeedOptions
from soma_bullet.task.kinds import PLACE
from soma_bullet.task.limits import USUAL, Effort
from soma_bullet.task.program.make import make_program
from soma_bullet.task.program.overlap.loosen import overlapped
from soma_bullet.task.program.program import Program, beginning, moments
from soma_bullet.task.search_options import SearchOptions
from soma_bullet.task.segment import Segment
from soma_bullet.task.state import CellState
from soma_bullet.world.log import ExecutionLog
from tests.control.episodes import judged, ran, world_of
from tests.control.fake import FakeSimulator
from tests.feeds import CROWDED, laid
from tests.soma3 import loosened, planned

UP = np.array((0.0, 0.0, 1.0))


def kinds(log: ExecutionLog) -> list[str]:
    return [event.kind for event in log.events]


def assert_built(log: ExecutionLog) -> None:
    verdict = judged(log)
    assert verdict.success, verdict.causes


# --- what is dropped ----------------------------------------------------------------------------------------


class Dropping(FakeSimulator):
    """One piece drops out of the hand, once, when it is carried so high [m]."""

    above = 0.15
    dropped = ""

    def advance(self) -> None:
        super().advance()
        for arm, (piece, _) in list(self.held.items()):
            pose = self.piece_poses()[piece]
            if not self.dropped and pose[2, 3] > self.above:
                self.dropped = piece
                del self.held[arm]
                self.lying[piece], self.goals[arm] = self.come_to_rest(piece, pose), 0.0


def test_a_piece_that_drops_on_the_way_is_picked_up_again() -> None:
    """The pads come together, which the hand notices; it opens, and all is planned anew."""
    world = world_of(loosened(), Dropping)
    log = ran(loosened(), world)
    assert isinstance(world, Dropping) and world.dropped
    assert_built(log)
    trouble = next(event for event in log.events if event.kind == "trouble")
    assert trouble.piece == world.dropped and "lost in" in trouble.text
    lost = next(s for s in log.segments if s.outcome == "lost")
    opened = next(s for s in log.segments if s.start >= lost.end and s.arm == lost.arm)
    assert (opened.kind, opened.piece) == ("release", world.dropped)
    grasps = [s for s in log.segments if (s.kind, s.piece) == ("grasp", world.dropped)]
    assert len(grasps) == 2 and {s.outcome for s in grasps} == {"as planned"}


# --- what jams ----------------------------------------------------------------------------------------------


class Blocked(FakeSimulator):
    """Something is in the way of every placing, so near to its end [m], until it has gone back so often."""

    times, near, far = 1, 4e-3, 9e-3
    met = False
    backed_off = 0

    def load(self, arm: int) -> Array:
        load = super().load(arm)
        if arm in self.held and self.backed_off < self.times:
            piece = self.held[arm][0]
            left = float(np.linalg.norm(self.piece_poses()[piece] - self.workcell.settled[piece]))
            self.backed_off += self.met and left > self.far
            self.met = left < self.near or (self.met and left <= self.far)
            if left < self.near:
                load[:3] += 20.0 * UP
        return load


class BlockedForGood(Blocked):
    times = 1000


def placings(log: ExecutionLog, piece: str) -> list[str]:
    wanted = ("place", "back_off")
    return [f"{s.kind} {s.outcome}" for s in log.segments if s.kind in wanted and s.piece == piece]


def test_a_placing_that_jams_goes_back_and_is_tried_again() -> None:
    log = ran(loosened(), world_of(loosened(), Blocked))
    assert_built(log)
    first = planned()[1].order[0]
    assert placings(log, first) == ["place jammed", "back_off as planned", "place as planned"]
    jammed, back, _ = (s for s in log.segments if s.kind in ("place", "back_off") and s.piece == first)
    assert 0.0 < jammed.remaining <= Blocked.near + 1e-3 and jammed.peak_force > Compliance().limit
    np.testing.assert_allclose(back.offset, -jammed.offset)
    assert kinds(log)[:3] == ["looked", "jammed", "looked"] and "trouble" not in kinds(log)
    assert log.events[1].text.startswith("force, ")


def test_a_placing_that_jams_is_not_tried_again_without_recovery() -> None:
    first = planned()[1].order[0]
    log = ran(loosened(), world_of(loosened(), BlockedForGood), ExecutionOptions(recover=False))
    assert log.ended == f"{first} jammed in place" and placings(log, first) == ["place jammed"]


@pytest.mark.slow
def test_a_placing_that_jams_is_not_tried_for_ever() -> None:
    first = planned()[1].order[0]
    log = ran(loosened(), world_of(loosened(), BlockedForGood), ExecutionOptions(longest=25.0))
    tried = placings(log, first)[: 2 * AGAIN + 1]
    assert tried == ["place jammed", *AGAIN * ["back_off as planned", "place jammed"]]
    assert "jammed in place" in [event.text for event in log.events]


# --- hands that are interrupted ----------------------------------------------------------------------------


class Interrupted(Executive):
    """Counts it as trouble, once, that two hands have something: two pieces, or one amid a hand-over."""

    pieces = 2
    interrupted: CellState | None = None

    def _after(self, program: Program, k: int, segment: Segment, seen: Observation) -> Trouble | None:
        trouble = super()._after(program, k, segment, seen)
        state = self.state
        carried = [body for body in state.gripped.values() if body not in state.placed]
        both = segment.kind.name == "grasp" and len(carried) == 2 and len(set(carried)) == self.pieces
        if type(self).interrupted is not None or not both:
            return trouble
        type(self).interrupted = state
        return Trouble(k, segment, seen, "interrupted")


class InterruptedHandOver(Interrupted):
    pieces = 1
    interrupted = None


@cache
def handing_over() -> Program:
    workcell, plan, _ = planned()
    return overlapped(workcell, make_program(workcell, plan, laid(workcell, plan, CROWDED), 0))


@pytest.mark.parametrize(
    ("program", "kind"),
    [
        pytest.param(loosened, Interrupted, id="two pieces"),
        pytest.param(handing_over, InterruptedHandOver, id="a hand-over", marks=pytest.mark.slow),
    ],
)
def test_goes_on_where_both_hands_have_something(
    program: Callable[[], Program], kind: type[Interrupted]
) -> None:
    log = ran(program(), world_of(program()), kind=kind)
    assert kind.interrupted is not None
    assert_built(log)
    assert "interrupted" in log.events[kinds(log).index("trouble")].text
    assert kinds(log).count("planned anew") == 1


# --- what falls ---------------------------------------------------------------------------------------------


class FallingAtLast(FakeSimulator):
    """One piece lies on the table when all hands have left."""

    which = -1
    fell = ""

    def advance(self) -> None:
        super().advance()
        order = planned()[1].order
        if self.fell or any(self.forces) or not all(self.stands(name) for name in order):
            return
        if np.abs(np.array(self.targets) - self.robot.home).max() < 1e-6:
            self.fell = order[self.which]
            place = translate(self.workcell.settled[self.fell], (0.2, 0.2, 0.0))
            self.lying[self.fell] = self.come_to_rest(self.fell, place)


class FirstFalling(FallingAtLast):
    which = 0


def test_what_has_fallen_at_last_is_placed_again() -> None:
    world = world_of(loosened(), FallingAtLast)
    log = ran(loosened(), world)
    last = planned()[1].order[-1]
    assert isinstance(world, FallingAtLast) and world.fell == last
    assert_built(log)
    assert "fallen" in kinds(log)
    assert log.events[kinds(log).index("trouble")].text == "fell"
    assert [s.kind for s in log.segments if s.piece == last].count("place") == 2


def test_where_no_step_begins_with_what_stands_it_goes_on_in_another_way() -> None:
    """The first piece lies on the table, and the others stand, as if they could: what is in the way is taken
    out again."""
    log = ran(loosened(), world_of(loosened(), FirstFalling))
    assert_built(log)
    assert kinds(log).count("planned anew") == 1


def test_it_gives_up_where_no_way_is_left_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> Program:
        raise NoSolutionError("schedule", "made up")

    monkeypatch.setattr("soma_bullet.control.onward.recover_program", refused)
    log = ran(loosened(), world_of(loosened(), FirstFalling))
    assert log.ended == f"{planned()[1].order[0]} fell; made up"
    assert kinds(log)[-1] == "given up" and not judged(log).success


# --- the state to go on from --------------------------------------------------------------------------------


def recovery(world: FakeSimulator, program: Program) -> Recovery:
    workcell, plan, _ = planned()
    executor = Executor(world, program, workcell.sizes, Compliance(), 10)
    feed = FeedOptions()
    seen = Perception(world, workcell.assembly, program.feed, feed, 0, executor.note_event)
    return Recovery(workcell, plan, executor, seen)


def world_in(state: CellState) -> FakeSimulator:
    """A world as a state has it, the hands squeezing what they have."""
    world = FakeSimulator(planned()[0], state.poses)
    world.targets, world.gaps = [np.array(q) for q in state.qs], np.array(state.openings)
    world.goals = world.gaps.copy()
    for arm, body in state.gripped.items():
        world.forces[arm] = 20.0
        world.held[arm] = body, inverse(world.tcp(arm)) @ state.poses[body]
    return world


def state_after(kind: str, piece: str) -> tuple[int, CellState]:
    workcell, _, program = planned()
    along = enumerate(moments(workcell, program))
    return next((k, s) for k, (_, segment, s) in along if (segment.kind.name, segment.piece) == (kind, piece))


def held_while_carried() -> CellState:
    """The first piece stands and is held; the other arm carries the second."""
    _, state = state_after("transfer", planned()[1].order[1])
    assert len(state.held) == 1 and len(state.carried) == 1
    return state


def test_what_is_where_it_should_be_is_found_as_it_is() -> None:
    workcell, plan, program = planned()
    state = held_while_carried()
    found, _ = recovery(world_in(state), program).found(program, state, None)
    assert found.placed == state.placed and found.gripped == state.gripped
    assert found.carried.keys() == state.carried.keys()
    for name, pose in state.poses.items():
        np.testing.assert_allclose(found.poses[name], pose, atol=1e-6)
    for arm, T in state.carried.items():
        np.testing.assert_allclose(found.carried[arm], T, atol=1e-6)
    np.testing.assert_allclose(found.qs, state.qs)


def test_a_piece_that_sits_otherwise_in_the_hand_is_found_so() -> None:
    _, _, program = planned()
    state, world = held_while_carried(), world_in(held_while_carried())
    (arm,) = state.carried
    slip = make_transform(rotation_about((0, 0, 1), 0.05), (0.001, 0.0, 0.002))
    world.held[arm] = world.held[arm][0], world.held[arm][1] @ slip
    found, _ = recovery(world, program).found(program, state, None)
    np.testing.assert_allclose(found.carried[arm], state.carried[arm] @ slip, atol=1e-6)


def test_hands_leave_what_has_fallen() -> None:
    """The piece that a hand held lies elsewhere: it opens and goes back; what the other carries it keeps."""
    workcell, plan, program = planned()
    state, world = held_while_carried(), world_in(held_while_carried())
    ((holder, piece),) = state.held.items()
    (carrier,) = state.carried
    world.held.pop(holder)
    world.lying[piece] = fallen = program.feed.pose(piece)
    there = recovery(world, program)
    found, _ = there.found(program, state, None)
    assert found.placed == frozenset() and found.gripped == {carrier: state.gripped[carrier]}
    assert found.carried.keys() == {carrier}
    np.testing.assert_allclose(found.poses[piece], fallen)
    before, after = workcell.robot.tcp(holder, state.qs[holder]), workcell.robot.tcp(holder, found.qs[holder])
    way = workcell.hand(holder).way_out
    np.testing.assert_allclose(after, translate(before, -before[:3, 2] * way), atol=1e-5)
    assert found.openings[holder] == pytest.approx(state.openings[holder] + 2 * OPENING)
    assert [s.kind for s in there.executor.recorder.segments] == ["release", "back_off"]
    assert [event.kind for event in there.executor.recorder.events] == ["looked", "fallen"]


def test_a_hand_that_closed_on_nothing_opens_and_goes_back_as_it_came() -> None:
    workcell, plan, program = planned()
    k, _ = state_after("grasp", plan.order[0])
    before, segment, state = list(moments(workcell, program))[k]
    world = world_in(before)
    arm = segment.arm
    world.gaps[arm] = 0.0
    there = recovery(world, program)
    nothing = Observation("lost", world.measured_joints(), world.openings(), np.zeros(3), 0.0)
    found, _ = there.found(program, before.gripping(arm, segment.piece), Trouble(k, segment, nothing, "lost"))
    assert found.gripped == {} and found.carried == {} and found.placed == before.placed
    approach = next(s for s in reversed(program.segments[:k]) if s.kind.name == "approach")
    np.testing.assert_allclose(found.qs[arm], approach.path[0], atol=1e-9)
    assert segment.width is not None and found.openings[arm] > segment.width


def test_of_two_hands_on_one_piece_one_lets_go() -> None:
    program = handing_over()
    workcell = planned()[0]
    k, state = next(
        (k, s)
        for k, (_, segment, s) in enumerate(moments(workcell, program))
        if len(s.gripped) == 2 and len(set(s.gripped.values())) == 1
    )
    world = world_in(state)
    seen = Observation("jammed", world.measured_joints(), world.openings(), np.zeros(3), 0.0)
    found, _ = recovery(world, program).found(
        program, state, Trouble(k, program.segments[k], seen, "made up")
    )
    assert len(found.gripped) == len(found.carried) == 1
    (arm,) = found.gripped
    np.testing.assert_allclose(found.carried[arm], state.carried[arm], atol=1e-6)


@pytest.mark.parametrize(
    ("share", "deg", "fallen"),
    [
        (0.9, 0.0, False),
        (1.1, 0.0, True),
        (0.0, 0.9 * FALLEN_DEG, False),
        (0.0, 1.1 * FALLEN_DEG, True),
    ],
)
def test_a_piece_that_is_seen_far_from_its_goal_has_fallen(share: float, deg: float, fallen: bool) -> None:
    workcell, plan, program = planned()
    piece = plan.order[0]
    state, body = held_while_carried(), workcell.body(piece)
    about = translate(np.eye(4), apply(workcell.settled[piece], body.center_of_mass))
    turn = about @ make_transform(rotation_about((0, 0, 1), np.deg2rad(deg))) @ inverse(about)
    shift = (share * workcell.sizes.fallen, 0.0, 0.0)
    poses = {**state.poses, piece: translate(turn @ workcell.settled[piece], shift)}
    there = recovery(world_in(state), program)
    assert there.fallen(state, poses) == ([piece] if fallen else [])
    assert plan.order[1] not in there.fallen(state, {**poses, plan.order[1]: np.eye(4)})


def test_a_piece_that_is_beside_its_goal_is_placed_again_unless_something_lies_on_it() -> None:
    workcell, plan, program = planned()
    first, second, third = plan.order
    assert workcell.carries(first, second)
    state = workcell.idle({**workcell.settled, third: program.feed.pose(third)})
    state = state.placing(first).placing(second)
    aside = (1.5 * workcell.sizes.displaced, 0.0, 0.0)
    there = recovery(world_in(state), program)
    for piece, again in ((first, []), (second, [second])):
        poses = {**state.poses, piece: translate(workcell.settled[piece], aside)}
        assert there.displaced(state, poses) == again and there.fallen(state, poses) == []
    both = {**state.poses, **{n: translate(workcell.settled[n], aside) for n in (first, second)}}
    assert there.displaced(state, both) == [first, second]
    found, displaced = recovery(world_in(replace(state, poses=both)), program).found(program, state, None)
    assert found.placed == frozenset() and displaced == [first, second]


def test_a_plan_goes_on_from_any_pieces_that_stand() -> None:
    """The second piece alone is in place: it is taken out, or the others are built around it."""
    workcell, plan, program = planned()
    first, second, _ = plan.order
    state = workcell.idle(
        {**workcell.settled, **{n: program.feed.pose(n) for n in plan.order if n != second}}
    )
    state = state.placing(second)
    onward = Onward(workcell, plan, USUAL)
    found, made = onward.program(plan, state, (), lambda: 1, program.feed, ())
    assert made.start is not None and made.start.placed <= {second}
    steps = {s.piece for s in made.segments if s.kind is PLACE}
    assert steps == set(plan.order) - made.start.placed
    assert {step.piece for step in found.steps[: len(made.start.placed)]} == made.start.placed


def test_what_went_wrong_is_done_differently() -> None:
    workcell, plan, program = planned()
    onward, state = Onward(workcell, plan, USUAL), program.start or beginning(workcell, program.feed, None)
    failed = program.schedule.assignments[0].insert.identity
    _, again = onward.program(plan, state, (), lambda: 1, program.feed, (failed,))
    assert again.schedule.assignments[0].insert.identity != failed


def test_an_episode_recovers_only_so_often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every program ends in trouble at once. Recoveries are searched for as long as the options say."""

    def troubled(self: Executive, program: Program) -> Trouble:
        return Trouble(0, program.segments[0], None, "is made up")

    monkeypatch.setattr(Executive, "_run", troubled)
    given = []

    def recovered(*arguments: object) -> Program:
        effort = arguments[6]
        assert isinstance(effort, Effort)
        given.append(effort.most)
        return replace(planned()[2], start=arguments[2])

    monkeypatch.setattr("soma_bullet.control.onward.recover_program", recovered)
    few = SearchOptions(lines=7)
    log = ran(planned()[2], world_of(planned()[2]), ExecutionOptions(together=False), search=few)
    assert given == [few.lines] * RECOVERIES
    assert kinds(log).count("planned anew") == RECOVERIES and kinds(log).count("trouble") == RECOVERIES + 1
    assert log.ended.endswith("is made up")


def test_a_hold_that_is_ablated_is_not_recovered_from() -> None:
    """Every hand that should hold opens after its placing."""
    log = ran(loosened(), world_of(loosened()), ablate="hold")
    opened = [s.piece for s in log.segments if s.kind == "ablation"]
    assert opened == [step.piece for step in planned()[1].steps if step.holds]
    assert "planned anew" not in kinds(log)
