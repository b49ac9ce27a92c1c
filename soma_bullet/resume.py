"""What an earlier run left, to go on from: a plan, a program or a log, told apart by what is in the file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from soma_bullet.assembly.model import Assembly
from soma_bullet.errors import InputError
from soma_bullet.pipeline import check_fit
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.records import kind_in, read_any, read_json, read_npz
from soma_bullet.robot.model import Cell
from soma_bullet.task.program.program import Program
from soma_bullet.world.log import ExecutionLog

PLAN, PROGRAM, LOG = "plan.json", "program.npz", "log.npz"  # as an episode calls its files
STAGES = {AssemblyPlan: "plan", Program: "program", ExecutionLog: "log"}


@dataclass(frozen=True)
class Earlier:
    """What there is of an earlier run; None for what there is not."""

    plan: AssemblyPlan | None = None
    program: Program | None = None
    log: ExecutionLog | None = None


def stage_of(file: Path) -> str:
    """Which stage an earlier run came to by a file that it left: `plan`, `program` or `log`. Raises
    InputError."""
    return STAGES[kind_in(tuple(STAGES), file)]


def load_earlier(file: Path, assembly: Assembly, cell: Cell) -> Earlier:
    """A plan, a program or a log, whatever its file is called, and what lies beside it and comes before it,
    under the name that an episode gives it.

    Raises:
        InputError: it is none of them, it was made for something else, or a program's plan is missing.
    """
    if not file.is_file():
        raise InputError("--from", f"no file {file}")
    found = read_any(tuple(STAGES), file)
    plan_file, program_file = file.parent / PLAN, file.parent / PROGRAM
    if isinstance(found, AssemblyPlan):
        earlier = Earlier(found)
    elif isinstance(found, Program):
        if not plan_file.is_file():
            raise InputError(str(file), f"its plan is missing: no file {plan_file}")
        earlier = Earlier(read_json(AssemblyPlan, plan_file), found)
    else:
        plan = read_json(AssemblyPlan, plan_file) if plan_file.is_file() else None
        program = read_npz(Program, program_file) if program_file.is_file() else None
        earlier = Earlier(plan, program, found)
    check_fit(str(file), assembly, cell, earlier.plan, earlier.program, earlier.log)
    return earlier
