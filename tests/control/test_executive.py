"""The executive in physics: what is not where it was seen is found again, and an end without recovery says
why."""

from __future__ import annotations

import numpy as np
import pytest

from soma_bullet.bullet.simulator import BulletSimulator
from soma_bullet.control.execute import Executor, Observation
from soma_bullet.control.executive import Executive
from soma_bullet.control.options import Compliance, ExecutionOptions
from soma_bullet.control.recovery import Trouble
from soma_bullet.task.feed_options import FeedOptions
from soma_bullet.task.program.make import make_program
from soma_bullet.task.program.overlap.loosen import overlapped
from soma_bullet.task.program.program import Program
from soma_bullet.task.segment import Segment
from soma_bullet.verdict.judge import judge
from soma_bullet.verdict.options import Tolerance
from soma_bullet.world.log import ExecutionLog
from soma_bullet.world.options import Physics
from tests.feeds import APART, CROWDED, Lies, laid
from tests.soma3 import loosened, planned

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("executive")]


def executed(moved: str, by: tuple[float, float], options: ExecutionOptions) -> ExecutionLog:
    """An episode in which one piece lies elsewhere [m] than it was seen."""
    program = loosened()
    poses = {name: np.array(program.feed.pose(name)) for name in program.feed.names}
    poses[moved][:2, 3] += by
    return ran(program, poses, options, Executive)


def ran(
    program: Program, poses: dict[str, np.ndarray], options: ExecutionOptions, kind: type[Executive]
) -> ExecutionLog:
    """An episode with the pieces at T_world_piece (4, 4)."""
    workcell, plan, _ = planned()
    world = BulletSimulator(
        workcell.cell, workcell.assembly, program.stand, poses, workcell.robot.home, Physics()
    )
    try:
        executor = Executor(world, program, workcell.sizes, Compliance())
        ended = kind(workcell, plan, program, executor, FeedOptions(), options).run()
        executor.settle()
        return executor.log(ended)
    finally:
        world.close()


@pytest.mark.parametrize(("moved", "by"), [("BigL", (0.03, 0.03)), ("Z", (0.0, 0.05))])
def test_a_piece_that_is_not_there_is_looked_for(moved: str, by: tuple[float, float]) -> None:
    log = executed(moved, by, ExecutionOptions())
    workcell, _, _ = planned()
    verdict = judge(log, workcell.assembly, workcell.cell, Tolerance())
    assert verdict.success, verdict.causes
    assert [event.kind for event in log.events][:3] == ["trouble", "looked", "planned anew"]
    assert log.events[0].piece == moved and "lost in grasp" in log.events[0].text
    grasps = [s.outcome for s in log.segments if (s.kind, s.piece) == ("grasp", moved)]
    assert grasps[0] == "lost" and grasps[-1] == "as planned"


class _Interrupted(Executive):
    """Counts it as trouble once that two hands have something: two pieces, or one amid a hand-over."""

    pieces = 2
    interrupted = False

    def _after(self, program: Program, k: int, segment: Segment, seen: Observation) -> Trouble | None:
        trouble = super()._after(program, k, segment, seen)
        state = self.state
        carried = {arm: body for arm, body in state.gripped.items() if body not in state.placed}
        if (
            self.interrupted
            or segment.kind.name != "grasp"
            or len(carried) < 2
            or len(set(carried.values())) != self.pieces
        ):
            return trouble
        self.interrupted = True
        return Trouble(k, segment, seen, "interrupted")


class _InterruptedHandOver(_Interrupted):
    pieces = 1


@pytest.mark.parametrize(
    ("pieces", "kind"), [(APART, _Interrupted), (CROWDED, _InterruptedHandOver)], ids=["two", "one"]
)
def test_goes_on_where_both_hands_have_something(pieces: dict[str, Lies], kind: type[_Interrupted]) -> None:
    workcell, plan, _ = planned()
    program = overlapped(workcell, make_program(workcell, plan, laid(workcell, plan, pieces), 0))
    log = ran(
        program, {name: program.feed.pose(name) for name in program.feed.names}, ExecutionOptions(), kind
    )
    verdict = judge(log, workcell.assembly, workcell.cell, Tolerance())
    assert verdict.success, verdict.causes
    assert [event.kind for event in log.events][:3] == ["trouble", "looked", "planned anew"]
    assert "interrupted" in log.events[0].text


def test_without_recovery_it_ends_and_says_why() -> None:
    log = executed("BigL", (0.03, 0.03), ExecutionOptions(recover=False))
    assert log.ended == "BigL lost in grasp"
    workcell, _, _ = planned()
    verdict = judge(log, workcell.assembly, workcell.cell, Tolerance())
    assert not verdict.success and verdict.causes[0] == "BigL lost in grasp"
    assert log.segments[-1].kind == "final"


def test_arms_take_turns_or_not() -> None:
    """While one arm inserts, the other fetches; their segments overlap in time."""
    program = loosened()
    log = executed("Z", (0.0, 0.0), ExecutionOptions())
    assert log.ended == "done" and not [event for event in log.events if event.kind == "trouble"]
    spans = {arm: [(s.start, s.end) for s in log.segments if s.arm == arm] for arm in log.arm_names}
    shared = sum(max(0.0, min(b, d) - max(a, c)) for a, b in spans["left"] for c, d in spans["right"])
    assert shared > 3.0
    moving = [s for s in log.segments if s.kind != "final"]
    assert max(s.end for s in moving) == pytest.approx(program.makespan, abs=2.0)
