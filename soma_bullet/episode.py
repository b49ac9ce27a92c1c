"""The pipeline, wired: assembly -> plan -> schedule and program -> execution -> judgement -> report and
video.

An episode can be resumed at every arrow, from `plan.json`, `program.npz` or `log.npz`.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.errors import InputError
from soma_bullet.options import EpisodeOptions
from soma_bullet.pictures.options import FilmOptions
from soma_bullet.pipeline import Progress, cell_of, executed, quiet
from soma_bullet.planner.analyzers import check_analyzers
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.store import kept_plan
from soma_bullet.records import package_versions, write_json, write_npz
from soma_bullet.report.report import EpisodeReport
from soma_bullet.resume import LOG, PLAN, PROGRAM, Earlier, load_earlier
from soma_bullet.robot.model import Cell
from soma_bullet.task.feed import draw_feed
from soma_bullet.task.program.orders import program_of_best_order
from soma_bullet.task.program.overlap.loosen import overlapped
from soma_bullet.task.program.program import Program
from soma_bullet.task.workcell import Workcell
from soma_bullet.verdict.judge import Judgement, judge
from soma_bullet.world.log import ExecutionLog


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
    progress: Progress = quiet,
) -> EpisodeReport | None:
    """Run one episode, or the rest of one.

    Args:
        assembly: file or name.
        out: folder for `plan.json`, `program.npz`, `log.npz`, `report.json` and the video; None writes
            nothing.
        resume: the plan, program or log of an earlier run, under any name: what comes before it is taken from
            the files beside it.
        plan_only: stop after the plan, and return None.

    Raises:
        InputError: a file or an option is wrong.
        NoSolutionError: no plan, schedule or motion exists; says what blocked.
    """
    options = options or EpisodeOptions()
    options.check()
    check_analyzers(options.planner)
    check_folder(out)
    clock = _Clock()
    with clock.stage("load"):
        progress("loading", 0.0)
        model, cell = load_assembly(assembly), cell_of(options)
        earlier = Earlier() if resume is None else load_earlier(resume, model, cell)
        plan, program, log = earlier.plan, earlier.program, earlier.log
    if log is None:
        with clock.stage("plan"):
            progress("planning", 0.0)
            planner = replace(options.planner.with_hands(len(cell.arms)), seed=options.seed)
            plan = plan or kept_plan(model, cell.hands, planner)
        if plan_only:
            _write(out, PLAN, plan)
            return None
        with clock.stage("motion"):
            progress("scheduling and planning motions", 0.0)
            workcell = Workcell(model, cell)
            if program is None:
                plan, program = program_of_best_order(
                    workcell,
                    plan,
                    lambda plan: draw_feed(model, plan, cell, options.seed, options.feed),
                    options.seed,
                    options.search,
                    lambda reason: progress(reason, 0.0),
                )
                if options.execution.together:
                    program = overlapped(workcell, program)
        _write(out, PLAN, plan)
        _write(out, PROGRAM, program)
        with clock.stage("execution"):
            log = executed(workcell, plan, program, options, progress)
        _write(out, LOG, log)
    with clock.stage("judgement"):
        verdict = judge(log, model, cell, options.tolerance)
    video = {"file": "", "renderer": "", "note": "no video was asked for"}
    if options.film is not None and out is not None:
        with clock.stage("video"):
            video = _render(log, model, cell, out, options.film, verdict.success, progress)
    report = _report(model, cell, plan, program, log, verdict, options, clock.seconds, video)
    _write(out, "report.json", report)
    return report


def _report(
    assembly: Assembly,
    cell: Cell,
    plan: AssemblyPlan | None,
    program: Program | None,
    log: ExecutionLog,
    verdict: Judgement,
    options: EpisodeOptions,
    seconds: Mapping[str, float],
    video: dict[str, str],
) -> EpisodeReport:
    """All that is told of an episode; what is not known of one that went on from its log is left empty."""
    return EpisodeReport(
        success=verdict.success,
        pieces=verdict.pieces,
        assembly=assembly.name,
        digest=assembly.digest,
        cell=cell.name,
        order=log.order,
        stability=plan.options.stability if plan else "",
        seed=log.seed,
        ablation=options.ablation,
        tolerance=options.tolerance,
        judgement=verdict,
        feed_rejected={"overlap": program.feed.overlaps} if program else {},
        rejections=program.schedule.rejections if program else {},
        certificates=_certificates(program),
        makespan_s=verdict.makespan_s,
        planned_s=_planned(program),
        events=log.events,
        notes=_notes(program, log, options),
        wall_s={name: round(wall, 3) for name, wall in seconds.items()},
        video=video,
        versions=package_versions(),
    )


def _notes(program: Program | None, log: ExecutionLog, options: EpisodeOptions) -> tuple[str, ...]:
    """What the seed decided of an episode whose program was made with another."""
    if program is None or program.seed == log.seed:
        return ()
    errors = "where pieces really lie and by how much looks err, and " if any(options.feed.noise) else ""
    return (
        f"the program was made with seed {program.seed}: feed, schedule and motions are its; seed {log.seed} "
        f"decided {errors}how recoveries move",
    )


def check_folder(out: Path | None) -> None:
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
    inserts = [a.insert for a in program.schedule.assignments] if program else []
    return {i.piece: round(i.certificate.margin, 3) for i in inserts if i.certificate is not None}


def _planned(program: Program | None) -> dict[str, float]:
    """Planned makespans [s]: of the program, and of one arm at a time, where both were planned at its best
    and as scheduled."""
    if program is None:
        return {}
    if program.alone is None or program.in_turn is None:
        return {"one at a time": round(program.makespan, 3)}
    times = {"together": program.makespan, "one at a time": program.alone, "as scheduled": program.in_turn}
    return {name: round(seconds, 3) for name, seconds in times.items()}


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
