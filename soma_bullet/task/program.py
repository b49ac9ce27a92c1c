"""The program of a plan: from the beginning, from a state as found, or a segment of it anew.

`replan` makes a segment anew from measured joints, when the cell is not where the program expected it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import islice

import numpy as np

from soma_bullet.errors import NoSolutionError
from soma_bullet.frames import Array, readonly
from soma_bullet.motion.line import LineError
from soma_bullet.motion.timing import TimingError
from soma_bullet.motion.transfer import TransferError
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.task.assignments import Start
from soma_bullet.task.builder import MotionError, ProgramBuilder, guarded, scene_of, widths_along
from soma_bullet.task.feed import Feed
from soma_bullet.task.motions import plan_motion, straight_motion
from soma_bullet.task.schedule import Scheduler
from soma_bullet.task.segments import SPEEDS, Program, Segment, contexts, one_at_a_time
from soma_bullet.task.workcell import Workcell


def make_program(
    workcell: Workcell,
    plan: AssemblyPlan,
    feed: Feed,
    seed: int,
    progress: Callable[[str], None] | None = None,
    start: Start | None = None,
    scheduler: Scheduler | None = None,
) -> Program:
    """Schedule and trajectories of a plan, from the beginning or from a state as found.

    A motion that cannot be found rules out exactly its step, arm and grasp, or this way to regrasp, and the
    search of the schedule goes on.

    Args:
        scheduler: of the same plan, feed and start, which has searched before: what it knows is not found
            again.

    Raises:
        NoSolutionError: with what blocked, most frequent first.
    """
    scheduler = scheduler or Scheduler(workcell, plan, feed, start)
    while True:
        schedule = scheduler.find()
        try:
            made = tuple(ProgramBuilder(workcell, feed, schedule, seed, start, plan.order).run())
        except MotionError as error:
            if error.assignment is None:
                raise NoSolutionError("motion", error.reason, scheduler.rejections) from None
            scheduler.rule_out(error.assignment, error.regrasp)
            scheduler.rejections[error.reason] += 1
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
    start: Start,
    seed: int,
    noise: tuple[float, float] = (0.0, 0.0),
    square: bool = True,
) -> Program:
    """The rest of a plan from a state as found: arms and pieces wherever they are, perhaps one of them in a
    hand.

    Args:
        noise, square: of the poses as found, as in `Feed`.

    Raises:
        NoSolutionError: with what blocked, most frequent first.
    """
    names = workcell.assembly.names
    found = Feed(names, readonly(np.array([start.poses[name] for name in names])), 0, 0, seed, noise, square)
    return make_program(workcell, plan, found, seed, start=start)


def replan(workcell: Workcell, program: Program, index: int, qs: Array) -> Segment:
    """One motion segment of the program made anew from measured joints qs (arms, 6): a line as a line, else
    to the same end.

    Raises:
        NoSolutionError: it cannot be made from there.
    """
    context, segment, _ = next(islice(contexts(workcell, program), index, None))
    context = replace(context, hands=replace(context.hands, qs=np.array(qs)))
    scene, start = scene_of(workcell, context, segment.arm), qs[segment.arm]
    try:
        if segment.kind in SPEEDS:
            path = straight_motion(
                workcell, scene, context.hands, segment.arm, start, segment.offset, segment.kind
            )
        else:
            widths = widths_along(context, segment)
            goal, seed = segment.path[-1], program.seed + index
            path = plan_motion(workcell, scene, context.hands, segment.arm, start, goal, widths, seed)
    except (LineError, TransferError, TimingError) as error:
        reason = f"{segment.piece}: {segment.kind} cannot be made from the measured joints: {error}"
        raise NoSolutionError("motion", reason) from None
    return guarded(workcell, replace(segment, path=readonly(path)), context)
