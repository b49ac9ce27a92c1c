"""The command line of figures: `soma-figure`, scripts/figure.py. From a drawing to a plan, and with --build
on to the built figure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from soma_bullet.cli.common import WIDTH, run_command
from soma_bullet.cli.episode import PLANNED
from soma_bullet.cli.flags import parse
from soma_bullet.errors import NoSolutionError
from soma_bullet.figure.options import FigureOptions
from soma_bullet.option import Options, changed
from soma_bullet.options import EpisodeOptions
from soma_bullet.pictures.options import FilmOptions

if TYPE_CHECKING:
    from rich.console import Console

    from soma_bullet.figure.plan_figure import FigurePlan
    from soma_bullet.planner.assembly_plan import AssemblyPlan

PLANS = (*PLANNED, "--cell", "--hand", "--seed", "--labels")  # what counts without --build
SCHEDULED = 3  # packings of which a schedule is looked for
SHOWN = 12  # packings that are printed with --packings


@dataclass(frozen=True)
class FigureArguments(Options):
    """Fills a drawn figure with Soma pieces, finds the packing and the side that can be built best, and plans
    it; with --build two arms build it in contact physics.

    Exit status: 0 planned, and built where that was asked for; 1 the judge says no; 2 bad input; 3 no
    packing, it stands nowhere, or no plan or no motion found (with the reasons).
    """

    names: ClassVar[Mapping[str, str]] = {"figure": "", "episode": ""}

    drawing: str
    """A text of layers from the bottom up with blank lines between them, in which every character but a space
    and a dot is a cell; or JSON. FILE:NAME takes one figure of several."""
    figure: FigureOptions = FigureOptions()
    """Which packings are looked at."""
    out: Path | None = None
    """Folder for the assembly file, its meshes, plan.json and pictures, and what an episode writes [default:
    runs/figure/<name of the figure>]."""
    build: bool = False
    """Build it, as soma-episode does."""
    video: bool = True
    """--no-video saves the time."""
    episode: EpisodeOptions = EpisodeOptions()
    """Everything that decides the episode."""

    def faults(self, prefix: str = "--") -> list[str]:
        """As of all options; what is not built takes no options of building."""
        faults, given = super().faults(prefix), changed(self.episode, EpisodeOptions(film=FilmOptions()))
        if not self.build:
            faults += [
                f"{text}: counts only with --build"
                for name, text in given.items()
                if not name.startswith(PLANS)
            ]
        elif not self.video:
            films = [text for name, text in given.items() if name.startswith("--film.")]
            faults += [f"{text}: there is no film with --no-video" for text in films]
        return faults


def figure(arguments: list[str] | None = None) -> int:
    """Entry point of `soma-figure` and of scripts/figure.py. Returns the exit status."""
    return run_command(_run, parse(FigureArguments, arguments, "soma-figure"))


def _run(options: FigureArguments) -> int:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    options.check()
    from soma_bullet.episode import check_folder, run_episode
    from soma_bullet.figure.packing import Packing
    from soma_bullet.figure.plan_figure import plan_figure
    from soma_bullet.pipeline import cell_of
    from soma_bullet.report.report import print_report

    console = Console(stderr=True)
    console.width = max(console.width, WIDTH)
    episode = options.episode if options.video else replace(options.episode, film=None)
    check_folder(options.out)
    cell = cell_of(episode)
    planner = replace(episode.planner.with_hands(len(cell.arms)), seed=episode.seed)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("starting", total=1.0)

        def progress(what: str, fraction: float) -> None:
            bar.update(task, description=what, completed=fraction)

        refused = frozenset[Packing]()
        while True:
            found = plan_figure(options.drawing, cell.hands, options.figure, planner, progress, refused)
            out = options.out or Path("runs") / "figure" / found.name
            progress(f"drawing {found.name}", 0.0)
            plan, file = _write(found, out)
            _print_figure(found, plan, options.figure, console)
            if not options.build:
                console.print(f"written to {out}/", markup=False)
                return 0
            try:
                report = run_episode(file, episode, out, out / "plan.json", progress=progress)
                break
            except NoSolutionError as error:  # another packing may have a schedule
                refused |= {found.packing}
                if len(refused) == SCHEDULED:
                    raise
                console.print(f"this packing has no schedule, another is looked for: {error.summary}\n")
    assert report is not None
    print_report(report, console)
    if report.video["note"] and options.video:
        console.print(f"[yellow]video[/]: {report.video['note']}")
    console.print(f"written to {out}/", markup=False)
    return 0 if report.success else 1


def _write(found: FigurePlan, out: Path) -> tuple[AssemblyPlan, Path]:
    """Everything that there is before building; returns the plan of the file, and the file."""
    from soma_bullet.assembly.file import load_assembly
    from soma_bullet.pictures.exploded import draw_exploded
    from soma_bullet.pictures.figure import draw_orders
    from soma_bullet.records import write_json

    file = found.write(out)
    assembly = load_assembly(file)
    plan = replace(found.plan, digest=assembly.digest)
    write_json(plan, out / "plan.json")
    draw_orders(assembly, found.hands, plan, out / "orders.png")
    draw_exploded(assembly, plan, out / "exploded.png")
    return plan, file


def _print_figure(found: FigurePlan, plan: AssemblyPlan, options: FigureOptions, console: Console) -> None:
    """The packing, what was looked at, and the plan."""
    from soma_bullet.figure.packing import layers_text
    from soma_bullet.report.table import plan_table

    packings = found.packings
    if options.packings is not None:
        for number, packing in enumerate(packings.found[:SHOWN]):
            console.print(f"packing {number + 1} of {len(packings.found)}\n{layers_text(packing)}")
    count = f"{packings.distinct} packings, {packings.placed} as placed"
    ended = "" if packings.complete else "; the search ended before it had found all"
    console.print(f"{found.name}: {count}{ended}", markup=False)
    for survey in found.surveys:
        console.print(f"  {survey.text()}", markup=False)
    down = "as drawn" if found.side == "as-drawn" else f"its {found.side} down"
    console.print(f"chosen: {down}; layer by layer from the bottom up\n\n{found.layers}", markup=False)
    console.print(plan_table(plan))
    for warning in plan.warnings:
        console.print(f"[yellow]warning[/]: {warning}")
