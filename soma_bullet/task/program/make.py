"""The program of a plan: from the beginning, from a state as found, or a segment of it anew.

`replan` makes a segment anew from measured joints, when the cell is not where the program expected it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from soma_bullet.errors import NoSolutionError
from soma_bullet.frames import Array, readonly
from soma_bullet.motion.line import LineError
from soma_bullet.motion.timing import TimingError
from soma_bullet.motion.transfer import TransferError
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.seeds import derived
from soma_bullet.task.actions.action import Identity
from soma_bullet.task.feed import Feed
from soma_bullet.task.limits import Effort
from soma_bullet.task.program.builder import Made, MotionError, ProgramBuilder, guarded
from soma_bullet.task.program.motions import plan_motion, scene_for, straight_motion, widths_along
from soma_bullet.task.program.program import Program, moments, one_at_a_time
from soma_bullet.task.refusal import Refusal
from soma_bullet.task.search.scheduler import Scheduler
from soma_bullet.task.segment import Segment
from soma_bullet.task.state import CellState
from soma_bullet.task.workcell import Workcell


def make_program(
    workcell: Workcell,
    plan: AssemblyPlan,
    feed: Feed,
    seed: int,
    progress: Callable[[str], None] | None = None,
    start: CellState | None = None,
    scheduler: Scheduler | None = None,
) -> Program:
    """Schedule and trajectories of a plan, from the beginning or from a state as found.

    A motion that cannot be found rules out exactly its step, arm and grasp, or this way to bring the piece,
    and the search of the schedule goes on.

    Args:
        scheduler: of the same plan, feed and start, which has searched before: what it knows is not found
            again.

    Raises:
        NoSolutionError: with what decided, and what blocked, most frequent first.
    """
    scheduler = scheduler or Scheduler(workcell, plan, feed, start)
    earlier: Sequence[Made] = ()
    while True:
        schedule = scheduler.find()
        builder = ProgramBuilder(workcell, feed, schedule, seed, start, earlier, scheduler.effort)
        try:
            made = tuple(builder.run())
        except MotionError as error:
            earlier = builder.made
            if error.assignment is None or error.action is None:
                raise scheduler.refusals.error("motion", error.reason) from None
            scheduler.rule_out(error.assignment, error.action)
            piece, _, cause = error.reason.partition(": ")
            scheduler.refusals.at(error.assignment.step)
            scheduler.refusals.add(Refusal(piece, "", cause))
            if progress is not None:
                progress(error.reason)
            continue
        return Program(
            workcell.cell.name,
            workcell.assembly.name,
            workcell.assembly.digest,
            seed,
            plan.order,
            feed,
            schedule,
            tuple(segment for _, segment, _ in made),
            one_at_a_time(len(made)),
            workcell.T_world_assembly,
            workcell.robot.stand_size,
            start,
        )


def recover_program(
    workcell: Workcell,
    plan: AssemblyPlan,
    start: CellState,
    seed: int,
    noise: tuple[float, float] = (0.0, 0.0),
    square: bool = True,
    effort: Effort | None = None,
    avoid: Collection[Identity] = (),
    cleared: Collection[str] = (),
) -> Program:
    """The rest of a plan from a state as found: arms and pieces wherever they are, perhaps some in hands.

    Args:
        noise, square: of the poses as found, as in `Feed`.
        effort: how long it may be searched for, and what has been spent of that.
        avoid: insertions that are ruled out.
        cleared: pieces that are laid down elsewhere before the first step, since they are in the way.

    Raises:
        NoSolutionError: with what decided, and what blocked, most frequent first.
    """
    names = workcell.assembly.names
    poses = readonly(np.array([start.poses[name] for name in names]))
    found = Feed(names, poses, 0, 0, seed, noise, square)
    steps = {step.piece: k for k, step in enumerate(plan.steps)}
    moved = tuple(steps[name] for name in cleared)
    scheduler = Scheduler(workcell, plan, found, start, effort or Effort(), cleared=moved)
    scheduler.excluded.steps |= {(steps[str(identity[1])], identity, ()) for identity in avoid}
    return make_program(workcell, plan, found, seed, start=start, scheduler=scheduler)


def replan(workcell: Workcell, program: Program, index: int, qs: Sequence[Array]) -> Segment:
    """One motion segment of the program made anew from measured joints qs, (n,) of each arm: a line as a
    line, else to the same end.

    Raises:
        NoSolutionError: it cannot be made from there.
    """
    before, segment, _ = next(islice(moments(workcell, program), index, None))
    before = replace(before, qs=tuple(readonly(q) for q in qs))
    scene, start = scene_for(workcell, before, segment), before.qs[segment.arm]
    try:
        if segment.kind.way == "line":
            path = straight_motion(workcell, scene, before, segment.arm, start, segment.offset, segment.kind)
        else:
            widths = widths_along(before, segment)
            goal, seed = segment.path[-1], derived(program.seed, "again", index)
            path = plan_motion(workcell, scene, before, segment.arm, start, goal, widths, seed)
    except (LineError, TransferError, TimingError) as error:
        reason = f"{segment.piece}: {segment.kind} cannot be made from the measured joints: {error}"
        raise NoSolutionError("motion", reason) from None
    return guarded(workcell, replace(segment, path=readonly(path)), before, segment.guard)
