"""Frames from descriptions, on one process or several."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from multiprocessing import get_context
from multiprocessing.util import Finalize
from pathlib import Path

from soma_bullet.errors import InputError
from soma_bullet.frames import Array, from_quat_xyzw
from soma_bullet.pictures.camera import Arrow, Camera, Frame, PieceVisual
from soma_bullet.pictures.caption import Caption, draw_caption
from soma_bullet.pictures.studio import Studio

AHEAD = 6  # frames that each process may be ahead of the file


@dataclass(frozen=True, eq=False)
class Shot:
    """One frame, described: joints (j,) and poses (n, 7), position and quat_xyzw, in the order of the stage's
    names."""

    joints: Array
    poses: Array
    camera: Camera
    arrow: Arrow | None = None
    caption: Caption | None = None


@dataclass(frozen=True, eq=False)
class Stage:
    """What every process needs to open its studio; see Studio. `piece_names` are those of a shot's poses."""

    urdf: Path
    pieces: tuple[PieceVisual, ...]
    joint_names: tuple[str, ...]
    piece_names: tuple[str, ...]
    size: tuple[int, int]
    renderer: str
    supersampling: int

    def open(self) -> Studio:
        """A studio for this stage; to be closed."""
        return Studio(self.urdf, self.pieces, self.size, self.renderer, self.supersampling)

    def shoot(self, studio: Studio, shot: Shot) -> Frame:
        """The frame (h, w, 3) of a shot."""
        poses = {
            name: from_quat_xyzw(row[:3], row[3:])
            for name, row in zip(self.piece_names, shot.poses, strict=True)
        }
        joints = dict(zip(self.joint_names, shot.joints.tolist(), strict=True))
        frame = studio.frame(joints, poses, shot.camera, shot.arrow)
        return draw_caption(frame, shot.caption) if shot.caption else frame


@dataclass
class Crew:
    """Renders shots, and says with which renderer (`egl` or `tiny`) and why not with the one asked for."""

    stage: Stage
    processes: int = 1
    renderer: str = ""
    reason: str = ""

    def frames(self, shots: Sequence[Shot]) -> Iterator[Frame]:
        """The frames of the shots, in order; the same for any number of processes.

        Raises:
            InputError: `egl` was insisted on in vain.
        """
        if self.processes == 1 or len(shots) < 2 * self.processes:
            with self.stage.open() as studio:
                self.renderer, self.reason = studio.renderer, studio.reason
                yield from (self.stage.shoot(studio, shot) for shot in shots)
            return
        done = 0
        try:
            for frame in self._shared(shots):
                yield frame
                done += 1
        except BrokenProcessPool:  # an OpenGL driver took its process down
            if self.renderer == "tiny" or self.stage.renderer == "egl":
                raise InputError(
                    "renderer", f"{self.renderer or self.stage.renderer}: a rendering process died"
                ) from None
            self.stage = replace(self.stage, renderer="tiny")
            yield from self._shared(shots[done:])
            self.reason = "a process with the OpenGL renderer died"

    def _shared(self, shots: Sequence[Shot]) -> Iterator[Frame]:
        # not forked: OpenGL and PyBullet do not survive it
        pool = ProcessPoolExecutor(self.processes, get_context("spawn"), _open, (self.stage,))
        try:
            waiting: deque[Future[tuple[Frame, str, str]]] = deque()
            for shot in shots:
                waiting.append(pool.submit(_shoot, shot))
                if len(waiting) > AHEAD * self.processes:
                    yield self._taken(waiting.popleft())
            while waiting:
                yield self._taken(waiting.popleft())
        finally:
            pool.shutdown(cancel_futures=True)

    def _taken(self, future: Future[tuple[Frame, str, str]]) -> Frame:
        frame, self.renderer, self.reason = future.result()
        return frame


_OPENED: list[tuple[Stage, Studio | InputError]] = []  # of this process: a pool has no other place for it


def _open(stage: Stage) -> None:
    try:
        studio = stage.open()
        Finalize(
            None, studio.close, exitpriority=1
        )  # OpenGL says good-bye on standard output, if it is not silenced
        _OPENED.append((stage, studio))
    except InputError as error:  # raised here it would only break the pool
        _OPENED.append((stage, error))


def _shoot(shot: Shot) -> tuple[Frame, str, str]:
    stage, studio = _OPENED[0]
    if isinstance(studio, InputError):
        raise studio
    return stage.shoot(studio, shot), studio.renderer, studio.reason
