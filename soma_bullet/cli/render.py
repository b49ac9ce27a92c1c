"""The command line of the renderer: `soma-render`, scripts/render.py."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from soma_bullet.cli.common import run_command
from soma_bullet.cli.flags import parse
from soma_bullet.option import Options
from soma_bullet.pictures.options import FilmOptions

if TYPE_CHECKING:
    from soma_bullet.pictures.film import FilmReport


@dataclass(frozen=True)
class RenderArguments(Options):
    """Makes another video, or a still, of an episode from its execution log: other camera, other speed, other
    size.

    Exit status: 0 it is written; 2 bad input.
    """

    names: ClassVar[Mapping[str, str]] = {"film": ""}

    log: Path
    """The log of an episode: runs/NAME/log.npz."""
    out: Path | None = None
    """The file to write: .mp4 or .webp, of a still .png; beside the log if not given."""
    still: bool = False
    """A picture of the end instead of a video."""
    assembly: str | None = None
    """Name or file of the assembly; by default the one that the log names."""
    closing: str = ""
    """The last caption of the video."""
    film: FilmOptions = FilmOptions()
    """How it is made."""

    def faults(self, prefix: str = "--") -> list[str]:
        """As of all options; a picture has neither frames nor words."""
        faults = super().faults(prefix)
        if self.still:
            usual = FilmOptions()
            for name in ("fps", "speed", "supersampling", "quality", "jobs"):
                if getattr(self.film, name) != getattr(usual, name):
                    faults.append(f"--{name} {getattr(self.film, name):g}: is of a video, not of a --still")
            if self.closing:
                faults.append(f"--closing {self.closing}: is of a video, not of a --still")
        return faults


def render(arguments: list[str] | None = None) -> int:
    """Entry point of `soma-render` and of scripts/render.py. Returns the exit status."""
    return run_command(_run, parse(RenderArguments, arguments, "soma-render"))


def _run(options: RenderArguments) -> int:
    options.check()
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    say = partial(console.print, markup=False, highlight=False, soft_wrap=True)
    columns = TextColumn("rendering"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn()
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("rendering", total=1.0)
        report = _rendered(options, lambda fraction: bar.update(task, completed=fraction))
    if report.reason:
        say(f"rendered with {report.renderer}: {report.reason}", style="yellow")
    frames = "1 picture" if report.frames == 1 else f"{report.frames} frames"
    say(f"{report.path}: {frames}, {report.renderer}, {report.seconds:.1f} s")
    return 0


def _rendered(options: RenderArguments, progress: Callable[[float], None]) -> FilmReport:
    from soma_bullet.assembly.file import load_assembly
    from soma_bullet.pictures.film import film, still
    from soma_bullet.records import read_npz
    from soma_bullet.robot.cell import load_cell
    from soma_bullet.world.log import ExecutionLog

    log = read_npz(ExecutionLog, options.log)
    assembly, cell = load_assembly(options.assembly or log.assembly), load_cell(log.cell)
    name = f"still_{options.film.camera}.png" if options.still else f"film_{options.film.camera}.mp4"
    out = options.out or options.log.with_name(name)
    if options.still:
        return still(log, assembly, cell, out, options.film)
    return film(log, assembly, cell, out, options.film, progress, options.closing)
