"""Bodies, a camera, and what each ray of its picture hits: ray casting on the CPU with Embree, no display
needed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import ArrayLike, NDArray

from soma_bullet.frames import Array, apply

Color = tuple[float, float, float]
Pixels = NDArray[np.uint8]
Samples = NDArray[np.float32]
Window = tuple[int, int, int, int]  # left, top, right, bottom [pixels], the last two past the end

FIELD_OF_VIEW = np.deg2rad(14.0)  # [rad] of the longer side: a long lens keeps parallel edges nearly so


@dataclass(frozen=True, eq=False)
class Body:
    """A closed surface in one colour.

    Attributes:
        triangles: (n, 3, 3) [m] in the world, outward by the right-hand rule.
        color: red, green, blue in 0..1.
        alpha: below 1 it is glass: it shows what is behind, and casts no shadow.
        on_top: drawn over everything else, as an annotation.
    """

    triangles: Array
    color: Color
    alpha: float = 1.0
    on_top: bool = False


def body(
    vertices: ArrayLike, faces: ArrayLike, color: Color, T: Array | None = None, alpha: float = 1.0
) -> Body:
    """A Body from vertices (v, 3) [m] and faces (f, 3), moved by T (4, 4)."""
    moved = np.asarray(vertices, float) if T is None else apply(T, vertices)
    return Body(moved[np.asarray(faces, int)], color, alpha)


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera.

    Attributes:
        eye: its position (3,) [m].
        axes: rows right, down, forward (3, 3), unit, in the world.
        focal: [pixels].
        width, height: of the picture [pixels].
    """

    eye: Array
    axes: Array
    focal: float
    width: int
    height: int

    def project(self, points: ArrayLike) -> Array:
        """Pixel coordinates (..., 2) of points (..., 3) [m]: x to the right, y down, the first pixel's corner
        at 0, 0."""
        local = (np.asarray(points, float) - self.eye) @ self.axes.T
        return local[..., :2] / local[..., 2:] * self.focal + (self.width / 2, self.height / 2)

    def window(self, points: ArrayLike, border: int) -> Window:
        """The pixels where points (n, 3) [m] are seen, and a border about them; at least one pixel."""
        seen = self.project(points)
        left, top = np.floor(seen.min(axis=0)).astype(int) - border
        right, bottom = np.ceil(seen.max(axis=0)).astype(int) + border
        left, top = int(np.clip(left, 0, self.width - 1)), int(np.clip(top, 0, self.height - 1))
        return (
            left,
            top,
            int(np.clip(right, left + 1, self.width)),
            int(np.clip(bottom, top + 1, self.height)),
        )

    def rays(self, samples: int, window: Window | None = None) -> Samples:
        """Unit directions (height * samples, width * samples, 3) through a grid of samples x samples a pixel
        of a window."""
        left, top, right_end, bottom = window or (0, 0, self.width, self.height)
        columns = np.arange(left * samples, right_end * samples) + 0.5
        rows = np.arange(top * samples, bottom * samples) + 0.5
        x = ((columns / samples - self.width / 2) / self.focal).astype(np.float32)
        y = ((rows / samples - self.height / 2) / self.focal).astype(np.float32)
        right, down, forward = self.axes.astype(np.float32)
        rays = x[None, :, None] * right + y[:, None, None] * down + forward
        rays /= np.sqrt(x[None, :] ** 2 + y[:, None] ** 2 + np.float32(1))[..., None]
        return rays


def fit_camera(
    points: ArrayLike, azimuth: float, elevation: float, width: int, height: int, margin: float = 0.04
) -> Camera:
    """The camera that sees points (n, 3) [m] as large as they fit.

    Args:
        azimuth, elevation: of the camera as seen from the points [rad]; azimuth 0 looks from +x.
        margin: fraction of the picture that stays free at each side.
    """
    points = np.asarray(points, float)
    back = np.array(
        (np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)),
    )
    right = np.array((-np.sin(azimuth), np.cos(azimuth), 0.0))
    axes = np.array((right, -np.cross(back, right), -back))
    focal = max(width, height) / 2 / np.tan(FIELD_OF_VIEW / 2)
    target = (points.min(axis=0) + points.max(axis=0)) / 2
    distance = 4 * float(np.linalg.norm(np.ptp(points, axis=0))) + 1e-9
    room = np.array((width, height)) * (1 - 2 * margin)
    for _ in range(
        12
    ):  # perspective: size and place depend on each other, and converge fast with a long lens
        camera = Camera(target + distance * back, axes, focal, width, height)
        seen = camera.project(points)
        low, high = seen.min(axis=0), seen.max(axis=0)
        shift = (low + high) / 2 - (width / 2, height / 2)
        target = target + (shift / focal * distance) @ axes[:2]
        distance *= float(np.max((high - low) / room))
    return Camera(target + distance * back, axes, focal, width, height)


@dataclass(frozen=True, eq=False)
class Hits:
    """First hits of n rays.

    Attributes:
        body: index into the bodies, -1 where nothing is hit (n,).
        distance: along the ray [m], infinite where nothing is hit (n,).
        normal: unit, towards the ray's origin, zero where nothing is hit (n, 3).
    """

    body: NDArray[np.int32]
    distance: Samples
    normal: Samples


class Caster:
    """An Embree scene of some bodies."""

    def __init__(self, bodies: tuple[Body, ...]):
        self.bodies = bodies
        self._scene = EmbreeScene()
        for one in bodies:
            TriangleMesh(self._scene, np.ascontiguousarray(one.triangles, np.float32))

    @cached_property
    def _normals(self) -> Samples:
        """Unit normals of all triangles, body after body."""
        triangles = np.concatenate([one.triangles for one in self.bodies])
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        return normals.astype(np.float32)

    def first(self, eye: Array, rays: Samples) -> Hits:
        """What rays (n, 3) from one point (3,) hit first."""
        n = len(rays)
        if not self.bodies:
            return Hits(
                np.full(n, -1, np.int32), np.full(n, np.inf, np.float32), np.zeros((n, 3), np.float32)
            )
        origins = np.broadcast_to(np.asarray(eye, np.float32), (n, 3))
        found = self._scene.run(np.ascontiguousarray(origins), np.ascontiguousarray(rays), output=1)
        number = found["geomID"]
        offsets = np.cumsum([0, *(len(one.triangles) for one in self.bodies)])
        hit = np.flatnonzero(number >= 0)
        facing = self._normals[offsets[number[hit]] + found["primID"][hit]]
        facing[np.einsum("ij,ij->i", facing, rays[hit]) > 0] *= -1
        normal, distance = np.zeros((n, 3), np.float32), np.full(n, np.inf, np.float32)
        normal[hit], distance[hit] = facing, found["tfar"][hit]
        return Hits(number, distance, normal)

    def blocked(self, origins: Samples, rays: Samples) -> NDArray[np.bool_]:
        """Whether rays (n, 3) from points (n, 3) hit anything (n,)."""
        if not self.bodies or not len(rays):
            return np.zeros(len(rays), bool)
        return self._scene.run(origins, rays, query="OCCLUDED") >= 0

    def distances(self, origins: Samples, rays: Samples) -> Samples:
        """How far rays (n, 3) from points (n, 3) go before they hit (n,) [m]; huge where they do not."""
        if not self.bodies or not len(rays):
            return np.full(len(rays), np.inf, np.float32)
        return self._scene.run(origins, rays, query="DISTANCE")
