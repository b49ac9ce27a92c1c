"""Pictures of the cell: a studio of its own that is told joint values and poses, and knows nothing of
physics.

It renders after the fact, from a log: any camera, any speed, several processes. It uses OpenGL where there is
EGL, also without a GPU; elsewhere PyBullet's own software renderer, which is some five times slower."""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import util
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from soma_bullet.bullet.quiet import pybullet, silenced
from soma_bullet.errors import InputError
from soma_bullet.frames import Array, to_quat_xyzw
from soma_bullet.pictures import look
from soma_bullet.pictures.camera import CAMERAS, Arrow, Camera, Frame, PieceVisual

RENDERERS = ("auto", "egl", "tiny")

_NEAR, _FAR = 0.2, 12.0  # [m] what is nearer to the eye would fill the picture, and is not drawn
_AWAY = (0.0, 0.0, -100.0)  # where what is not shown waits
_LARGEST = (1024, 768)  # [pixels] of one OpenGL picture
_EMPTY = 0.99999  # of the depth buffer: nothing was drawn there
_BACKDROP = ((0.97, 0.975, 0.98), (0.80, 0.825, 0.855))  # rgb at the top and the bottom of the picture
_LIGHT = (0.0, -1.0, 6.0)
_LAMP = 0.55  # radius of the lamp, in the units of its direction
_GOLDEN = (math.sqrt(5) - 1) / 2
_MATT = (0.0, 0.0, 0.0)  # specular colour


class Studio:
    """Renders the cell of a composed URDF with its pieces; a context manager.

    Attributes:
        renderer: `egl` or `tiny`, what is in use.
        reason: why it is not what was asked for; empty otherwise. To be announced.
        joint_names: the movable joints, in the order of an array given to `frame`.
    """

    def __init__(
        self,
        urdf: Path,
        pieces: Sequence[PieceVisual] = (),
        size: tuple[int, int] = (1280, 720),
        renderer: str = "auto",
        supersampling: int = 1,
    ):
        """Opens the studio.

        Args:
            urdf: as `compose_urdf` writes it; mesh paths absolute.
            size: width and height of the pictures, even.
            renderer: `auto` takes EGL where it works; `egl` insists on it; `tiny` needs nothing.
            supersampling: pictures that are averaged for one, the camera and the lamp each time moved a
                little, which gives smooth edges and soft shadows: 3 looks good, 24 perfect; 1 is the fastest,
                and smooths edges afterwards. A sixth of them where the software renderer, which is slow, had
                to stand in.

        Raises:
            InputError: the size or the renderer is unknown, or `egl` was insisted on in vain.
        """
        if renderer not in RENDERERS:
            raise InputError("renderer", f"{renderer!r}: must be one of {', '.join(RENDERERS)}")
        if size[0] % 2 or size[1] % 2 or min(size) < 16:
            raise InputError("size", f"{size}: width and height must be even, for the video, and at least 16")
        self._p = pybullet
        self.size = size
        self._tiles = [(slice(top, bottom), slice(left, right)) for top, bottom in _cuts(size[1], _LARGEST[1])
                       for left, right in _cuts(size[0], _LARGEST[0])]  # fmt: skip
        self._files = tempfile.TemporaryDirectory(prefix="soma_bullet_studio_")
        self._arrows: dict[tuple[float, look.Colour], int] = {}
        with silenced():
            self.client = pybullet.connect(pybullet.DIRECT)
            self.renderer, self.reason = self._start_renderer(renderer)
            stands_in = self.renderer == "tiny" != renderer
            self._jitters = _jitters(-(-supersampling // 6) if stands_in else supersampling)
            self._build(Path(urdf), pieces)
            if self.renderer == "egl":
                for _ in range(3):  # the OpenGL plugin draws shadows from its third picture on
                    self._picture(CAMERAS["top"], [(slice(0, 16), slice(0, 16))])
        if renderer == "egl" and self.renderer != "egl":
            self.close()
            raise InputError("renderer", f"egl is not available: {self.reason}")

    def __enter__(self) -> Studio:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the client and removes its files; may be called twice."""
        if self.client >= 0:
            with silenced():
                self._p.disconnect(physicsClientId=self.client)
            self.client = -1
            self._files.cleanup()

    # --- setting up -----------------------------------------------------------------------------------------

    def _start_renderer(self, wanted: str) -> tuple[str, str]:
        """Loads the OpenGL plugin, which must come before any body: those that exist already stay invisible
        to it."""
        if wanted == "tiny":
            return "tiny", ""
        spec = util.find_spec("eglRenderer")
        if spec is None or spec.origin is None:
            return "tiny", "this build of PyBullet has no eglRenderer"
        if self._p.loadPlugin(spec.origin, "_eglRendererPlugin", physicsClientId=self.client) < 0:
            return (
                "tiny",
                "the eglRenderer plugin does not load: install libegl1 libegl-mesa0 libgl1-mesa-dri",
            )
        return "egl", ""

    def _build(self, urdf: Path, pieces: Sequence[PieceVisual]) -> None:
        p, client = self._p, self.client
        lean = look.lean_urdf(urdf, Path(self._files.name) / "cell.urdf")
        flags = p.URDF_USE_INERTIA_FROM_FILE
        self._robot = p.loadURDF(str(lean), useFixedBase=True, flags=flags, physicsClientId=client)
        count = p.getNumJoints(self._robot, physicsClientId=client)
        infos = [p.getJointInfo(self._robot, i, physicsClientId=client) for i in range(count)]
        self._joints = {info[1].decode(): info[0] for info in infos if info[2] != p.JOINT_FIXED}
        self.joint_names = tuple(self._joints)
        for i in range(-1, len(infos)):
            p.changeVisualShape(self._robot, i, specularColor=_MATT, physicsClientId=client)
        self._pieces = {
            piece.name: self._add_mesh(look.flat_obj(piece.vertices, piece.faces), piece.rgb)
            for piece in pieces
        }

    def _add_mesh(self, obj: str, rgb: look.Colour) -> int:
        p, client = self._p, self.client
        # PyBullet caches files by name: a name is never used twice.
        handle, name = tempfile.mkstemp(suffix=".obj", dir=self._files.name)
        with os.fdopen(handle, "w") as file:
            file.write(obj)
        shape = p.createVisualShape(
            p.GEOM_MESH, fileName=name, rgbaColor=(*rgb, 1), specularColor=_MATT, physicsClientId=client
        )
        return p.createMultiBody(0, -1, shape, basePosition=_AWAY, physicsClientId=client)

    def _place(self, body: int, position: ArrayLike, quat_xyzw: ArrayLike = (0, 0, 0, 1)) -> None:
        self._p.resetBasePositionAndOrientation(body, position, quat_xyzw, physicsClientId=self.client)

    # --- rendering ------------------------------------------------------------------------------------------

    def frame(
        self,
        joint_positions: Mapping[str, float] | ArrayLike,
        poses: Mapping[str, ArrayLike],
        camera: Camera,
        arrow: Arrow | None = None,
    ) -> Frame:
        """One picture (h, w, 3).

        Args:
            joint_positions: by name (those left out stay as they were), or an array in the order of
                `joint_names`.
            poses: T_world_piece (4, 4) by name; pieces left out are not shown.
        """
        self._pose_robot(joint_positions)
        unknown = sorted(set(poses) - set(self._pieces))
        if unknown:
            raise InputError(
                "poses", f"unknown pieces {', '.join(unknown)}; known: {', '.join(self._pieces)}"
            )
        for name, body in self._pieces.items():
            if name in poses:
                self._place(body, *to_quat_xyzw(poses[name]))
            else:
                self._place(body, _AWAY)
        self._pose_arrow(arrow)
        return self._picture(camera)

    def _pose_robot(self, joint_positions: Mapping[str, float] | ArrayLike) -> None:
        if not isinstance(joint_positions, Mapping):
            values = np.asarray(joint_positions, float)
            if values.shape != (len(self._joints),):
                raise InputError(
                    "joint_positions", f"shape {values.shape}: there are {len(self._joints)} joints"
                )
            joint_positions = dict(zip(self.joint_names, values, strict=True))
        for name, value in joint_positions.items():
            if name not in self._joints:
                raise InputError(
                    "joint_positions", f"unknown joint {name!r}; known: {', '.join(self._joints)}"
                )
            self._p.resetJointState(
                self._robot, self._joints[name], float(value), physicsClientId=self.client
            )

    def _pose_arrow(self, arrow: Arrow | None) -> None:
        for body in self._arrows.values():
            self._place(body, _AWAY)
        if arrow is None:
            return
        key = (round(arrow.length, 3), arrow.rgb)
        if key not in self._arrows:
            with silenced():
                self._arrows[key] = self._add_mesh(
                    look.flat_obj(*look.arrow(key[0], 0.045 * key[0] + 0.001)), arrow.rgb
                )
        direction = np.asarray(arrow.direction, float)
        z = direction / np.linalg.norm(direction)
        x = np.cross(z, (0.0, 1.0, 0.0) if abs(z[1]) < 0.9 else (1.0, 0.0, 0.0))
        x /= np.linalg.norm(x)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.stack((x, np.cross(z, x), z), axis=1), arrow.start
        self._place(self._arrows[key], *to_quat_xyzw(T))

    def _picture(self, camera: Camera, tiles: Sequence[tuple[slice, slice]] | None = None) -> Frame:
        """The camera's picture before a soft gradient (no horizon, and no wall in a camera's way)."""
        if len(self._jitters) == 1:
            return _softened(self._exposure(camera, self._jitters[0], tiles or self._tiles))
        total = np.zeros((self.size[1], self.size[0], 3), np.uint16)
        for jitter in self._jitters:
            total += self._exposure(camera, jitter, tiles or self._tiles)
        return ((total + len(self._jitters) // 2) // len(self._jitters)).astype(np.uint8)

    def _exposure(self, camera: Camera, jitter: _Jitter, tiles: Sequence[tuple[slice, slice]]) -> Frame:
        """One picture, put together from tiles: the OpenGL plugin draws 1024 x 768 and stretches what is
        larger."""
        p, (width, height) = self._p, self.size
        view = p.computeViewMatrixFromYawPitchRoll(
            camera.target, camera.distance, camera.yaw, camera.pitch, 0, 2
        )
        top = _NEAR * math.tan(math.radians(camera.fov) / 2)
        pixel = 2 * top / height  # on the near plane
        frame = _backdrop(self.size).copy()
        for rows, columns in tiles:
            left = (columns.start - width / 2 + jitter.right) * pixel
            upper = top - (rows.start + jitter.down) * pixel
            w, h = columns.stop - columns.start, rows.stop - rows.start
            projection = p.computeProjectionMatrix(
                left, left + w * pixel, upper - h * pixel, upper, _NEAR, _FAR
            )
            colours, depths = self._shoot(view, projection, w, h, jitter.light)
            np.copyto(frame[rows, columns], colours[..., :3], where=(depths < _EMPTY)[..., None])
        return frame

    def _shoot(
        self,
        view: Sequence[float],
        projection: Sequence[float],
        width: int,
        height: int,
        light: tuple[float, float, float],
    ) -> tuple[Frame, Array]:
        """Colours (h, w, 4) and depths (h, w) of one picture, from view and projection as PyBullet gives
        them."""
        p = self._p
        _, _, rgba, depth, _ = p.getCameraImage(
            width,
            height,
            view,
            projection,
            shadow=1,
            lightDirection=light,
            lightDistance=3.0,
            lightColor=(1, 1, 1),
            lightAmbientCoeff=0.70,
            lightDiffuseCoeff=0.35,
            lightSpecularCoeff=0.05,
            renderer=p.ER_BULLET_HARDWARE_OPENGL if self.renderer == "egl" else p.ER_TINY_RENDERER,
            flags=p.ER_NO_SEGMENTATION_MASK,
            physicsClientId=self.client,
        )
        return np.reshape(rgba, (height, width, 4)).astype(np.uint8, copy=False), np.reshape(
            depth, (height, width)
        )


@dataclass(frozen=True)
class _Jitter:
    """How far the picture [pixels] and the lamp of one exposure are from the middle."""

    right: float
    down: float
    light: tuple[float, float, float]


def _jitters(count: int) -> tuple[_Jitter, ...]:
    """Evenly spread over a pixel, and over a round lamp that is the wider the more there are: few would show
    as steps."""
    if count < 1:
        raise InputError("supersampling", f"{count}: must be 1 or more")
    if count == 1:
        return (_Jitter(0.0, 0.0, _LIGHT),)
    radius = _LAMP * min(1.0, math.sqrt(count / 24))
    found = []
    for k in range(count):
        # Fibonacci lattice and sunflower: both without clusters for any count
        right, down = (k + 0.5) / count - 0.5, (k * _GOLDEN + 0.5) % 1.0 - 0.5
        r, angle = radius * math.sqrt((k + 0.5) / count), 2 * math.pi * _GOLDEN * k
        found.append(
            _Jitter(
                right, down, (_LIGHT[0] + r * math.cos(angle), _LIGHT[1] + r * math.sin(angle), _LIGHT[2])
            )
        )
    return tuple(found)


def _softened(frame: Frame) -> Frame:
    """The frame with its edges, and only these, smoothed: the OpenGL plugin has no antialiasing."""
    from PIL import Image, ImageFilter

    picture = Image.fromarray(frame)
    edges = picture.convert("L").filter(ImageFilter.FIND_EDGES).filter(ImageFilter.BoxBlur(0.7))
    mask = edges.point([min(255, max(0, 9 * (v - 4))) for v in range(256)])
    smooth = picture.filter(ImageFilter.Kernel((3, 3), (1, 2, 1, 2, 4, 2, 1, 2, 1)))
    return np.asarray(Image.composite(smooth, picture, mask))


def _cuts(length: int, largest: int) -> list[tuple[int, int]]:
    """`length` pixels in equal parts of at most `largest`."""
    ends = np.linspace(0, length, math.ceil(length / largest) + 1).round().astype(int).tolist()
    return list(zip(ends[:-1], ends[1:], strict=True))


@lru_cache(maxsize=4)
def _backdrop(size: tuple[int, int]) -> Frame:
    ramp = np.linspace(0.0, 1.0, size[1])[:, None]
    column = np.array(_BACKDROP[0]) * (1 - ramp) + np.array(_BACKDROP[1]) * ramp
    return np.repeat((255 * column + 0.5).astype(np.uint8)[:, None], size[0], axis=1)
