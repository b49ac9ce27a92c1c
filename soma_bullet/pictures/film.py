"""The film of an episode, made from its log alone: any camera, any speed, on several processes."""

from __future__ import annotations

import contextlib
import math
import os
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from soma_bullet.assembly.model import Assembly
from soma_bullet.errors import InputError
from soma_bullet.frames import Array
from soma_bullet.pictures import look
from soma_bullet.pictures.camera import CAMERAS, Frame, PieceVisual
from soma_bullet.pictures.caption import Caption, holds, narration
from soma_bullet.pictures.crew import Crew, Shot, Stage
from soma_bullet.pictures.options import FilmOptions
from soma_bullet.pictures.shots import direct, portrait
from soma_bullet.pictures.sight import Sight
from soma_bullet.pictures.video import check_format, write_video
from soma_bullet.pictures.views import HOLD
from soma_bullet.robot.compose import compose_urdf
from soma_bullet.robot.model import Cell
from soma_bullet.world.log import ExecutionLog

STILL = 24  # pictures that are averaged for the still
LEAST = 0.6  # [s] that a caption is on show, if there is time


@dataclass(frozen=True)
class FilmReport:
    """What was made: renderer in use, and why it is not the one asked for (else empty); frames; wall time
    [s]."""

    path: Path
    renderer: str
    reason: str
    frames: int
    seconds: float


def film(
    log: ExecutionLog,
    assembly: Assembly,
    cell: Cell,
    path: Path,
    options: FilmOptions | None = None,
    progress: Callable[[float], None] | None = None,
    closing: str = "",
) -> FilmReport:
    """Renders an episode to an H.264 file, or to an animated WebP; it appears when it is whole.

    Args:
        progress: told the fraction that is done.
        closing: the last caption, for instance the verdict.

    Raises:
        InputError: an option is out of its range, log and assembly do not belong together, the file is of no
            format that can be written, or `egl` was insisted on in vain.
    """
    options, start = options or FilmOptions(), time.monotonic()
    options.check()
    _check(log, assembly)
    check_format(Path(path))
    with tempfile.TemporaryDirectory(prefix="soma_bullet_film_") as folder:
        shots = storyboard(log, assembly, cell, options, closing)
        crew = Crew(_stage(log, assembly, cell, Path(folder), options), options.processes)
        write_video(
            Path(path), _counted(crew.frames(shots), len(shots), progress), options.fps, options.quality
        )
    return FilmReport(Path(path), crew.renderer, crew.reason, len(shots), time.monotonic() - start)


def still(
    log: ExecutionLog, assembly: Assembly, cell: Cell, path: Path, options: FilmOptions | None = None
) -> FilmReport:
    """A picture, without words, of how the episode ended; finer than a frame of the film. Raises as
    `film`."""
    from PIL import Image

    options, path, start = (
        replace(options or FilmOptions(), supersampling=STILL),
        Path(path),
        time.monotonic(),
    )
    options.check()
    _check(log, assembly)
    camera = CAMERAS.get(options.camera)
    if camera is None:
        with _sight(log, assembly, cell) as sight:
            camera = portrait(log, assembly, sight, options.aspect)
    with tempfile.TemporaryDirectory(prefix="soma_bullet_film_") as folder:
        crew = Crew(_stage(log, assembly, cell, Path(folder), options))
        (frame,) = crew.frames([Shot(log.joints[-1], log.poses[-1], camera)])
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{os.getpid()}.{path.name}")
    Image.fromarray(frame).save(partial)
    partial.replace(path)
    return FilmReport(path, crew.renderer, crew.reason, 1, time.monotonic() - start)


def frame_times(log: ExecutionLog, options: FilmOptions) -> Array:
    """Times of the frames in the film [s], the hold at the end included; times `speed` they are simulated
    seconds."""
    end = float(log.times[-1]) / options.speed + HOLD
    return np.arange(math.floor(end * options.fps + 1e-6) + 1) / options.fps


def storyboard(
    log: ExecutionLog, assembly: Assembly, cell: Cell, options: FilmOptions, closing: str = ""
) -> list[Shot]:
    """Every frame of the film, described."""
    times = frame_times(log, options)
    clock = np.minimum(times * options.speed, log.times[-1])
    with _sight(log, assembly, cell) as sight:
        take = direct(log, assembly, sight, times, options.speed, options.aspect, CAMERAS.get(options.camera))
    words = _captions(log, assembly, times * options.speed, options, closing)
    joints, poses = _interpolated(log, clock)
    return [Shot(*row) for row in zip(joints, poses, take.cameras, take.arrows, words, strict=True)]


@contextlib.contextmanager
def _sight(log: ExecutionLog, assembly: Assembly, cell: Cell) -> Iterator[Sight]:
    with tempfile.TemporaryDirectory(prefix="soma_bullet_sight_") as folder:
        urdf = compose_urdf(cell, log.stand, Path(folder) / "cell.urdf", visuals=False)
        with Sight(urdf, _visuals(assembly)) as sight:
            yield sight


def _interpolated(log: ExecutionLog, clock: Array) -> tuple[Array, Array]:
    """Joints (f, j) and poses (f, n, 7) at the times of the frames [s]."""
    clock = clock.clip(log.times[0], log.times[-1])
    joints = np.stack([np.interp(clock, log.times, column) for column in log.joints.T], axis=1)
    poses = np.empty((len(clock), *log.poses.shape[1:]))
    for k in range(poses.shape[1]):
        poses[:, k, :3] = np.stack(
            [np.interp(clock, log.times, column) for column in log.poses[:, k, :3].T], axis=1
        )
        poses[:, k, 3:] = Slerp(log.times, Rotation.from_quat(log.poses[:, k, 3:]))(clock).as_quat()
    return joints, poses


def _captions(
    log: ExecutionLog, assembly: Assembly, clock: Array, options: FilmOptions, closing: str
) -> list[Caption]:
    """What is said at each time of the frames [s of the simulation], the last of which are after the log's
    end."""
    last = float(log.times[-1])
    lines = [line for line in narration(log, LEAST * options.speed) if line[0] <= last]
    ended = closing or (f"{log.assembly}: {' ← '.join(log.order)}" if log.ended == "done" else log.ended)
    starts = [start for start, _, _ in lines]
    found = []
    for time_ in clock:
        k = int(np.searchsorted(starts, time_ + 1e-9, side="right")) - 1
        words, piece = (ended, "") if time_ > last else lines[k][1:] if k >= 0 else (log.assembly, "")
        held = ", ".join(f"{arm} holds {name}" for arm, name in holds(log, time_))
        step = (
            f"piece {log.order.index(piece) + 1} of {len(log.order)}"
            if piece in log.order
            else f"{len(log.order)} pieces"
        )
        note = f"{log.assembly}    seed {log.seed}    {min(time_, last):.1f} s    {options.speed:g}×"
        rgb = assembly.pieces[assembly.index(piece)].color if piece in assembly.names else look.NEUTRAL
        found.append(Caption(words, f"{step}  –  {held}" if held else step, note, rgb))
    return found


def _stage(log: ExecutionLog, assembly: Assembly, cell: Cell, folder: Path, options: FilmOptions) -> Stage:
    urdf = compose_urdf(cell, log.stand, folder / "cell.urdf")
    return Stage(
        urdf,
        _visuals(assembly),
        log.joint_names,
        log.piece_names,
        options.size,
        options.renderer,
        options.supersampling,
    )


def _visuals(assembly: Assembly) -> tuple[PieceVisual, ...]:
    return tuple(
        PieceVisual(p.name, p.vertices, np.asarray(p.faces, np.int64), p.color) for p in assembly.pieces
    )


def _check(log: ExecutionLog, assembly: Assembly) -> None:
    if (
        log.digest
        and assembly.digest
        and log.digest != assembly.digest
        or set(log.piece_names) != set(assembly.names)
    ):
        raise InputError(assembly.name, f"is not the assembly of this log, {log.assembly!r} with pieces "
                         f"{', '.join(log.piece_names)}, or was changed since")  # fmt: skip


def _counted(
    frames: Iterable[Frame], total: int, progress: Callable[[float], None] | None
) -> Iterator[Frame]:
    for k, frame in enumerate(frames, 1):
        yield frame
        if progress is not None:
            progress(k / total)
