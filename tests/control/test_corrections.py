"""What the executive makes of a piece that it sees elsewhere in the hand than planned; nothing moves here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from soma_bullet.control.correction import SHARES, Correction
from soma_bullet.control.executive import Executive
from soma_bullet.control.options import ExecutionOptions
from soma_bullet.control.placement import DOUBT, LOOKS
from soma_bullet.frames import Array, inverse
from soma_bullet.task.feed_options import FeedOptions
from soma_bullet.task.segment import Segment
from tests.soma3 import planned


def before_placing(
    shift: Array, turn: Array, noise: tuple[float, float] = (0.0, 0.0)
) -> tuple[Executive, Segment]:
    """The first piece is about to be placed, displaced in the hand by a shift [m] and a turn [rad] about the
    hand's centre."""
    workcell, plan, program = planned()
    segment = next(s for s in program.segments if s.kind.name == "place")
    robot, arm = workcell.robot, segment.arm
    T_tcp_piece = inverse(robot.tcp(arm, segment.path[-1])) @ workcell.settled[segment.piece]
    slip = np.eye(4)
    slip[:3, :3], slip[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    qs = np.array(robot.home)
    qs[arm] = segment.path[0]
    poses = {name: np.array(program.feed.pose(name)) for name in program.feed.names}
    poses[segment.piece] = robot.tcp(arm, qs[arm]) @ slip @ T_tcp_piece
    world = SimpleNamespace(measured_joints=lambda: qs, piece_poses=lambda: poses, time=0.0)
    events: list[tuple[str, str, str]] = []
    note = events.append
    executor = SimpleNamespace(
        world=world, events=events, seed=program.seed, note_event=lambda *event: note(event)
    )
    feed = FeedOptions(noise_mm=noise[0], noise_deg=noise[1])
    executive = Executive(workcell, plan, program, executor, feed, ExecutionOptions())  # type: ignore[arg-type]
    executive.state = executive.state.gripping(arm, segment.piece)
    return executive, segment


def ends_at_goal(executive: Executive, segment: Segment, shift: Array, turn: Array) -> tuple[float, float]:
    """Where the displaced piece ends with a corrected placing: off its goal by [m], [rad]."""
    robot, goal = executive.workcell.robot, executive.workcell.settled[segment.piece]
    T_tcp_piece = (
        inverse(robot.tcp(segment.arm, executive.program.segments[_index(executive, segment)].path[-1]))
        @ goal
    )
    slip = np.eye(4)
    slip[:3, :3], slip[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    ended = robot.tcp(segment.arm, segment.path[-1]) @ slip @ T_tcp_piece
    away = Rotation.from_matrix(ended[:3, :3] @ goal[:3, :3].T).magnitude()
    return float(np.linalg.norm(ended[:3, 3] - goal[:3, 3])), float(away)


def _index(executive: Executive, segment: Segment) -> int:
    return next(
        k
        for k, s in enumerate(executive.program.segments)
        if (s.kind.name, s.piece) == ("place", segment.piece)
    )


def corrected(executive: Executive, segment: Segment) -> Correction:
    program = executive.program
    concurrent = partial(executive._concurrent, program, _index(executive, segment), set())
    return executive.placement._corrected(segment, concurrent, executive._alone, DOUBT)


def bent_beside(executive: Executive, segment: Segment, arms: Callable[[], object]) -> Correction:
    """Corrected beside arms that are made up."""
    placement = executive.placement
    return placement._corrected(segment, arms, executive._alone, DOUBT)  # type: ignore[arg-type]


NOTHING = np.zeros(3)


def test_what_sits_as_planned_is_placed_as_planned() -> None:
    executive, segment = before_placing(NOTHING, NOTHING)
    correction = corrected(executive, segment)
    assert correction.segment is segment and not correction.fault


@pytest.mark.parametrize("axis", np.eye(3))
def test_a_small_slip_is_made_up_for(axis: Array) -> None:
    shift, turn = 0.4e-3 * axis, np.deg2rad(0.6) * axis
    executive, segment = before_placing(shift, turn)
    bent = corrected(executive, segment).segment
    before, after = ends_at_goal(executive, segment, shift, turn), ends_at_goal(executive, bent, shift, turn)
    assert after[0] < 0.01 * before[0] and after[1] < 0.01 * before[1]
    np.testing.assert_array_equal(bent.path[0], segment.path[0])


def test_a_piece_that_has_turned_far_is_planned_anew() -> None:
    executive, segment = before_placing(NOTHING, np.deg2rad(np.array((0.0, 25.0, 0.0))))
    assert corrected(executive, segment).fault == "turned"


def test_not_while_the_other_hand_carries_too() -> None:
    """Recoveries know of one carried piece: with two, as much is corrected as the joints allow."""
    turn = np.deg2rad(np.array((0.0, 25.0, 0.0)))
    executive, segment = before_placing(NOTHING, turn)
    executive.state = executive.state.gripping(1 - segment.arm, executive.plan.order[-1])
    bent = corrected(executive, segment).segment
    assert (
        ends_at_goal(executive, bent, NOTHING, turn)[1] < ends_at_goal(executive, segment, NOTHING, turn)[1]
    )


@pytest.mark.parametrize("turned", (-6.0, 6.0))
def test_a_large_turn_is_made_up_for_as_exactly(turned: float) -> None:
    """Along the Jacobian alone the piece would end 0.4 mm off."""
    turn = np.deg2rad(np.array((0.0, turned, 0.0)))
    executive, segment = before_placing(NOTHING, turn)
    executive.state = executive.state.gripping(1 - segment.arm, executive.plan.order[-1])
    bent = corrected(executive, segment).segment
    off, left = ends_at_goal(executive, bent, NOTHING, turn)
    assert off < 5e-6 and left < 1e-4


def test_a_hand_that_closes_counts_as_carrying() -> None:
    executive, segment = before_placing(NOTHING, NOTHING)
    grasp = next(s for s in executive.program.segments if s.kind.name == "grasp" and s.arm != segment.arm)

    def interrupted() -> None:
        raise InterruptedError

    executive.executor.begin, executive.executor.tick = lambda segment: None, interrupted  # type: ignore[method-assign]
    with pytest.raises(InterruptedError):
        executive._run(replace(executive.program, segments=(grasp,), after=((),)))
    assert executive.state.gripped == {segment.arm: segment.piece, grasp.arm: grasp.piece}


def test_a_piece_that_is_seen_far_away_is_lost() -> None:
    executive, segment = before_placing(np.array((0.0, 0.0, 1.1 * planned()[0].sizes.gone)), NOTHING)
    assert corrected(executive, segment).fault == "lost"


def test_looks_that_err_are_averaged_and_logged_once() -> None:
    turn = np.deg2rad(np.array((0.0, 1.2, 0.0)))
    executive, segment = before_placing(NOTHING, turn, noise=(0.5, 0.5))
    bent = corrected(executive, segment).segment
    assert executive.perception.count == LOOKS
    assert ends_at_goal(executive, bent, NOTHING, turn)[1] < np.deg2rad(0.5)
    assert executive.executor.events == [("looked", "", f"{LOOKS} times")]  # type: ignore[attr-defined]


@pytest.mark.parametrize("most", (1.0, 0.6, 0.3, 0.1))
def test_no_correction_brings_the_arms_together(most: float) -> None:
    """Where the whole of it would, a share is made; what then stays decides whether to plan anew."""
    turn = np.deg2rad(np.array((0.0, 1.2, 0.0)))
    executive, segment = before_placing(NOTHING, turn)
    whole = corrected(executive, segment).segment
    change = whole.path[-1] - segment.path[-1]

    def gap(path: Array, enough: float) -> float:
        share = np.abs(path[-1] - segment.path[-1]).max() / np.abs(change).max()
        return enough if share <= most + 1e-9 else 0.5 * enough

    bent = bent_beside(executive, segment, lambda: SimpleNamespace(gap=gap)).segment
    made = np.abs(bent.path[-1] - segment.path[-1]).max() / np.abs(change).max()
    assert 0.99 * max(s for s in SHARES if s <= most) <= made <= most + 1e-9


def test_what_cannot_be_made_up_for_beside_the_other_arm_is_planned_anew() -> None:
    executive, segment = before_placing(NOTHING, np.deg2rad(np.array((0.0, 1.8, 0.0))))
    near = SimpleNamespace(gap=lambda path, enough: enough if path is segment.path else 0.0)
    assert bent_beside(executive, segment, lambda: near).fault == "turned"


@pytest.mark.parametrize(
    ("planned", "left", "made"),
    [
        (3.5e-3, 2.6e-3, True),
        (3.5e-3, 2.4e-3, False),
        (1e-3, 0.8e-3, True),
        (1e-3, 0.4e-3, False),
        (-1e-3, -1e-3, True),
    ],
)
def test_arms_that_were_planned_near_each_other_may_come_a_little_nearer(
    planned: float, left: float, made: bool
) -> None:
    """A slip of half a degree that stays for the sake of a tenth of a millimetre would bring down what is
    built on it."""
    executive, segment = before_placing(NOTHING, np.deg2rad(np.array((0.0, 0.6, 0.0))))
    near = SimpleNamespace(gap=lambda path, enough: planned if path is segment.path else left)
    bent = bent_beside(executive, segment, lambda: near).segment
    assert np.allclose(bent.path[-1], segment.path[-1]) != made
