"""The film of an episode, made from its log alone: any camera, any speed, on several processes."""

from __future__ import annotations

import math
import os
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from soma_bullet.assembly.model import Assembly
from soma_bullet.errors import InputError
from soma_bullet.frames import Array, apply, from_quat_xyzw
from soma_bullet.robot.cell import Cell
from soma_bullet.robot.compose import compose_urdf
from soma_bullet.sim.camera import CAMERAS, RENDERERS, Arrow, Camera, Frame, PieceVisual, Sight, Studio
from soma_bullet.sim.caption import Caption, draw_caption, holds, narration, phases
from soma_bullet.sim.log import ExecutionLog
from soma_bullet.sim.shots import calmed, cameras_at, choose, framed, views

AUTO = "auto"
HOLD = 2.0  # [s] that the finished assembly is shown at the end
LEAST = 0.6  # [s] that a caption is on show, if there is time
ARROW_LENGTH = (0.05, 0.09)  # [m]
ASIDE = 0.032  # [m] from the piece's path to the arrow beside it
AHEAD = 6  # frames a process may be ahead of the file


@dataclass(frozen=True)
class FilmOptions:
    """How a film is made.

    Attributes:
        size: width and height [pixels], even.
        fps: frames a second.
        speed: seconds of the episode in one second of the film.
        camera: one of CAMERAS, or `auto`, which goes where something happens.
        renderer: `auto`, `egl` or `tiny`, see Studio.
        supersampling: pixels rendered for one shown, along each side.
        quality: x264's constant rate factor, 0..51; lower is better.
        jobs: processes; 0 for up to two, as there are processors.
    """

    size: tuple[int, int] = (1280, 720)
    fps: float = 30.0
    speed: float = 4.0
    camera: str = AUTO
    renderer: str = "auto"
    supersampling: float = 1.0
    quality: int = 20
    jobs: int = 0

    def __post_init__(self) -> None:
        faults = []
        if any(side % 2 or side < 16 for side in self.size):
            faults.append(f"size = {self.size[0]} x {self.size[1]}: both must be even, and at least 16")
        if self.camera not in (AUTO, *CAMERAS):
            faults.append(f"camera = {self.camera!r}: there are {', '.join((AUTO, *CAMERAS))}")
        if self.renderer not in RENDERERS:
            faults.append(f"renderer = {self.renderer!r}: must be {', '.join(RENDERERS)}")
        for name in ("fps", "speed", "supersampling"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                faults.append(f"{name} = {getattr(self, name)}: must be positive")
        if not 0 <= self.quality <= 51:
            faults.append(f"quality = {self.quality}: must be 0..51, lower is better")
        if self.jobs < 0:
            faults.append(f"jobs = {self.jobs}: must be 1 or more, or 0 for up to two")
        if faults:
            raise InputError("film", faults)

    @property
    def processes(self) -> int:
        return self.jobs or min(2, os.cpu_count() or 1)


@dataclass(frozen=True)
class FilmReport:
    """What was made: renderer in use, and why it is not the one asked for (else empty); frames; wall time [s]."""

    path: Path
    renderer: str
    reason: str
    frames: int
    seconds: float


@dataclass(frozen=True, eq=False)
class Shot:
    """One frame, described: joints by the log's order (j,), poses (n, 7) as position and quat_xyzw."""

    joints: Array
    poses: Array
    camera: Camera
    arrow: Arrow | None
    caption: Caption | None


@dataclass(frozen=True, eq=False)
class Stage:
    """What a process needs to open its studio."""

    urdf: Path
    pieces: tuple[PieceVisual, ...]
    joint_names: tuple[str, ...]
    options: FilmOptions


def film(
    log: ExecutionLog,
    assembly: Assembly,
    cell: Cell,
    path: Path,
    options: FilmOptions | None = None,
    progress: Callable[[float], None] | None = None,
    closing: str = "",
) -> FilmReport:
    """Renders an episode to an H.264 file, which appears when it is whole.

    Args:
        progress: told the fraction that is done.
        closing: the last caption, for instance the verdict.

    Raises:
        InputError: assembly and log do not belong together, or `egl` was insisted on in vain.
    """
    options, start = options or FilmOptions(), time.monotonic()
    with tempfile.TemporaryDirectory(prefix="soma_bullet_film_") as folder:
        stage = _stage(log, assembly, cell, Path(folder), options)
        shots = storyboard(log, assembly, stage, closing)
        with _Crew(stage) as crew:
            write_video(Path(path), _counted(crew.frames(shots), len(shots), progress), options.fps, options.quality)
            return FilmReport(Path(path), crew.renderer, crew.reason, len(shots), time.monotonic() - start)


def still(log: ExecutionLog, assembly: Assembly, cell: Cell, path: Path, options: FilmOptions | None = None) -> FilmReport:
    """A picture, without words, of how the episode ended; drawn twice as fine as it is shown.

    Raises:
        InputError: as `film`.
    """
    from PIL import Image

    start = time.monotonic()
    options = replace(options or FilmOptions(), supersampling=2.0, jobs=1)
    with tempfile.TemporaryDirectory(prefix="soma_bullet_still_") as folder:
        stage = _stage(log, assembly, cell, Path(folder), options)
        camera = CAMERAS.get(options.camera) or _portrait(log, assembly, cell, stage)
        with _Crew(stage) as crew:
            (frame,) = crew.frames([Shot(log.joints[-1], log.poses[-1], camera, None, None)])
        Image.fromarray(frame).save(_parent(path))
        return FilmReport(Path(path), crew.renderer, crew.reason, 1, time.monotonic() - start)
