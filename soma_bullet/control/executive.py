"""The executive loop: start what may start, look at what was measured, recover where that is possible, or
stop cleanly.

It knows what a real cell would: measured joints, the wrists' forces, the distances between the pads. Where
pieces are it asks only by an explicit sensing step, which is as inexact as the perception of the feed and is
logged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import count

import numpy as np

from soma_bullet.control.execute import Executor, Observation
from soma_bullet.control.onward import Onward
from soma_bullet.control.options import ExecutionOptions
from soma_bullet.control.perception import Perception
from soma_bullet.control.placement import Detour, Placement
from soma_bullet.control.recovery import Recovery, Trouble
from soma_bullet.errors import NoSolutionError
from soma_bullet.frames import readonly
from soma_bullet.grasp.clearance import OPENING
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.seeds import derived
from soma_bullet.task.actions.action import Identity
from soma_bullet.task.feed_options import FeedOptions
from soma_bullet.task.kinds import GRASP, PLACE, RETREAT, SETTLE, as_planned
from soma_bullet.task.limits import USUAL
from soma_bullet.task.program.make import replan
from soma_bullet.task.program.motions import joined
from soma_bullet.task.program.overlap.concurrent import Concurrent
from soma_bullet.task.program.overlap.loosen import overlapped
from soma_bullet.task.program.program import Program, beginning
from soma_bullet.task.search_options import SearchOptions
from soma_bullet.task.segment import LOOKING, SMALLEST_JUMP, Segment
from soma_bullet.task.workcell import Workcell

LARGEST_JUMP = 0.01  # [rad] a path that starts no farther from the measured joints is bent to meet them
RECOVERIES = 6  # in one episode
Progress = Callable[[str, float], None]


class _TooLong(Exception):
    """The episode has taken longer than it may."""


class Executive:
    """Executes one program.

    Args:
        workcell, plan, program: what is built where, by which plan; recoveries plan on from them.
        executor: of the world.
        feed: how exact perception is.
        options: how it is executed.
        ablate: `hold` opens every hand that should hold; nothing is recovered from then.
        search: how long a recovery is searched for.

    Attributes:
        state: of the cell as far as it is known: what has gone as planned has changed it.
    """

    def __init__(
        self,
        workcell: Workcell,
        plan: AssemblyPlan,
        program: Program,
        executor: Executor,
        feed: FeedOptions,
        options: ExecutionOptions,
        ablate: str = "",
        progress: Progress = lambda what, fraction: None,
        search: SearchOptions = USUAL,
    ):
        self.workcell, self.plan, self.program, self.executor = workcell, plan, program, executor
        self.ablate, self.together, self.progress = ablate, options.together, progress
        self.correct, self.longest = options.recover, options.longest
        self.recover = options.recover and not ablate
        self.state = beginning(workcell, program.feed, program.start)
        self.perception = Perception(
            executor.world, workcell.assembly, program.feed, feed, executor.seed, executor.note_event
        )
        self.placement = Placement(workcell, executor, self.perception, self.recover)
        self.recovery = Recovery(workcell, plan, executor, self.perception)
        self.onward, self.avoid = Onward(workcell, plan, search), set[Identity]()
        self.look = options.look if options.recover else "never"

    def run(self) -> str:
        """Returns `done`, or why it stopped."""
        program, again = self.program, 0
        while True:
            try:
                trouble = self._run(program)
            except _TooLong:
                return f"not done after {self.longest:g} s"
            fallen = self.recovery.fallen(self.state) if trouble is None and self.recover else []
            if trouble is None and not fallen:
                return "done"
            piece = trouble.piece if trouble else ", ".join(fallen)
            reason = trouble.reason if trouble else "fell"
            what = f"{piece} {reason}"
            self.executor.note_event("trouble", piece, reason)
            if not self.recover or again == RECOVERIES:
                return what
            again += 1
            try:
                program = self._onward(program, trouble, again)
            except NoSolutionError as error:
                self.executor.note_event("given up", piece, error.summary)
                return f"{what}; {error.summary}"

    def _onward(self, program: Program, trouble: Trouble | None, again: int) -> Program:
        """The program of what is left, from the state as it is found. Raises NoSolutionError."""
        if trouble is not None and trouble.seen is not None:
            step = trouble.segment.step
            failed = (a.insert.identity for a in program.schedule.assignments if a.step == step)
            self.avoid.update(failed)  # another try differs
        found, displaced = self.recovery.found(program, self.state, trouble)
        made = count()
        order = self.plan.order
        self.plan, program = self.onward.program(
            self.plan, found, displaced,
            lambda: derived(self.executor.seed, "recovery", again, next(made)),
            self.program.feed, self.avoid,
        )  # fmt: skip
        assert program.start is not None
        self.state, self.recovery.plan = program.start, self.plan
        program = overlapped(self.workcell, program) if self.together else program
        done = len(self.state.placed)
        text = f"from step {done + 1}"
        if self.plan.order != order:
            text += f", in another order: {' <- '.join(self.plan.order[done:])}"
        self.executor.note_event("planned anew", "", text)
        return program

    # --- running a program ---------------------------------------------------------------------------------

    def _run(self, program: Program) -> Trouble | None:
        """Run segments as soon as they may, until all are done or one goes wrong; then the others are let
        finish."""
        arms = range(len(self.workcell.cell.arms))
        waiting = {arm: [k for k, s in enumerate(program.segments) if s.arm == arm] for arm in arms}
        done: set[int] = set()
        running: dict[int, tuple[int, Detour]] = {}
        trouble: Trouble | None = None
        ended: list[tuple[Segment, Observation]] = []
        while True:
            for segment, seen in ended:
                k, detour = running.pop(segment.arm)
                try:
                    following = detour.send(seen)
                    running[segment.arm] = (k, detour)
                    self.executor.begin(following)
                except StopIteration as stop:
                    trouble = self._after(program, k, segment, stop.value) or trouble
                    done.add(k)
            for arm, queue in waiting.items():
                blocked = trouble is not None or arm in running
                if not queue or blocked or not done.issuperset(program.after[queue[0]]):
                    continue
                try:
                    ready = self._ready(program, queue[0])
                except NoSolutionError as error:
                    trouble = Trouble(queue[0], program.segments[queue[0]], None, error.summary)
                    continue
                if ready is not None:
                    trouble = self._begin(program, queue.pop(0), ready, running, done)
            if not running:
                return trouble
            ended = self.executor.tick()
            if self.executor.world.time > self.longest:
                raise _TooLong

    def _begin(
        self,
        program: Program,
        k: int,
        ready: Segment,
        running: dict[int, tuple[int, Detour]],
        done: set[int],
    ) -> Trouble | None:
        """Start a segment of an arm that is free."""
        arm = ready.arm
        name, share = self.workcell.cell.arms[arm].name, len(done) / len(program.segments)
        self.progress(f"{name}: {ready.kind} {ready.piece}", share)
        detour = self._detour(ready, partial(self._concurrent, program, k, done))
        try:
            following = next(detour)
        except StopIteration as stop:  # it does not even begin
            return self._after(program, k, ready, stop.value)
        if following.kind is GRASP:  # a hand that closes on a piece is about to carry it
            self.state = self.state.gripping(arm, following.piece)
        self.executor.begin(following)
        running[arm] = (k, detour)
        return None

    def _ready(self, program: Program, k: int) -> Segment | None:
        """A segment from where its arm is; None where that has to wait until no other arm moves."""
        segment, qs = program.segments[k], self.executor.world.measured_joints()
        if not segment.kind.moves:
            return segment
        jump = float(np.abs(qs[segment.arm] - segment.path[0]).max())
        if jump <= SMALLEST_JUMP:
            return segment
        # perhaps from a placing that was corrected by more
        if jump <= LARGEST_JUMP or segment.kind is RETREAT:
            return replace(segment, path=readonly(joined(segment.path, qs[segment.arm])))
        return None if self.executor.busy else replan(self.workcell, program, k, qs)

    def _concurrent(self, program: Program, k: int, done: set[int]) -> Concurrent:
        """The other arms while a segment runs that is about to."""
        return Concurrent(self.workcell, program, k, self.executor.world.measured_joints(), done)

    def _detour(self, segment: Segment, concurrent: Callable[[], Concurrent]) -> Detour:
        """What is run for a segment: itself, and around a placing what `Placement` makes of it."""
        if segment.kind is PLACE and self.correct:
            return (yield from self.placement.run(segment, concurrent, self._alone))
        if segment.kind is SETTLE and self.look != "never":
            segment = replace(segment, duration=segment.duration + LOOKING)
        return (yield segment)

    def _alone(self) -> bool:
        """Whether one hand alone carries a piece."""
        state = self.state
        return sum(body not in state.placed for body in state.gripped.values()) == 1

    def _after(self, program: Program, k: int, segment: Segment, seen: Observation) -> Trouble | None:
        """Keep account of what is where; what went wrong, if anything."""
        if seen.outcome == "turned":
            return Trouble(k, segment, seen, "turned in the hand")
        if seen.outcome in ("jammed", "lost") and not self.ablate:
            return Trouble(k, segment, seen, f"{seen.outcome} in {segment.kind}")
        self.state = as_planned(self.workcell, self.state, segment)
        if segment.kind is SETTLE and self.ablate == "hold":
            assignment = next(a for a in program.schedule.assignments if a.step == segment.step)
            if segment.piece in assignment.holds:
                self.executor.let_go(segment, assignment.insert.width + 2 * OPENING)
        if self.look == "each" or (self.look == "placed" and segment.kind is SETTLE):
            off = tuple(self.recovery.displaced(self.state))
            # what other hands hold up would fall if they let go for its sake
            held = set(self.state.held.values()) - set(off)
            if off and self.recover and not held:
                return Trouble(k, segment, None, "not where it should be", off)
        return None
