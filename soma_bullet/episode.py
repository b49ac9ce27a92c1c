"""The pipeline, wired: assembly -> plan -> schedule and program -> execution -> judgement -> report and
video.

An episode can be resumed at every arrow, from `plan.json`, `program.npz` or `log.npz`.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.bullet.simulator import BulletSimulator
from soma_bullet.bullet.stage import Physics
from soma_bullet.control.execute import Executor
from soma_bullet.control.executive import ExecutionOptions, Executive
from soma_bullet.control.guide import Compliance
from soma_bullet.errors import InputError, NoSolutionError
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.judge.judge import Tolerance, judge
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.qualities import PlannerOptions
from soma_bullet.planner.store import kept_plan
from soma_bullet.records import package_versions, read_json, read_npz, write_json, write_npz
from soma_bullet.report.report import EpisodeReport
from soma_bullet.robot.cell import find_hand, load_cell
from soma_bullet.robot.model import Cell
from soma_bullet.task.feed import Feed, FeedOptions, draw_feed, misplace
from soma_bullet.task.overlap import overlapped
from soma_bullet.task.program import make_program
from soma_bullet.task.schedule import Scheduler
from soma_bullet.task.segments import Program
from soma_bullet.task.workcell import Workcell
from soma_bullet.world.log import ExecutionLog

if TYPE_CHECKING:
    from soma_bullet.pictures.film import FilmOptions

Progress = Callable[[str, float], None]  # what is going on, and the fraction of the stage that is done
ORDERS = 12  # orders that are tried, best first, before the search for a schedule gives up
POOR, THOROUGH = (
    0.2,
    3.0,
)  # of the best score: before orders below, the better ones are searched again, so many times longer


@dataclass(frozen=True)
class EpisodeOptions:
    """Everything that decides an episode, beside the assembly.

    Attributes:
        cell: name or path.
        hand: a hand.toml, or the name of a cell whose hand replaces that of this cell; None for its own.
        seed: of everything random.
        planner: how orders are judged; its seed is the episode's.
        feed: how the pieces are fed.
        execution: how the program is executed.
        physics: how the world is simulated.
        tolerance: of the verdict.
        ablate: `hold` opens the assisting hand where it should hold.
        film: the video; None for none.
    """

    cell: str = "ur5e_pair"
    hand: str | None = None
    seed: int = 0
    planner: PlannerOptions = PlannerOptions()
    feed: FeedOptions = FeedOptions()
    execution: ExecutionOptions = ExecutionOptions()
    physics: Physics = Physics()
    tolerance: Tolerance = Tolerance()
    ablate: str = ""
    film: FilmOptions | None = None


@dataclass
class _Clock:
    """Wall time of each stage."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def run_episode(
    assembly: str | Path,
    options: EpisodeOptions | None = None,
    out: Path | None = None,
    resume: Path | None = None,
    plan_only: bool = False,
    progress: Progress = lambda what, fraction: None,
) -> EpisodeReport | None:
    """Run one episode, or the rest of one.

    Args:
        assembly: file or name.
        out: folder for `plan.json`, `program.npz`, `log.npz`, `report.json` and the video; None writes
            nothing.
        resume: one of those files (but the report) of an earlier run: what comes before it is taken from
            there.
        plan_only: stop after the plan, and return None.

    Raises:
        InputError: a file or an option is wrong.
        NoSolutionError: no plan, schedule or motion exists; says what blocked.
    """
    options = options or EpisodeOptions()
    if options.ablate not in ("", "hold"):
        raise InputError("--ablate", f"{options.ablate!r} is not known; `hold` is")
    _check_folder(out)
    clock = _Clock()
    with clock.stage("load"):
        progress("loading", 0.0)
        model, cell = load_assembly(assembly), _load_cell(options)
        plan, program, log = _resumed(resume, model, cell)
    if log is None:
        with clock.stage("plan"):
            progress("planning", 0.0)
            plan = plan or kept_plan(model, cell.hands, replace(options.planner, seed=options.seed))
        if plan_only:
            _write(out, "plan.json", plan)
            return None
        with clock.stage("motion"):
            progress("scheduling and planning motions", 0.0)
            workcell = Workcell(model, cell)
            if program is None:
                plan, program = _plan_and_program(model, workcell, plan, options, progress)
                if options.execution.together:
                    program = overlapped(workcell, program)
        _write(out, "plan.json", plan)
        _write(out, "program.npz", program)
        with clock.stage("execution"):
            log = execute(model, workcell, plan, program, options, progress)
        _write(out, "log.npz", log)
    with clock.stage("judgement"):
        verdict = judge(log, model, cell, options.tolerance)
    video = {"file": "", "renderer": "", "note": "no video was asked for"}
    if options.film is not None and out is not None:
        with clock.stage("video"):
            video = _render(log, model, cell, out, options.film, verdict.success, progress)
    report = EpisodeReport(
        success=verdict.success,
        pieces=verdict.pieces,
        assembly=model.name,
        digest=model.digest,
        cell=cell.name,
        order=log.order,
        stability=plan.options.stability if plan else "",
        seed=log.seed,
        ablation=options.ablate,
        tolerance=options.tolerance,
        judgement=verdict,
        feed_rejected={"overlap": program.feed.overlaps} if program else {},
        rejections=program.schedule.rejections if program else {},
        certificates=_certificates(program),
        makespan_s=verdict.makespan_s,
        planned_s=_planned(program),
        events=log.events,
        wall_s={name: round(seconds, 3) for name, seconds in clock.seconds.items()},
        video=video,
        versions=package_versions(),
    )
    _write(out, "report.json", report)
    return report


def _check_folder(out: Path | None) -> None:
    """Refuse a folder that cannot be written before any work is done."""
    if out is None:
        return
    there = next(path for path in (out.absolute(), *out.absolute().parents) if path.exists())
    if not there.is_dir():
        raise InputError("--out", f"{out} cannot be a folder: {there} is a file")
    if not os.access(there, os.W_OK):
        raise InputError("--out", f"{out} cannot be written: no permission in {there}")


def _certificates(program: Program | None) -> dict[str, float]:
    """Margin of every hold of the schedule, by piece."""
    assignments = program.schedule.assignments if program else ()
    return {a.piece: round(a.certificate.margin, 3) for a in assignments if a.certificate is not None}


def _planned(program: Program | None) -> dict[str, float]:
    """Planned makespans [s]: of the program, and of one arm at a time, where both were planned at its best
    and as scheduled."""
    if program is None:
        return {}
    if not np.isfinite(program.alone):
        return {"one at a time": round(program.makespan, 3)}
    times = {"together": program.makespan, "one at a time": program.alone, "as scheduled": program.in_turn}
    return {name: round(seconds, 3) for name, seconds in times.items()}


def _load_cell(options: EpisodeOptions) -> Cell:
    cell = load_cell(options.cell)
    if options.hand is not None:
        hand = find_hand(options.hand)
        cell = replace(cell, arms=tuple(replace(arm, hand=hand) for arm in cell.arms))
    force = options.physics.grip_force
    for arm in cell.arms:
        weakest, strongest = arm.hand.force_range
        if force is not None and not weakest <= force <= strongest:
            raise InputError(
                "--physics.grip-force",
                f"{force:g} N: {arm.hand.name} grips with {weakest:g} to {strongest:g} N",
            )
    return cell


def _resumed(
    resume: Path | None, assembly: Assembly, cell: Cell
) -> tuple[AssemblyPlan | None, Program | None, ExecutionLog | None]:
    """What an earlier run left: the file itself, and its neighbours that come before it."""
    if resume is None:
        return None, None, None
    kinds = {"plan.json": 0, "program.npz": 1, "log.npz": 2}
    if not resume.is_file():
        raise InputError("--from", f"no file {resume}")
    if resume.name not in kinds:
        raise InputError("--from", f"{resume.name} is none of {', '.join(kinds)}")
    level = kinds[resume.name]
    plan_file, program_file = (resume.parent / name for name in ("plan.json", "program.npz"))
    log = read_npz(ExecutionLog, resume) if level == 2 else None
    program = (
        read_npz(Program, program_file) if level == 1 or (level == 2 and program_file.is_file()) else None
    )
    if level == 1 and not plan_file.is_file():
        raise InputError(str(resume), f"its plan is missing: no file {plan_file}")
    plan = read_json(AssemblyPlan, plan_file) if plan_file.is_file() else None
    for found in (plan, program, log):
        if found is not None and found.digest != assembly.digest:
            raise InputError(
                str(resume),
                f"was made for another assembly: digest {found.digest[:12]}, {assembly.name} has "
                f"{assembly.digest[:12]}",
            )
    for made in (program, log):
        if made is not None and made.cell != cell.name:
            raise InputError(str(resume), f"was made for the cell {made.cell!r}, not {cell.name!r}")
    if plan is not None and (plan.hands, plan.hand_kinds) != (cell.hands.names, cell.hands.arms):
        theirs, ours = ", ".join(plan.hands), ", ".join(cell.hands.names)
        raise InputError(str(resume), f"was made for the hands {theirs}, not {ours}")
    if plan is not None and program is not None and plan.order != program.order:
        orders = " <- ".join(program.order), " <- ".join(plan.order)
        raise InputError(
            str(resume), f"was made for another plan than the one beside it: {orders[0]}, not {orders[1]}"
        )
    return plan, program, log


def _plan_and_program(
    assembly: Assembly, workcell: Workcell, plan: AssemblyPlan, options: EpisodeOptions, progress: Progress
) -> tuple[AssemblyPlan, Program]:
    """The best order that has a schedule: an order without one is ruled out, and the next best is tried."""
    orders, schedulers, reasons = set[tuple[str, ...]](), dict[tuple[str, ...], Scheduler](), Counter[str]()
    for candidate, effort in _candidates(assembly, workcell.cell.hands, plan):
        orders.add(candidate.order)
        try:
            if candidate.order not in schedulers:
                feed = draw_feed(assembly, candidate, workcell.cell, options.seed, options.feed)
                schedulers[candidate.order] = Scheduler(workcell, candidate, feed)
            scheduler = schedulers[candidate.order]
            scheduler.effort = effort
            say = lambda reason: progress(reason, 0.0)  # noqa: E731
            return candidate, make_program(
                workcell, candidate, scheduler.feed, options.seed, say, scheduler=scheduler
            )
        except NoSolutionError as error:
            reasons += error.reasons or Counter({error.summary: 1})
    raise NoSolutionError(
        "schedule", f"none of the {len(orders)} best orders of {assembly.name} has a schedule", reasons
    )


def _candidates(
    assembly: Assembly, hands: HandSet, plan: AssemblyPlan
) -> Iterator[tuple[AssemblyPlan, float]]:
    """Plans of different orders, best first, and the effort of their search: before far worse orders the
    better ones again."""
    best, better, excluded = plan.score, list[AssemblyPlan](), frozenset[tuple[str, ...]]()
    for _ in range(ORDERS):
        if plan.score < POOR * best:
            yield from ((earlier, THOROUGH) for earlier in better)
            better = []
        yield plan, 1.0
        if plan.score >= POOR * best:
            better.append(plan)
        excluded |= {plan.order}
        try:
            plan = kept_plan(assembly, hands, plan.options, excluded)
        except NoSolutionError:
            break
    yield from ((earlier, THOROUGH) for earlier in better)


def execute(
    assembly: Assembly,
    workcell: Workcell,
    plan: AssemblyPlan,
    program: Program,
    options: EpisodeOptions,
    progress: Progress,
) -> ExecutionLog:
    """The program in physics, and what the executive makes of it."""
    actual: Feed = misplace(assembly, program.feed, options.feed, options.seed)
    poses = {name: actual.pose(name) for name in actual.names}
    world = BulletSimulator(
        workcell.cell, assembly, program.stand, poses, np.array(workcell.robot.home), options.physics
    )
    try:
        executor = Executor(world, program, Compliance() if options.execution.compliant else None)
        executive = Executive(
            workcell, plan, program, executor, options.feed, options.execution, options.ablate, progress
        )
        ended = executive.run()
        executor.settle()
        return executor.log(ended)
    finally:
        world.close()


def _render(
    log: ExecutionLog,
    assembly: Assembly,
    cell: Cell,
    out: Path,
    options: FilmOptions,
    success: bool,
    progress: Progress,
) -> dict[str, str]:
    from soma_bullet.pictures.film import film, still  # the renderer is not needed by every episode

    closing = "every piece is in place" if success else "not in place"
    made = film(
        log, assembly, cell, out / "episode.mp4", options, closing=closing,
        progress=lambda fraction: progress("rendering", fraction),
    )  # fmt: skip
    still(log, assembly, cell, out / "still.png", options)
    return {"file": "episode.mp4", "renderer": made.renderer, "note": made.reason}


def _write(out: Path | None, name: str, value: object) -> None:
    if out is None or value is None:
        return
    (write_json if name.endswith(".json") else write_npz)(value, out / name)
