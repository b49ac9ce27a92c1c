"""The three-block task in the two-arm cell, planned once for all tests of a process."""

from __future__ import annotations

from functools import cache

from soma_bullet.assembly.file import load_assembly
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.store import kept_plan
from soma_bullet.robot.cell import load_cell
from soma_bullet.task.program.make import make_program
from soma_bullet.task.program.overlap.loosen import overlapped
from soma_bullet.task.program.program import Program
from soma_bullet.task.workcell import Workcell
from tests.feeds import APART, CROWDED, laid


@cache
def planned() -> tuple[Workcell, AssemblyPlan, Program]:
    """One arm at a time; the pieces lie so that each is picked and goes straight in."""
    whole, cell = load_assembly("soma3"), load_cell("ur5e_pair")
    plan = kept_plan(whole, cell.hands, PlannerOptions())
    workcell = Workcell(whole, cell)
    return workcell, plan, make_program(workcell, plan, laid(workcell, plan, APART), 0)


@cache
def loosened() -> Program:
    """Both arms at once."""
    workcell, _, program = planned()
    return overlapped(workcell, program)


@cache
def handing_over() -> Program:
    """Both arms at once; a piece is handed over."""
    workcell, plan, _ = planned()
    return overlapped(workcell, make_program(workcell, plan, laid(workcell, plan, CROWDED), 0))
