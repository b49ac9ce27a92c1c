"""How a film is made."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Annotated, Literal

from soma_bullet.option import POSITIVE, Options, Range

CameraName = Literal["auto", "front", "three_quarter", "close", "top", "left", "right"]
RendererName = Literal["auto", "egl", "tiny"]


@dataclass(frozen=True)
class Even:
    """Two even numbers, for what encodes pictures in blocks."""

    least: int

    def fault(self, value: tuple[int, int]) -> str:
        """What would be right; empty where the value is."""
        good = all(side % 2 == 0 and side >= self.least for side in value)
        return "" if good else f"both must be even, and at least {self.least}"


@dataclass(frozen=True)
class FilmOptions(Options):
    """How a film is made."""

    size: Annotated[tuple[int, int], Even(16)] = (1280, 720)
    """Width and height [pixels], both even."""
    fps: Annotated[float, POSITIVE] = 30.0
    """Frames a second of the film."""
    speed: Annotated[float, POSITIVE] = 4.0
    """Seconds of the episode in one second of the film."""
    camera: CameraName = "auto"
    """auto goes where something happens; any other stays."""
    renderer: RendererName = "auto"
    """egl needs the Debian packages libegl1 libegl-mesa0 libgl1-mesa-dri; tiny is PyBullet's own and slow;
    auto is the first of them that works."""
    supersampling: Annotated[int, Range(1)] = 3
    """Pictures averaged for one frame: 1 is the fastest; more give smoother edges and softer shadows."""
    quality: Annotated[int, Range(0, 51)] = 20
    """x264's constant rate factor; lower is better and larger. Of a WebP the same share of its scale."""
    jobs: Annotated[int, Range(0)] = 0
    """Processes; 0 for up to two, as there are processors."""

    @property
    def aspect(self) -> float:
        """Width over height."""
        return self.size[0] / self.size[1]

    @property
    def processes(self) -> int:
        """How many to render on."""
        return self.jobs or min(2, os.cpu_count() or 1)
