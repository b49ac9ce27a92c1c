"""The planner's verdicts on stability beside those of others: contact physics, and compas-cra's rigid blocks.

Every state is drawn, judged and simulated from (seed, draw) alone, so that a table does not depend on the
number of workers and any single state can be examined again."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from soma_bullet.bullet.standing import stands
from soma_bullet.planner.equilibrium import TIE, classify
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.qualities import Qualities
from soma_bullet.records import write_json
from soma_bullet.robot.cell import load_cell
from soma_bullet.robot.model import Cell
from soma_bullet.validation.rigid_blocks import (
    ALIKE,
    FITS,
    HOLDS,
    RigidBlocks,
    require_compas_cra,
    signed_margin,
    weakest_direction,
)
from soma_bullet.validation.subassemblies import Placement, assembly_of, random_placements

CELL = "ur5e_pair"  # its stand carries the pieces, and its hand is what paper mode is told
CLEARANCES = (0.0, 1e-4)  # [m] of every piece
QUOTA_CLEARANCE = CLEARANCES[-1]
LARGEST_SHARE = 0.6  # of the states may fall, and as many may stand, at that clearance
BAND = 0.01  # [g] within which two models of the same blocks may differ
# [mean weights of a piece] at a contact in compas-cra: more is more than its tolerance, so the blocks fall
PULL = 1e-4


@dataclass(frozen=True)
class Trial:
    """A state at one clearance.

    Attributes:
        clearance_mm: of every piece [mm].
        verdict, margin, margin_sides: see StateStability.
        paper: smallest s of a placed piece; stable where it is positive.
        fell, moved_mm, turned_deg: what physics says, and how far pieces went at most.
    """

    clearance_mm: float
    verdict: str
    margin: float
    margin_sides: float
    paper: float
    fell: bool
    moved_mm: float
    turned_deg: float


@dataclass(frozen=True)
class Blocks:
    """A state with full friction on its sides.

    Attributes:
        margin: signed [g], see `signed_margin`.
        pull: what compas-cra needs, in mean weights of a piece, with friction such that its cones, as ours,
            have the circle's radius on average; the blocks stand below PULL.
        pull_as_is: the same with its own cones, which hold up to 8 % more than the circle.
        angle_deg: the weakest direction.
        pull_below, pull_above: what compas-cra needs under an acceleration in that direction of BAND less,
            and BAND more, than the margin. None, as the angle, where the margin does not exceed BAND.
    """

    margin: float
    pull: float
    pull_as_is: float
    angle_deg: float | None
    pull_below: float | None
    pull_above: float | None

    @property
    def stand(self) -> bool:
        """The verdict of compas-cra, its cones as wide as ours."""
        return self.pull < PULL

    @property
    def stand_as_is(self) -> bool:
        """The verdict of compas-cra with its own cones."""
        return self.pull_as_is < PULL


@dataclass(frozen=True)
class State:
    """One state and all that is said about it.

    Attributes:
        draw: with the seed it gives the placements.
        tie: with sides that do not rub it is within a hair (TIE) of the edge between standing and falling:
            the least change of a length or a weight decides. The planner calls such a state unstable.
    """

    draw: int
    placements: tuple[Placement, ...]
    tie: bool
    trials: tuple[Trial, ...]
    blocks: Blocks


@dataclass(frozen=True)
class Comparison:
    """All states of one seed; `drawn` counts those too that were left out because enough of their kind were
    there."""

    seed: int
    drawn: int
    states: tuple[State, ...]


def compare(count: int, seed: int, jobs: int, out: Path, done: Callable[[], None]) -> Comparison:
    """Examine `count` states, and write them to `out`/states.json.

    States are taken in the order of their draws; one that falls is left out once 60 % of the states do, and
    so is one that stands.

    Args:
        done: is told whenever a state has been examined.

    Raises:
        InputError: compas-cra is not installed.
    """
    require_compas_cra()
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        chosen: list[int] = []
        room = {True: int(LARGEST_SHARE * count), False: int(LARGEST_SHARE * count)}
        drawn = 0
        while len(chosen) < count:
            wanted = range(drawn, drawn + count - len(chosen))
            for draw, fell in pool.imap(_fall, [(seed, k) for k in wanted]):
                drawn = draw + 1
                if room[fell]:
                    room[fell] -= 1
                    chosen.append(draw)
        states = []
        for state in pool.imap(_examine, [(seed, draw) for draw in chosen]):
            states.append(state)
            done()
    comparison = Comparison(seed, drawn, tuple(states))
    write_json(comparison, out / "states.json")
    return comparison


def examine(seed: int, draw: int) -> State:
    """Everything about one draw."""
    placements = random_placements(seed, draw)
    everything = frozenset(range(len(placements)))
    trials = tuple(_trial(placements, clearance) for clearance in CLEARANCES)
    assembly = assembly_of(placements, QUOTA_CLEARANCE)
    tie = abs(signed_margin(assembly, everything, "frictionless")) <= TIE
    return State(draw, placements, tie, trials, _blocks(placements))


def _trial(placements: tuple[Placement, ...], clearance: float) -> Trial:
    assembly = assembly_of(placements, clearance)
    everything = frozenset(range(len(placements)))
    state = classify(assembly, everything)
    qualities = Qualities(assembly, _cell().hands, PlannerOptions(stability="paper"))
    paper = min(qualities.paper_stability(piece, everything) for piece in everything)
    standing = stands(assembly, everything, _cell())
    return Trial(
        clearance * 1e3, state.verdict, state.margin, state.margin_sides, paper,
        standing.fell, round(max(standing.moved_mm), 3), round(max(standing.turned_deg), 3),
    )  # fmt: skip


def _blocks(placements: tuple[Placement, ...]) -> Blocks:
    assembly = assembly_of(placements, 0.0)
    everything = frozenset(range(len(placements)))
    margin = signed_margin(assembly, everything, "friction")
    judge = RigidBlocks(assembly)
    if margin <= BAND:
        return Blocks(margin, judge.pull(friction=ALIKE), judge.pull(), None, None, None)
    angle = weakest_direction(assembly, everything, "friction", margin)
    # its cones have eight sides and ours twelve: below the margin they may hold no less than ours, above it
    # no more
    below, above = judge.pull(margin - BAND, angle, HOLDS), judge.pull(margin + BAND, angle, FITS)
    return Blocks(margin, judge.pull(friction=ALIKE), judge.pull(), float(np.rad2deg(angle)), below, above)


@cache
def _cell() -> Cell:
    return load_cell(CELL)


def _fall(task: tuple[int, int]) -> tuple[int, bool]:
    seed, draw = task
    placements = random_placements(seed, draw)
    return draw, stands(assembly_of(placements, QUOTA_CLEARANCE), range(len(placements)), _cell()).fell


def _examine(task: tuple[int, int]) -> State:
    return examine(*task)


# --- what it comes to ---------------------------------------------------------------------------------------


def table(comparison: Comparison) -> str:
    """The comparison as Markdown: verdicts against physics, against compas-cra, and what is asked of both."""
    states = comparison.states
    sizes = sorted(len(state.placements) for state in states)
    lines = [
        f"{len(states)} states of {sizes[0]} to {sizes[-1]} pieces from {comparison.drawn} draws of seed "
        f"{comparison.seed}",
        "",
        "| planner says | "
        + " | ".join(f"c = {t.clearance_mm:g} mm: stand | fall" for t in states[0].trials)
        + " |",
        "|-|" + "-|" * 2 * len(states[0].trials),
    ]
    for name, kind in KINDS.items():
        cells = [
            str(len(_trials(states, k, kind, fell))) for k in range(len(CLEARANCES)) for fell in (False, True)
        ]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    cells = [
        str(len(_trials(states, k, lambda s, t: True, fell)))
        for k in range(len(CLEARANCES))
        for fell in (False, True)
    ]
    lines += ["| all | " + " | ".join(cells) + " |", ""]
    lines += [
        "| margin with full side friction [g] | compas-cra, cones alike: stand | fall | its own cones: "
        "stand | fall |"
    ]
    lines += ["|-|-|-|-|-|"]
    for name, band in ((f"above {BAND:g}", 1), (f"within {BAND:g}", 0), (f"below -{BAND:g}", -1)):
        inside = [s.blocks for s in states if _band(s.blocks.margin) == band]
        counts = [sum(b.stand for b in inside), sum(b.stand_as_is for b in inside)]
        lines.append(f"| {name} | " + " | ".join(f"{n} | {len(inside) - n}" for n in counts) + " |")
    lines += ["", "| asked | measured | |", "|-|-|-|"]
    lines += [
        f"| {c.asked} | {c.measured} | {'holds' if c.holds else 'does not hold'} |"
        for c in criteria(comparison)
    ]
    return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class Criterion:
    """Something asked of the comparison, and what was measured."""

    asked: str
    measured: str
    holds: bool


def criteria(comparison: Comparison) -> list[Criterion]:
    """Whether the planner's verdicts are right, clearance by clearance, and its statics those of
    compas-cra."""
    states = comparison.states
    found = []
    for k, clearance in enumerate(CLEARANCES):
        at = f"c = {clearance * 1e3:g} mm: "
        fallen = sum(s.trials[k].fell for s in states)
        found.append(_share(at + "states that fall", fallen, len(states), 0.4, 0.6))
        robust = [s for s in states if s.trials[k].verdict == "robust"]
        unstable = [s for s in states if s.trials[k].verdict == "unstable" and not s.tie]
        leaning = [s for s in states if s.trials[k].verdict == "clearance-dependent"]
        found.append(
            _share(
                at + "robust states that fall", sum(s.trials[k].fell for s in robust), len(robust), 0.0, 0.0
            )
        )
        standing = sum(not s.trials[k].fell for s in unstable)
        found.append(
            _share(at + "unstable states beyond a tie that stand", standing, len(unstable), 0.0, 0.05)
        )
        found.append(_share(at + "clearance-dependent states", len(leaning), len(states), 0.0, 0.15))
    blocks = [s.blocks for s in states]
    clear = [b for b in blocks if _band(b.margin)]
    wrong = sum(b.stand != (b.margin > 0) for b in clear)
    found.append(_share(f"compas-cra, cones alike, disagrees beyond {BAND:g} g", wrong, len(clear), 0.0, 0.0))
    found.append(
        _share(f"states with a margin within {BAND:g} g", len(blocks) - len(clear), len(blocks), 0.0, 0.05)
    )
    pushed = [b for b in blocks if b.pull_below is not None and b.pull_above is not None]
    early = sum((b.pull_below or 0.0) >= PULL for b in pushed)
    late = sum((b.pull_above or 0.0) < PULL for b in pushed)
    found.append(_share(f"compas-cra falls {BAND:g} g before the margin", early, len(pushed), 0.0, 0.0))
    found.append(_share(f"compas-cra stands {BAND:g} g past the margin", late, len(pushed), 0.0, 0.0))
    return found


def _share(what: str, count: int, of: int, least: float, most: float) -> Criterion:
    share = count / max(of, 1)
    asked = "none" if most == 0 else f"at most {most:.0%}" if least == 0 else f"{least:.0%} to {most:.0%}"
    return Criterion(f"{what}: {asked}", f"{count} of {of} ({share:.1%})", least <= share <= most)


def _band(margin: float) -> int:
    """1 for blocks that clearly stand, -1 for blocks that clearly fall, else 0."""
    return 1 if margin > BAND else -1 if margin < -BAND else 0


Kind = Callable[[State, Trial], bool]
KINDS: dict[str, Kind] = {
    "robust": lambda state, trial: trial.verdict == "robust",
    "clearance-dependent": lambda state, trial: trial.verdict == "clearance-dependent",
    "unstable, beyond a tie": lambda state, trial: trial.verdict == "unstable" and not state.tie,
    "exact ties": lambda state, trial: trial.verdict == "unstable" and state.tie,
    "paper mode: stable": lambda state, trial: trial.paper > 0,
    "paper mode: unstable": lambda state, trial: trial.paper <= 0,
}


def _trials(states: tuple[State, ...], k: int, kind: Kind, fell: bool) -> list[Trial]:
    return [s.trials[k] for s in states if kind(s, s.trials[k]) and s.trials[k].fell == fell]


def disagreements(comparison: Comparison) -> Iterator[str]:
    """One line for each state about which the planner and another judge differ; exact ties are nobody's
    error."""
    for state in comparison.states:
        blocks = state.blocks
        for trial in state.trials:
            if not state.tie and trial.fell == (trial.verdict != "unstable"):
                yield (
                    f"draw {state.draw}, c = {trial.clearance_mm:g} mm: {trial.verdict}, margin "
                    f"{trial.margin:.4f} g, "
                    f"{'falls' if trial.fell else 'stands'}: {trial.moved_mm:.2f} mm, "
                    f"{trial.turned_deg:.1f} deg; "
                    f"margin {blocks.margin:.4f} g with full side friction"
                )
        rubbing = (
            f"draw {state.draw}: margin {blocks.margin:.4f} g with full side friction, compas-cra needs a "
            f"pull of"
        )
        if _band(blocks.margin) and {blocks.stand, blocks.stand_as_is} != {blocks.margin > 0}:
            yield f"{rubbing} {blocks.pull:.2g} with cones alike, {blocks.pull_as_is:.2g} with its own"
        if blocks.pull_below is None or blocks.pull_above is None:
            continue
        if blocks.pull_below >= PULL or blocks.pull_above < PULL:
            yield f"{rubbing} {blocks.pull_below:.2g} below that and {blocks.pull_above:.2g} above"
