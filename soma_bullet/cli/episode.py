"""The command line of an episode: `soma-episode`, scripts/run_episode.py.

Imports of the pipeline wait until the arguments are known to be good, so that `--help` answers at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from soma_bullet.cli.common import WIDTH, run_command
from soma_bullet.cli.flags import parse
from soma_bullet.option import Options, changed
from soma_bullet.options import EpisodeOptions
from soma_bullet.pictures.options import FilmOptions

if TYPE_CHECKING:
    from rich.console import Console

PLANNED = ("--stability", "--hands", "--top", "--analyzer", "--push", "--disturbance", "--sampling.")
# what the flags begin with of options that count no more once an earlier run has come so far
LATE = {
    "plan": PLANNED,
    "program": (*PLANNED, "--feed.layout", "--feed.poses"),
    "log": (*PLANNED, "--seed", "--search.", "--feed.", "--execution.", "--physics.", "--ablate"),
}


@dataclass(frozen=True)
class RunArguments(Options):
    """Plans an assembly, builds it with two arms in contact physics, judges it by where the pieces end up,
    and films it.

    Exit status: 0 success; 1 the judge says no; 2 bad input; 3 no plan or no motion found (with the reasons).
    """

    names: ClassVar[Mapping[str, str]] = {"episode": "", "resume": "from"}

    assembly: str
    """An assembly file, or the name of one that comes with the package (soma3, soma4, cube)."""
    out: Path | None = None
    """Folder for plan.json, program.npz, log.npz, report.json, the video and a still [default: runs/<name of
    the assembly>]."""
    video: bool = True
    """--no-video saves the time."""
    plan_only: bool = False
    """Stop after plan.json."""
    resume: Path | None = None
    """The plan, program or log of an earlier run, under any name: what comes before it is taken from the
    files beside it."""
    episode: EpisodeOptions = EpisodeOptions()
    """Everything that decides the episode."""

    def faults(self, prefix: str = "--") -> list[str]:
        """As of all options; a film that is not made has none."""
        given = changed(self.episode, EpisodeOptions(film=FilmOptions()))
        faults = super().faults(prefix)
        for stop, what in ((not self.video, "--no-video"), (self.plan_only, "--plan-only")):
            films = [text for name, text in given.items() if name.startswith("--film.") and stop]
            faults += [f"{text}: there is no film with {what}" for text in films]
        return faults


def run_episode(arguments: list[str] | None = None) -> int:
    """Entry point of `soma-episode` and of scripts/run_episode.py. Returns the exit status."""
    return run_command(_run, parse(RunArguments, arguments, "soma-episode"))


def _run(options: RunArguments) -> int:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    options.check()
    _check_resumed(options)
    from soma_bullet.assembly.file import load_assembly
    from soma_bullet.episode import run_episode as run
    from soma_bullet.report.report import print_report

    console = Console(stderr=True)
    console.width = max(console.width, WIDTH)
    out = options.out or Path("runs") / load_assembly(options.assembly).name
    episode = options.episode if options.video else replace(options.episode, film=None)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("starting", total=1.0)
        report = run(
            options.assembly, episode, out, options.resume, options.plan_only,
            lambda what, fraction: bar.update(task, description=what, completed=fraction),
        )  # fmt: skip
    if report is None:
        _print_plan(out, console)
        return 0
    print_report(report, console)
    if report.video["note"] and options.video:
        console.print(f"[yellow]video[/]: {report.video['note']}")
    console.print(f"written to {out}/", markup=False)
    return 0 if report.success else 1


def _check_resumed(options: RunArguments) -> None:
    """Refuse options that come too late for what an earlier run has left."""
    if options.resume is None or not options.resume.is_file():
        return
    given = changed(options.episode, EpisodeOptions(film=FilmOptions()))
    if not given:
        return
    from soma_bullet.errors import InputError
    from soma_bullet.resume import stage_of

    stage = stage_of(options.resume)
    faults = [
        f"{text}: comes too late for the {stage} {options.resume} of --from"
        for name, text in given.items()
        if name.startswith(LATE[stage])
    ]
    if faults:
        raise InputError("options", faults)


def _print_plan(out: Path, console: Console) -> None:
    from soma_bullet.planner.assembly_plan import AssemblyPlan
    from soma_bullet.records import read_json
    from soma_bullet.report.table import plan_table

    plan = read_json(AssemblyPlan, out / "plan.json")
    console.print(plan_table(plan))
    for warning in plan.warnings:
        console.print(f"[yellow]warning[/]: {warning}")
    console.print(f"written to {out}/plan.json", markup=False)
