"""Dual-arm assembly: plan from meshes and goal poses, build with two arms in contact physics, judge by final
poses.

    import soma_bullet as sb

    assembly, cell = sb.load_assembly("soma3"), sb.load_cell("ur5e_pair")
    plan = sb.make_plan(assembly, cell.hands)
    program = sb.make_program(assembly, cell, plan)
    log = sb.execute(assembly, cell, plan, program)
    verdict = sb.judge(log, assembly, cell)

`run_episode` does all of it in one call. What is named here is what the package offers; it is imported when
it is first asked for.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from soma_bullet.assembly.file import load_assembly
    from soma_bullet.assembly.model import Assembly
    from soma_bullet.control.options import ExecutionOptions
    from soma_bullet.episode import run_episode
    from soma_bullet.errors import InputError, NoSolutionError, SomaBulletError
    from soma_bullet.figure.options import FigureOptions
    from soma_bullet.figure.plan_figure import FigurePlan, plan_figure
    from soma_bullet.grasp.hand import Hand
    from soma_bullet.options import EpisodeOptions
    from soma_bullet.pictures.options import FilmOptions
    from soma_bullet.pipeline import execute, make_program
    from soma_bullet.planner.assembly_plan import AssemblyPlan
    from soma_bullet.planner.options import HoldLoad, PlannerOptions
    from soma_bullet.planner.plan import make_plan
    from soma_bullet.report.report import EpisodeReport
    from soma_bullet.robot.cell import find_hand as load_hand
    from soma_bullet.robot.cell import load_cell
    from soma_bullet.robot.model import Cell
    from soma_bullet.task.feed_options import FeedOptions
    from soma_bullet.task.program.program import Program
    from soma_bullet.task.search_options import SearchOptions
    from soma_bullet.verdict.judge import Judgement, judge
    from soma_bullet.verdict.options import Tolerance
    from soma_bullet.world.log import ExecutionLog
    from soma_bullet.world.options import Physics

__all__ = [
    "Assembly",
    "AssemblyPlan",
    "Cell",
    "EpisodeOptions",
    "EpisodeReport",
    "ExecutionLog",
    "ExecutionOptions",
    "FeedOptions",
    "FigureOptions",
    "FigurePlan",
    "FilmOptions",
    "Hand",
    "HoldLoad",
    "InputError",
    "Judgement",
    "NoSolutionError",
    "Physics",
    "PlannerOptions",
    "Program",
    "SearchOptions",
    "SomaBulletError",
    "Tolerance",
    "execute",
    "judge",
    "load_assembly",
    "load_cell",
    "load_hand",
    "make_plan",
    "make_program",
    "plan_figure",
    "run_episode",
]

# module, and what it is called there where that is another name
_PLACES = {
    "Assembly": "assembly.model",
    "AssemblyPlan": "planner.assembly_plan",
    "Cell": "robot.model",
    "EpisodeOptions": "options",
    "EpisodeReport": "report.report",
    "ExecutionLog": "world.log",
    "ExecutionOptions": "control.options",
    "FeedOptions": "task.feed_options",
    "FigureOptions": "figure.options",
    "FigurePlan": "figure.plan_figure",
    "FilmOptions": "pictures.options",
    "Hand": "grasp.hand",
    "HoldLoad": "planner.options",
    "InputError": "errors",
    "Judgement": "verdict.judge",
    "NoSolutionError": "errors",
    "Physics": "world.options",
    "PlannerOptions": "planner.options",
    "Program": "task.program.program",
    "SearchOptions": "task.search_options",
    "SomaBulletError": "errors",
    "Tolerance": "verdict.options",
    "execute": "pipeline",
    "judge": "verdict.judge",
    "load_assembly": "assembly.file",
    "load_cell": "robot.cell",
    "load_hand": "robot.cell:find_hand",
    "make_plan": "planner.plan",
    "make_program": "pipeline",
    "plan_figure": "figure.plan_figure",
    "run_episode": "episode",
}


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}")
    module, _, there = _PLACES[name].partition(":")
    value = getattr(import_module(f"{__name__}.{module}"), there or name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return list(__all__)
