"""The three-block task in the two-arm cell, planned once for all tests: every piece in its preferred resting
pose."""

from __future__ import annotations

from functools import cache

from soma_bullet.assembly.file import load_assembly
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.store import kept_plan
from soma_bullet.robot.cell import load_cell
from soma_bullet.task.feed import draw_feed
from soma_bullet.task.feed_options import FeedOptions
from soma_bullet.task.program.make import make_program
from soma_bullet.task.program.program import Program
from soma_bullet.task.workcell import Workcell


@cache
def planned() -> tuple[Workcell, AssemblyPlan, Program]:
    """One arm at a time."""
    whole, cell = load_assembly("soma3"), load_cell("ur5e_pair")
    plan = kept_plan(whole, cell.hands, PlannerOptions())
    workcell = Workcell(whole, cell)
    feed = draw_feed(whole, plan, cell, 0, FeedOptions(poses="preferred"))
    return workcell, plan, make_program(workcell, plan, feed, 0)
