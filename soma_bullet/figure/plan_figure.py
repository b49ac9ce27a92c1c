"""From a drawing to a plan: packings, sides, and the one that is planned best."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from soma_bullet.assembly.model import Assembly
from soma_bullet.errors import InputError
from soma_bullet.figure.choice import Chooser, NoFigurePlanError, Progress, SideSurvey
from soma_bullet.figure.drawing import Drawing, read_drawing
from soma_bullet.figure.model import packed, write_assembly
from soma_bullet.figure.options import FigureOptions
from soma_bullet.figure.packing import (
    NoPackingError,
    Packing,
    Packings,
    check_count,
    find_packings,
    layers_text,
    supply_of,
    turned_packing,
    used,
)
from soma_bullet.figure.sides import AS_DRAWN, NowhereStandsError, sides_of
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.planner.analyzers import check_analyzers
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.options import PlannerOptions


@dataclass(frozen=True, eq=False)
class FigurePlan:
    """A figure with the packing and the side by which it is built, and its plan.

    Attributes:
        name: of the figure.
        side: which side of the drawing is down; `as-drawn` is none but its own.
        packing: letter and cells of every piece, so turned, sorted.
        assembly: the packing as an assembly.
        plan: of that assembly.
        hands: for which it was made.
        packings: of the figure as drawn.
        surveys: what became of the packings of each side that was looked at.
    """

    name: str
    side: str
    packing: Packing
    assembly: Assembly
    plan: AssemblyPlan
    hands: HandSet
    packings: Packings
    surveys: tuple[SideSurvey, ...] = field(default_factory=tuple)

    @property
    def layers(self) -> str:
        """The packing as letters, layer by layer from the bottom up."""
        return layers_text(self.packing)

    def write(self, folder: Path) -> Path:
        """Write the assembly file and the meshes; returns the path of the file."""
        turned = "" if self.side == AS_DRAWN else f", turned: {self.side} is down"
        return write_assembly(self.name, self.packing, f"The figure {self.name}{turned}.", folder)


def plan_figure(
    drawing: str | Path | Drawing,
    hands: HandSet,
    options: FigureOptions | None = None,
    planner: PlannerOptions | None = None,
    progress: Progress = lambda what, fraction: None,
    refused: frozenset[Packing] = frozenset(),
) -> FigurePlan:
    """Find a packing of a drawn figure by Soma pieces that can be built, the side to build it on, and its
    plan.

    The search for packings is complete within `options.nodes`; packings that a rotation about the vertical
    maps onto each other count once. Packings are looked at in the order of their promise, as drawn first.

    Args:
        drawing: a file, as text or JSON (docs/figure.md); FILE:NAME for one figure of several.
        hands: those of the arms.
        planner: how orders are judged.
        progress: told what is going on.
        refused: packings that a later stage found impossible.

    Raises:
        InputError: the drawing, its number of cells or an option is wrong.
        NoSolutionError: NoPackingError, NowhereStandsError, or NoFigurePlanError with the reasons.
    """
    options, planner = options or FigureOptions(), (planner or PlannerOptions()).with_hands()
    options.check()
    planner.check()
    check_analyzers(planner)
    supply = supply_of(options.pieces)
    figure = drawing if isinstance(drawing, Drawing) else read_drawing(drawing, options.name)
    progress(f"looking for packings of {figure.name}", 0.0)
    packings = _packings(figure, supply, options)
    standings = sides_of(figure.cells, options.side, figure.packing)
    falls = {standing.side: standing.falls for standing in standings}
    if all(falls.values()):
        raise NowhereStandsError(figure.name, falls)
    chooser = Chooser(figure.name, hands, options, planner, progress, refused)
    upright = [standing for standing in standings if not standing.falls]
    for standing in standings:
        if standing.falls:
            chooser.pass_over(standing)
        elif not chooser.satisfied and chooser.looks > 0 and chooser.tries:
            if standing.side == AS_DRAWN:
                found = packings.found
            elif figure.packing is not None or options.packings is not None:
                found = tuple(turned_packing(packing, standing.turn) for packing in packings.found)
            else:
                found = find_packings(standing.cells, supply, options.nodes).found
            chooser.look_at(standing, found, standing is not upright[-1])
    chooser.look_at_the_rest()
    best, surveys = chooser.best(), chooser.surveys
    if best is None:
        raise NoFigurePlanError(figure.name, surveys, chooser.reasons)
    assembly = packed(figure.name, best.packing)
    return FigurePlan(figure.name, best.side, best.packing, assembly, best.plan, hands, packings, surveys)


def _packings(figure: Drawing, supply: dict[str, int], options: FigureOptions) -> Packings:
    """Packings of a figure as drawn, or the one that is drawn. Raises InputError, NoPackingError."""
    if figure.packing is not None:
        letters = used(figure.packing)
        missing = [letter for letter in letters if letter not in supply]
        if missing:
            raise InputError(figure.name, f"has the piece {', '.join(missing)}; --pieces {options.pieces}")
        return Packings(1, (figure.packing,), 1, True, 0)
    check_count(figure.name, figure.cells, supply)
    found = find_packings(figure.cells, supply, options.nodes, options.packings)
    if found.found:
        return found
    if found.complete:
        raise NoPackingError(
            f"no packing of {figure.name}: the pieces {options.pieces} do not fill its {len(figure.cells)} "
            f"cells; the search was complete ({found.nodes} nodes)"
        )
    raise NoPackingError(
        f"no packing of {figure.name} was found within {options.nodes} nodes; --nodes looks further"
    )
