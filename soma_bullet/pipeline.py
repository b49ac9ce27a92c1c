"""The two arrows between a plan and a log: a program of the plan, and its execution in physics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from soma_bullet.assembly.model import Assembly
from soma_bullet.bullet.simulator import BulletSimulator
from soma_bullet.control.execute import Executor
from soma_bullet.control.executive import Executive
from soma_bullet.errors import InputError
from soma_bullet.options import EpisodeOptions
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.robot.cell import find_hand, load_cell
from soma_bullet.robot.model import Cell
from soma_bullet.task.feed import Feed, draw_feed, misplace
from soma_bullet.task.limits import Effort
from soma_bullet.task.program import make as programs
from soma_bullet.task.program.overlap.loosen import overlapped
from soma_bullet.task.program.program import Program
from soma_bullet.task.search.scheduler import Scheduler
from soma_bullet.task.workcell import Workcell
from soma_bullet.world.log import ExecutionLog

Progress = Callable[[str, float], None]  # what is going on, and the fraction of the stage that is done


def quiet(what: str, fraction: float) -> None:
    """Progress of which nobody is told."""


def make_program(
    assembly: Assembly,
    cell: Cell,
    plan: AssemblyPlan,
    options: EpisodeOptions | None = None,
    progress: Progress = quiet,
) -> Program:
    """Find out which arm picks, regrasps, inserts, holds and releases what, with every motion timed.

    The pieces are laid out in the feed areas of the cell by the seed; a depth-first search over the steps of
    the plan picks arms and grasps; every motion is checked for collisions and timed within the limits of the
    joints; at last the arms are made to move at the same time where that is safe.

    Args:
        cell: with the hand for which the plan was made.
        plan: its order is kept. Where it has no schedule, `make_plan` with `excluded={plan.order}` gives the
            next best one.
        options: `seed`, `feed`, `search` and `execution.together` count here; by default seed 0, anywhere in
            the feed areas.
        progress: told what is going on, and the fraction that is done, in 0..1.

    Returns:
        Segments with joints (n, joints of the arm) [rad] every 1/480 s, in an order in which they can be
        executed one at a time, and for each those that must have ended before it starts.

    Raises:
        InputError: an option is out of its range, or the plan is of another assembly or hand.
        NoSolutionError: no schedule, or no motion; says what blocked, most frequent first.
    """
    options = options or EpisodeOptions()
    options.check()
    check_fit("plan", assembly, cell, plan)
    workcell = Workcell(assembly, cell)
    feed = draw_feed(assembly, plan, cell, options.seed, options.feed)
    program = programs.make_program(
        workcell,
        plan,
        feed,
        options.seed,
        lambda reason: progress(reason, 0.0),
        scheduler=Scheduler(workcell, plan, feed, effort=Effort.of(options.search)),
    )
    return overlapped(workcell, program) if options.execution.together else program


def execute(
    assembly: Assembly,
    cell: Cell,
    plan: AssemblyPlan,
    program: Program,
    options: EpisodeOptions | None = None,
    progress: Progress = quiet,
) -> ExecutionLog:
    """Run a program in contact physics, and recover from what does not go as planned.

    The executive knows what it would in a real cell: joints, wrist forces, finger widths, and sensing steps
    that are logged.

    Args:
        plan: that of the program; recoveries plan on from it.
        options: `seed`, `feed` (how exact perception is), `search` (of recoveries), `execution`, `physics`
            and `ablate` count here.
        progress: told what is going on, and the fraction that is done, in 0..1.

    Returns:
        Every 10 ms: joints (m, j) [rad], poses of the n pieces (m, n, 7) [m, quat_xyzw], forces and contacts;
        and what the executive noticed and decided. Whether the assembly stands is for `judge` to say.

    Raises:
        InputError: an option is out of its range, or plan or program are of another assembly or cell.
    """
    options = options or EpisodeOptions()
    options.check()
    check_grip(cell, options)
    check_fit("program", assembly, cell, plan, program)
    return executed(Workcell(assembly, cell), plan, program, options, progress)


def executed(
    workcell: Workcell,
    plan: AssemblyPlan,
    program: Program,
    options: EpisodeOptions,
    progress: Progress = quiet,
) -> ExecutionLog:
    """As `execute`, of what has been checked."""
    actual: Feed = misplace(workcell.assembly, program.feed, options.feed, options.seed)
    poses = {name: actual.pose(name) for name in actual.names}
    home, physics = workcell.robot.home, options.physics
    world = BulletSimulator(workcell.cell, workcell.assembly, program.stand, poses, home, physics)
    execution, ablation = options.execution, options.ablation
    compliance = execution.compliance if execution.compliant else None
    try:
        executor = Executor(world, program, workcell.sizes, compliance, physics.record_every, options.seed)
        executive = Executive(
            workcell, plan, program, executor, options.feed, execution, ablation, progress, options.search
        )
        ended = executive.run()
        executor.settle()
        return executor.log(ended)
    finally:
        world.close()


def cell_of(options: EpisodeOptions) -> Cell:
    """The cell of an episode, with the hands that it is to have. Raises InputError."""
    cell = load_cell(options.cell)
    if options.hand is not None:
        hand = find_hand(options.hand)
        cell = replace(cell, arms=tuple(replace(arm, hand=hand) for arm in cell.arms))
    check_grip(cell, options)
    hands = options.planner.hands
    if hands is not None and hands > len(cell.arms):
        raise InputError("--hands", f"{hands}: {cell.name} has {len(cell.arms)} arms")
    return cell


def check_grip(cell: Cell, options: EpisodeOptions) -> None:
    """Refuse a force with which a hand of the cell cannot grip."""
    force = options.physics.grip_force
    for arm in cell.arms:
        weakest, strongest = arm.hand.force_range
        if force is not None and not weakest <= force <= strongest:
            raise InputError(
                "--physics.grip-force",
                f"{force:g} N: {arm.hand.name} grips with {weakest:g} to {strongest:g} N",
            )


def check_fit(
    source: str,
    assembly: Assembly,
    cell: Cell,
    plan: AssemblyPlan | None = None,
    program: Program | None = None,
    log: ExecutionLog | None = None,
) -> None:
    """Refuse what was made for another assembly, cell, hand or plan; `source` is what the message begins
    with."""
    for found in (plan, program, log):
        if found is not None and found.digest != assembly.digest:
            raise InputError(
                source,
                f"was made for another assembly: digest {found.digest[:12]}, {assembly.name} has "
                f"{assembly.digest[:12]}",
            )
    for made in (program, log):
        if made is not None and made.cell != cell.name:
            raise InputError(source, f"was made for the cell {made.cell!r}, not {cell.name!r}")
    hands = plan.options.hand_count if plan is not None else 0
    if hands > len(cell.arms):
        raise InputError(source, f"was made for {hands} hands; {cell.name} has {len(cell.arms)} arms")
    ours = cell.hands
    if plan is not None and (plan.hands, plan.hand_kinds) != (ours.names, ours.arms):
        theirs = ", ".join(plan.hands)
        raise InputError(source, f"was made for the hands {theirs}, not {', '.join(ours.names)}")
    if plan is not None and program is not None and plan.order != program.order:
        orders = " <- ".join(program.order), " <- ".join(plan.order)
        raise InputError(
            source, f"was made for another plan than the one beside it: {orders[0]}, not {orders[1]}"
        )
