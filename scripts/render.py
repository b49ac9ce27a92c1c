"""Makes another video, or a still, of an episode from its execution log: other camera, other speed, other
size."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from soma_bullet.pictures.film import FilmOptions, FilmReport


@dataclass(frozen=True)
class Arguments:
    """Makes another video, or a still, of an episode from its execution log."""

    log: Annotated[Path, tyro.conf.Positional]
    """The log of an episode: runs/NAME/log.npz."""
    out: Path | None = None
    """The file to write, .mp4 or .webp; beside the log if not given."""
    still: bool = False
    """A picture of the end instead of a video."""
    assembly: str | None = None
    """Name or file of the assembly; by default the one that the log names."""
    camera: str = "auto"
    """auto, front, three_quarter, close, top, left or right."""
    speed: float = 4.0
    """Seconds of the episode in one second of the video."""
    fps: float = 30.0
    """Frames a second."""
    size: str = "1280x720"
    """Width and height in pixels, even."""
    renderer: Literal["auto", "egl", "tiny"] = "auto"
    """OpenGL, PyBullet's own, or the first of them that works."""
    supersampling: int = 3
    """Pictures averaged for one frame: 1 is the fastest; more give smoother edges and softer shadows."""
    quality: int = 20
    """x264's constant rate factor, 0..51; lower is better and larger. Of a WebP the same share of its
    scale."""
    jobs: int = 0
    """Processes; 0 for up to two."""
    closing: str = ""
    """The last caption of the video."""


def options(arguments: Arguments) -> FilmOptions:
    """The film's options. Raises InputError."""
    from soma_bullet.errors import InputError
    from soma_bullet.pictures.film import FilmOptions

    width, _, height = arguments.size.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise InputError("size", f"{arguments.size!r}: must be like 1280x720")
    return FilmOptions(
        (int(width), int(height)), arguments.fps, arguments.speed, arguments.camera, arguments.renderer,
        arguments.supersampling, arguments.quality, arguments.jobs,
    )  # fmt: skip


def render(arguments: Arguments, progress: Callable[[float], None]) -> FilmReport:
    """Load the log and render it. Raises InputError."""
    from soma_bullet.assembly.file import load_assembly
    from soma_bullet.pictures.film import film, still
    from soma_bullet.records import read_npz
    from soma_bullet.robot.cell import load_cell
    from soma_bullet.world.log import ExecutionLog

    how = options(arguments)
    log = read_npz(ExecutionLog, arguments.log)
    assembly, cell = load_assembly(arguments.assembly or log.assembly), load_cell(log.cell)
    out = arguments.out or arguments.log.with_name(
        f"{'still' if arguments.still else 'film'}_{arguments.camera}"
    ).with_suffix(".png" if arguments.still else ".mp4")
    if arguments.still:
        return still(log, assembly, cell, out, how)
    return film(log, assembly, cell, out, how, progress, arguments.closing)


def main() -> int:
    arguments = tyro.cli(Arguments)
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    from soma_bullet.errors import SomaBulletError

    console = Console(stderr=True)
    say = partial(console.print, markup=False, highlight=False, soft_wrap=True)
    columns = TextColumn("rendering"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn()
    try:
        with Progress(*columns, console=console, transient=True) as bar:
            task = bar.add_task("rendering", total=1.0)
            report = render(arguments, lambda fraction: bar.update(task, completed=fraction))
    except SomaBulletError as error:
        say(str(error), style="red")
        return error.exit_status
    if report.reason:
        say(f"rendered with {report.renderer}: {report.reason}", style="yellow")
    frames = "1 picture" if report.frames == 1 else f"{report.frames} frames"
    say(f"{report.path}: {frames}, {report.renderer}, {report.seconds:.1f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
