"""The analyzers: what judges a state of the assembly, or the insertion of one piece, each behind one
function.

An analyzer of your own is a function with one of the two signatures, in a module beside you or in any other
that can be imported; it is named as `module:function`. It sees the same `Qualities` as those of the planner
and may build on them.

    from soma_bullet.planner.analyzers import Judgement

    def reach(qualities, placed, piece):  # a step: how well `piece` goes into the placed set
        height = qualities.assembly.goal_centres[piece][2]
        if height < 0.4:
            return Judgement(1.0)
        return Judgement(0.0, f"its goal is {height:.2f} m up, the arm reaches 0.40 m")

A quality of 0 rules the step or the state out, and its reason is reported; every other enters the score by
its minimum over the order (paper Sec. IV-G)."""

from __future__ import annotations

import importlib
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from soma_bullet.errors import InputError
from soma_bullet.planner.options import PAPER, PlannerOptions

if TYPE_CHECKING:
    from soma_bullet.planner.qualities import Placed, Qualities

CARRIES = 0.1  # upward part of a unit contact normal into the piece that is carried


@dataclass(frozen=True)
class Judgement:
    """What an analyzer says.

    Attributes:
        quality: 0 is impossible; larger is better.
        reason: why it is 0, with numbers.
        verdict: of a state: `unstable` where its quality is 0; any other word is up to the analyzer.
    """

    quality: float
    reason: str = ""
    verdict: str = ""

    @property
    def stands(self) -> bool:
        """Whether the state, or the step, is possible."""
        return self.quality > 0.0


StepAnalyzer = Callable[
    ["Qualities", "Placed", int], Judgement
]  # qualities, placed set without the piece, piece
StateAnalyzer = Callable[["Qualities", "Placed", "Placed"], Judgement]  # qualities, placed set, held pieces


def equilibrium(qualities: Qualities, placed: Placed, held: Placed) -> Judgement:
    """Stability of the whole placed set at once: soma_bullet.planner.equilibrium."""
    state = qualities.stability(placed, held)
    reason = "" if state.verdict != "unstable" else _resists(state.margin, state.margin_sides)
    return Judgement(state.quality, reason, state.verdict)


def _resists(margin: float, sides: float) -> str:
    return f"resists {margin:.3f} g without and {sides:.3f} g with side contacts"


def graspability(qualities: Qualities, placed: Placed, piece: int) -> Judgement:
    """G: the number of grasps whose hand, way in and way out are clear of the placed set and the support
    (paper Sec. IV-C)."""
    count = qualities.graspability(piece, placed)
    if count:
        return Judgement(float(count))
    return Judgement(0.0, f"has no candidate grasp: {qualities.why_no_grasp(piece, placed)}")


def assemblability(qualities: Qualities, placed: Placed, piece: int) -> Judgement:
    """A: how freely the piece goes in along its best straight way (paper Sec. IV-E)."""
    way = qualities.assemblability(piece, placed)
    if way.direction is not None:
        return Judgement(way.quality)
    by = " and ".join("the support" if k < 0 else qualities.assembly.names[k] for k in way.blockers)
    return Judgement(0.0, f"has no straight way in ({way.type}, blocked by {by})")


def grounded(qualities: Qualities, placed: Placed, piece: int) -> Judgement:
    """Rules out that a piece is put into the air, with nothing below it, and held there until something is
    slid under it.

    Not part of the paper's score; ask for it by name.
    """
    if any(contact.normal[2] > CARRIES for contact in qualities.assembly.contacts_of(piece, placed)):
        return Judgement(1.0)
    return Judgement(0.0, "would hang in the air: nothing that is placed carries it")


STEPS: dict[str, StepAnalyzer] = {
    "graspability": graspability,
    "assemblability": assemblability,
}  # of every plan
FURTHER: dict[str, StepAnalyzer] = {"grounded": grounded}
STATES: dict[str, StateAnalyzer] = {"equilibrium": equilibrium}


def state_analyzer(name: str) -> StateAnalyzer:
    """The stability analyzer of that name; paper mode's holds are judged by equilibrium. Raises
    InputError."""
    return _found(name, STATES | {PAPER: equilibrium}, "stability")


def step_analyzer(name: str) -> StepAnalyzer:
    """The analyzer of steps of that name. Raises InputError."""
    return _found(name, STEPS | FURTHER, "analyzer")


def check_analyzers(options: PlannerOptions) -> None:
    """Raises InputError where one that is asked for is not there."""
    state_analyzer(options.stability)
    for name in options.analyzers:
        step_analyzer(name)


def _found(name: str, known: dict[str, Any], option: str) -> Any:
    if name in known:
        return known[name]
    module, _, function = name.partition(":")
    if not function:
        raise InputError(
            f"--{option}",
            f"{name!r} is not known; there are {', '.join(known)}, and your own as module:function",
        )
    if not module or not function:
        raise InputError(f"--{option}", f"{name!r}: must be module:function")
    here = str(Path.cwd())
    sys.path.append(here)  # a module beside the user; last, so that it hides no other
    try:
        found = getattr(importlib.import_module(module), function)
    except ImportError as error:
        raise InputError(f"--{option}", f"{name!r}: module {module!r} cannot be imported: {error}") from error
    except AttributeError:
        raise InputError(f"--{option}", f"{name!r}: module {module!r} has no {function!r}") from None
    except Exception as error:  # whatever the module does when it is imported
        raise InputError(f"--{option}", f"{name!r}: module {module!r} cannot be imported: {error}") from error
    finally:
        sys.path.remove(here)
    if not callable(found):
        raise InputError(f"--{option}", f"{name!r} is no function")
    return partial(_judged, f"--{option} {name}", found)


def _judged(name: str, analyse: Callable[..., Any], qualities: Qualities, *state: Any) -> Judgement:
    """What an analyzer of the user's own says, if it says something. Raises InputError."""
    try:
        found = analyse(qualities, *state)
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        what = f"raised {type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"
        raise InputError(name, what) from error
    if not isinstance(found, Judgement):
        raise InputError(name, f"returned {found!r}; it must return a Judgement")
    if not found.quality >= 0.0:
        raise InputError(name, f"returned a quality of {found.quality}; it must be a number from 0 on")
    return found if found.reason or found.stands else replace(found, reason=f"{name} says 0")
