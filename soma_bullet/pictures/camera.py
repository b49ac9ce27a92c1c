"""Cameras, and what they are to show."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from soma_bullet.frames import Array
from soma_bullet.pictures import look

Frame = NDArray[np.uint8]


@dataclass(frozen=True)
class PieceVisual:
    """A piece as it looks: vertices (v, 3) [m] in its own frame, faces (f, 3), rgb 0..1."""

    name: str
    vertices: Array
    faces: NDArray[np.int64]
    rgb: look.Colour


@dataclass(frozen=True)
class Arrow:
    """A direction to show: from `start` (3,) [m] along `direction` (3,), `length` long [m]."""

    start: ArrayLike
    direction: ArrayLike
    length: float = 0.06
    rgb: look.Colour = look.ARROW


@dataclass(frozen=True)
class Camera:
    """A camera that orbits `target`: distance [m]; yaw, pitch and vertical fov [deg], pitch negative from
    above.

    Yaw 0 looks along +y: the left arm is on the left.
    """

    target: tuple[float, float, float]
    distance: float
    yaw: float
    pitch: float
    fov: float = 35.0

    @property
    def axes(self) -> Array:
        """Right, up and backward of the picture in the world, as columns (3, 3)."""
        yaw, pitch = math.radians(self.yaw), math.radians(self.pitch)
        backward = (math.cos(pitch) * math.sin(yaw), -math.cos(pitch) * math.cos(yaw), -math.sin(pitch))
        right = (math.cos(yaw), math.sin(yaw), 0.0)
        return np.stack((right, np.cross(backward, right), backward), axis=1)

    @property
    def eye(self) -> Array:
        """Where the camera is (3,) [m]."""
        return np.asarray(self.target) + self.distance * self.axes[:, 2]

    def project(self, points: ArrayLike, aspect: float) -> Array:
        """Where points (n, 3) are in the picture (n, 2): right and up, -1..1 from edge to edge."""
        local = (np.asarray(points, float) - self.eye) @ self.axes
        half = math.tan(math.radians(self.fov) / 2)
        return local[:, :2] / (-local[:, 2:] * half * (aspect, 1.0))

    def orbited(self, angle: float) -> Camera:
        """The same camera, `angle` [deg] further round."""
        return replace(self, yaw=self.yaw + angle)

    def swaying(self, phase: float, amplitude: float = 12.0) -> Camera:
        """The camera at a phase (0..1) of a slow sway of +-`amplitude` [deg]."""
        return self.orbited(amplitude * math.sin(2 * math.pi * phase))


CAMERAS: Mapping[str, Camera] = {
    "front": Camera((0.0, 0.0, 0.21), 1.75, 0.0, -20.0),
    "three_quarter": Camera((0.0, 0.0, 0.22), 1.95, -36.0, -25.0),
    "close": Camera((0.0, 0.0, 0.15), 0.62, -42.0, -20.0),
    "top": Camera((0.0, 0.0, 0.0), 2.00, 0.0, -89.0),
    "left": Camera((0.0, 0.0, 0.18), 1.75, -62.0, -24.0),
    "right": Camera((0.0, 0.0, 0.18), 1.75, 62.0, -24.0),
}
