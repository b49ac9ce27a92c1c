"""Times of the motions around obstacles of real programs, against targets and against another planner."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from importlib import metadata, util

import numpy as np

from soma_bullet.assembly.file import load_assembly
from soma_bullet.benchmark.motion_table import motion_table
from soma_bullet.benchmark.options import Motion
from soma_bullet.benchmark.query import PARTS, Query, Timed
from soma_bullet.benchmark.stopwatch import hooked
from soma_bullet.bullet.birrt import BirrtWorld
from soma_bullet.errors import InputError, NoSolutionError
from soma_bullet.motion.line import LineError, line_back
from soma_bullet.motion.timing import TimingError
from soma_bullet.motion.transfer import TransferError
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.store import kept_plan
from soma_bullet.records import package_versions
from soma_bullet.robot.cell import load_cell
from soma_bullet.seeds import derived
from soma_bullet.task.feed import draw_feed
from soma_bullet.task.feed_options import FeedOptions
from soma_bullet.task.program import motions
from soma_bullet.task.program.make import make_program
from soma_bullet.task.program.motions import scene_for, widths_along
from soma_bullet.task.program.program import moments
from soma_bullet.task.workcell import Workcell


def motion(arguments: Motion, say: Callable[[str], object]) -> None:
    """Prints times against targets, and writes the figures of every query."""

    if arguments.birrt and util.find_spec("pybullet_planning") is None:
        advice = "pip install 'soma_bullet[benchmark]' installs it, --no-birrt does without"
        raise InputError("--birrt", f"the package pybullet-planning is not installed: {advice}")
    cell = load_cell(arguments.cell)
    figures: list[Timed] = []
    for name in arguments.assemblies:
        workcell = Workcell(load_assembly(name), cell)
        for seed in range(arguments.seeds):
            queries = queries_of(name, workcell, seed, arguments.feed)
            say(f"{name}, seed {seed}: {len(queries)} motions")
            if not figures and queries:
                _time_chain(workcell, queries[0])  # imports, and tables that are built once
            timed = [_time_chain(workcell, query) for query in queries]
            if arguments.birrt and queries:
                with BirrtWorld(workcell, arguments.resolution) as world:
                    for query, row in zip(queries, timed, strict=True):
                        width = float(query.widths.max())
                        answer = world.solve(query.context, query.segment, width, query.seed)
                        row.birrt_solved, row.birrt_note = answer.solved, answer.note
                        row.birrt_cpu, row.birrt_wall = answer.cpu, answer.wall
            figures += timed
    if not figures:
        raise InputError("arguments", "no program was found for any of the feeds")
    versions = package_versions() | (
        {"pybullet-planning": metadata.version("pybullet-planning")} if arguments.birrt else {}
    )
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    tree = {"queries": [asdict(row) for row in figures], "versions": versions}
    arguments.out.write_text(json.dumps(tree, indent=1) + "\n", encoding="utf-8")
    sys.stdout.write(motion_table(figures))


def queries_of(name: str, workcell: Workcell, seed: int, options: FeedOptions) -> list[Query]:
    """The motions around obstacles of one program; none where there is no program."""

    cell = workcell.cell
    plan = kept_plan(workcell.assembly, cell.hands, PlannerOptions(seed=seed))
    try:
        feed = draw_feed(workcell.assembly, plan, cell, seed, options)
        program = make_program(workcell, plan, feed, seed)
    except NoSolutionError as error:
        sys.stderr.write(f"{name}, seed {seed}: {error.summary}\n")
        return []
    rows, queries = list(moments(workcell, program)), []
    for k, (context, segment, _) in enumerate(rows):
        if not segment.kind.around:
            continue
        following = next((later for _, later, _ in rows[k + 1 :] if later.arm == segment.arm), None)
        line = following.offset if following is not None and following.kind.way == "line" else None
        widths = widths_along(context, segment)
        label = f"{name}, seed {seed}: {segment.kind} {segment.piece} {cell.arms[segment.arm].name}"
        queries.append(Query(label, derived(seed, "motion", k + 1), context, segment, line, widths))
    return queries


def _time_chain(workcell: Workcell, query: Query) -> Timed:
    """From the pose of the hand at the goal to the timed motion, checked again; the scene is there
    already."""

    robot, segment, context = workcell.robot, query.segment, query.context
    arm, start, goal = segment.arm, context.qs[segment.arm], segment.path[-1]
    scene = scene_for(workcell, context, segment)
    width = float(query.widths.max())
    free = lambda q: scene.collides(workcell.configuration(context, arm, q, width))  # noqa: E731
    scene.collides(
        workcell.configuration(context, arm, start, width)
    )  # the broad phase is built with the scene
    seconds: dict[str, float] = dict.fromkeys(PARTS, 0.0)
    hooks = {
        "plan_transfer": "plan and shortcuts",
        "blend_corners": "blend",
        "time_path": "timing",
        "check": "checked again",
    }
    wall, cpu = time.perf_counter(), time.process_time()
    pose = robot.tcp(arm, goal)
    robot.inverse(arm, pose, start)
    seconds["inverse kinematics"] = time.process_time() - cpu
    if query.line is not None:
        length = float(np.linalg.norm(query.line))
        mark = time.process_time()
        # at a goal that a line starts from, what it touches at its far end is not of this scene: free all the
        # way or not
        with suppress(LineError):
            line_back(robot, arm, goal, pose, query.line / length, length, free)
        seconds["line traced"] = time.process_time() - mark
    with hooked(motions, hooks, seconds):
        try:
            found = motions.plan_motion(workcell, scene, context, arm, start, goal, query.widths, query.seed)
        except (TransferError, TimingError):
            found = None
    return Timed(
        query.name,
        segment.kind.name,
        found is not None,
        time.process_time() - cpu,
        time.perf_counter() - wall,
        seconds,
    )
