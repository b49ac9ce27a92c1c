"""The state that a recovery goes on from: what stands, what the hands have, and what they let go of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soma_bullet.control.execute import Executor, Observation
from soma_bullet.control.onward import Onward
from soma_bullet.control.options import Compliance
from soma_bullet.control.perception import Perception
from soma_bullet.control.recovery import FALLEN_DEG, Recovery, Trouble
from soma_bullet.frames import apply, inverse, make_transform, rotation_about, translate
from soma_bullet.grasp.clearance import OPENING
from soma_bullet.task.feed_options import FeedOptions
from soma_bullet.task.kinds import PLACE
from soma_bullet.task.limits import USUAL
from soma_bullet.task.program.program import Program, beginning, moments
from soma_bullet.task.state import CellState
from tests.control.fake import FakeSimulator
from tests.soma3 import handing_over, planned


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
