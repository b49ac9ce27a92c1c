"""Programs made anew: a motion from measured joints, and all that follows one that failed."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import pytest

from soma_bullet.errors import NoSolutionError
from soma_bullet.frames import Array
from soma_bullet.motion.timing import limit_margins
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.records import to_tree
from soma_bullet.task.actions.action import Action
from soma_bullet.task.feed import Feed
from soma_bullet.task.limits import Effort
from soma_bullet.task.program.builder import WORTH, MotionError, ProgramBuilder
from soma_bullet.task.program.make import make_program, replan
from soma_bullet.task.program.program import Moment, Program
from soma_bullet.task.search.scheduler import Scheduler
from soma_bullet.task.segment import DT
from soma_bullet.task.workcell import Workcell
from tests.task.paths import EXCESS, assert_straight, states

# --- planning on from measured joints -----------------------------------------------------------------------


def perturbed(qs: Array, arm: int, size: float, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    moved = qs.copy()
    moved[arm] += rng.uniform(-size, size, qs.shape[1])
    return moved


@pytest.mark.parametrize("kind", ["retreat", "lift", "place", "insert"])
def test_a_line_is_made_anew_from_where_the_arm_is(kind: str, program: Program, workcell: Workcell) -> None:
    size = 1e-3 if kind == "retreat" else 2e-4
    for k, segment, qs in itertools.islice(
        ((k, s, q) for k, s, q in states(program, workcell) if s.kind.name == kind), 2
    ):
        measured = perturbed(qs, segment.arm, size)
        made = replan(workcell, program, k, measured)
        assert (made.path[0] == measured[segment.arm]).all()
        assert (made.kind.name, made.step, made.piece, made.guard, made.duration) == (
            kind,
            segment.step,
            segment.piece,
            segment.guard,
            0.0,
        )
        np.testing.assert_array_equal(made.offset, segment.offset)
        assert_straight(workcell, made)


@pytest.mark.parametrize("kind", ["transit", "transfer", "home"])
def test_a_transfer_is_made_anew_to_the_same_end(kind: str, program: Program, workcell: Workcell) -> None:
    k, segment, qs = next((k, s, q) for k, s, q in states(program, workcell) if s.kind.name == kind)
    measured = perturbed(qs, segment.arm, 1e-3)
    made = replan(workcell, program, k, measured)
    assert (made.path[0] == measured[segment.arm]).all()
    np.testing.assert_allclose(made.path[-1], segment.path[-1], atol=1e-9)
    speed, acceleration = limit_margins(made.path, *_limits(workcell, segment.arm), DT)
    assert speed <= EXCESS and acceleration <= EXCESS


def _limits(workcell: Workcell, arm: int) -> tuple[Array, Array]:
    return workcell.robot.arm(arm).velocity, workcell.robot.arm(arm).acceleration


def test_what_cannot_be_made_from_there_says_so(program: Program, workcell: Workcell) -> None:
    k, segment, qs = next((k, s, q) for k, s, q in states(program, workcell) if s.kind.name == "lift")
    stretched = qs.copy()
    stretched[segment.arm] = (
        0.0,
        -np.pi / 2,
        0.0,
        0.0,
        0.0,
        0.0,
    )  # straight up: 60 mm higher is out of reach
    with pytest.raises(
        NoSolutionError,
        match=f"{segment.piece}: lift cannot be made from the measured joints: (unreachable|branch)",
    ):
        replan(workcell, program, k, stretched)


# --- a program of which a motion failed ---------------------------------------------------------------------


def test_what_an_earlier_schedule_shares_is_taken_over_and_the_rest_made(
    program: Program, workcell: Workcell, plan: AssemblyPlan, feed: Feed
) -> None:
    """As far as the actions are the same; from there on it is what it would have been without."""
    builder = ProgramBuilder(workcell, feed, program.schedule, 0)
    first = list(builder.run())
    again = list(ProgramBuilder(workcell, feed, program.schedule, 0, earlier=builder.made).run())
    assert all(one is other for one, other in zip(first, again, strict=True))
    scheduler = Scheduler(workcell, plan, feed)
    assignment = scheduler.find().assignments[1]
    scheduler.rule_out(assignment, assignment.insert)
    other = scheduler.find()
    assert other.assignments[1].insert.identity != assignment.insert.identity
    effort = Effort()
    taken = list(ProgramBuilder(workcell, feed, other, 0, earlier=builder.made, effort=effort).run())
    fresh = list(ProgramBuilder(workcell, feed, other, 0).run())
    shared = sum(segment.step == 0 for _, segment, _ in first)
    assert [one is other for one, other in zip(first, taken, strict=False)].count(True) == shared
    assert to_tree([segment for _, segment, _ in taken]) == to_tree([segment for _, segment, _ in fresh])
    made = [segment for _, segment, _ in taken[shared:] if segment.kind.moves]
    assert effort.lines == WORTH * len(made)


def test_a_motion_that_fails_rules_out_what_it_is_of(
    workcell: Workcell, plan: AssemblyPlan, feed: Feed, program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The program is of the next schedule, and says what failed."""
    refused = program.schedule.assignments[0].insert.identity
    make, failed, told = ProgramBuilder.perform, list[str](), list[str]()

    def perform(self: ProgramBuilder, action: Action) -> Iterator[Moment]:
        if action.identity == refused:
            failed.append(action.piece)
            raise MotionError(f"{action.piece}: insert: made up")
        yield from make(self, action)

    monkeypatch.setattr(ProgramBuilder, "perform", perform)
    made = make_program(workcell, plan, feed, 0, told.append)
    assert failed == [plan.order[0]] and told == [f"{plan.order[0]}: insert: made up"]
    assert made.schedule.assignments[0].insert.identity != refused
    assert made.schedule.rejections[told[0]] == 1
