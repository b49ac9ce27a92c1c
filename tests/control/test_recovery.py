"""What goes wrong is found again, on a world without physics: pieces that drop, jam, or fall over, and hands
that are interrupted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from soma_bullet.control.execute import Observation
from soma_bullet.control.executive import RECOVERIES, Executive
from soma_bullet.control.options import Compliance, ExecutionOptions
from soma_bullet.control.placement import AGAIN
from soma_bullet.control.recovery import Trouble
from soma_bullet.errors import NoSolutionError
from soma_bullet.frames import Array, translate
from soma_bullet.task.limits import Effort
from soma_bullet.task.program.program import Program
from soma_bullet.task.search_options import SearchOptions
from soma_bullet.task.segment import Segment
from soma_bullet.task.state import CellState
from soma_bullet.world.log import ExecutionLog
from tests.control.episodes import judged, ran, world_of
from tests.control.fake import FakeSimulator
from tests.soma3 import handing_over, loosened, planned

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


# --- where recovering ends ----------------------------------------------------------------------------------


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
