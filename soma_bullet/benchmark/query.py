"""One motion around obstacles, and what it took."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

AROUND = ("transit", "transfer", "home")  # motions that go around obstacles
PARTS = ("inverse kinematics", "line traced", "plan and shortcuts", "blend", "timing", "checked again")


@dataclass(frozen=True, eq=False)
class Query:
    """One motion around obstacles of a program.

    Attributes:
        name: assembly, seed, and what the segment is.
        seed: of the planner.
        context: where pieces and hands are; segment: the motion that the program has for it.
        line: travel of the hand (3,) [m] of the line that follows with the same arm; None where none does.
        widths: of the hand, at each of which the way must be free [m].
    """

    name: str
    seed: int
    context: Any
    segment: Any
    line: Any
    widths: Any


@dataclass
class Timed:
    """What one query took: CPU and wall time [s], CPU time by part, and whether it was solved."""

    name: str
    kind: str
    solved: bool
    cpu: float
    wall: float
    parts: dict[str, float]
    birrt_solved: bool | None = None
    birrt_cpu: float = 0.0
    birrt_wall: float = 0.0
    birrt_note: str = ""
