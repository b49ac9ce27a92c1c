"""Light of a still: one ray to a soft key light and one to the sky from every sample, averaged over small
tiles.

The rays are interleaved: each sample of a tile of 5 x 5 takes another of 25 directions, and the mean over the
tile, taken within one surface, gives every sample all 25. So light is smooth, without noise, and the same
bytes come out every time. The directions turn from tile to tile; a large picture averages over several tiles.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soma_bullet.frames import Array, tangents
from soma_bullet.pictures.raster import Camera, Caster, Samples

TILE = 5  # samples; odd, so that the tile is centred
TURNS = 16  # sets of directions, each turned against the others
SHADOW_SOFTNESS = np.deg2rad(9.0)  # [rad] half angle under which the key light is seen
KEY, SKY = 0.68, 0.52  # share of light; a lit top face comes to about 1
KEY_TINT = np.array((1.0, 0.985, 0.955), np.float32)
SKY_TINT = np.array((0.97, 0.985, 1.0), np.float32)


def key_direction(camera: Camera) -> Array:
    """Unit (3,) towards the key light: high, to the left of the camera and in front of the scene."""
    back = -camera.axes[2]
    level = np.array((back[0], back[1], 0.0))
    level /= np.linalg.norm(level) + 1e-12
    light = 0.50 * level - 0.42 * camera.axes[0] + np.array((0.0, 0.0, 1.15))
    return light / np.linalg.norm(light)


def power(facing: Samples, upward: Samples, direct: Samples, sky: Samples) -> Samples:
    """Light (n, 3) in red, green and blue: about 1 on an open top face."""
    return (KEY * facing * direct)[:, None] * KEY_TINT + (SKY * (0.62 + 0.38 * upward) * sky)[
        :, None
    ] * SKY_TINT


def light_rays(
    solid: Caster,
    points: Samples,
    normal: Samples,
    seen: NDArray[np.intp],
    light: Array,
    size: float,
    shape: tuple[int, int],
) -> tuple[Samples, Samples]:
    """One ray to the key light and one to the sky from each point (n, 3): shares of light (n,) that
    arrive."""
    golden = np.pi * (3 - np.sqrt(5.0))
    turn = (
        np.arange(TILE**2) * golden + np.arange(TURNS)[:, None] * golden / 7
    ).ravel()  # a sunflower: even over the disc
    radius = np.tile(np.sqrt((np.arange(TILE**2) + 0.5) / TILE**2), TURNS)
    disc = np.column_stack([radius * np.cos(turn), radius * np.sin(turn)])
    t, b = tangents(light)
    key_rays = light + np.tan(SHADOW_SOFTNESS) * (disc[:, :1] * t + disc[:, 1:] * b)
    row, column = seen // shape[1], seen % shape[1]
    which = 7 * (column % TILE + TILE * (row % TILE)) % TILE**2  # neighbours far apart on the disc
    which += TILE**2 * ((column // TILE * 7 + row // TILE * 11) % TURNS)
    direct = 1.0 - solid.blocked(points, key_rays.astype(np.float32)[which]).astype(np.float32)
    hemisphere = np.column_stack([disc, np.sqrt(1 - radius**2)]).astype(np.float32)[which]
    # a frame about each normal without a branch (Duff et al., Building an Orthonormal Basis, Revisited)
    sign = np.copysign(np.float32(1), normal[:, 2])
    a = -1 / (sign + normal[:, 2])
    c = normal[:, 0] * normal[:, 1] * a
    first = np.column_stack([1 + sign * normal[:, 0] ** 2 * a, sign * c, -sign * normal[:, 0]])
    second = np.column_stack([c, sign + normal[:, 1] ** 2 * a, -normal[:, 1]])
    sky_rays = hemisphere[:, :1] * first + hemisphere[:, 1:2] * second + hemisphere[:, 2:] * normal
    free = solid.distances(points, np.ascontiguousarray(sky_rays, np.float32))
    far = np.float32(0.35 * size)
    open_sky: Samples = (np.minimum(free, far) / far).astype(np.float32)
    return direct, open_sky


def tile_mean(
    direct: Samples,
    sky: Samples,
    key: NDArray[np.int32],
    seen: NDArray[np.intp],
    shape: tuple[int, int],
    stride: int = 1,
) -> tuple[Samples, Samples]:
    """Both shares averaged over a tile about each sample, or over every `stride`-th sample, within one
    surface."""
    rows = seen // shape[1]
    top, bottom = int(rows.min()), int(rows.max()) + 1
    part = slice(top * shape[1], bottom * shape[1])
    surfaces = key[part].reshape(-1, shape[1])
    values = np.zeros((2, *surfaces.shape), np.float32)
    values.reshape(2, -1)[:, seen - part.start] = direct, sky
    for axis in (0, 1):
        total, count = values.copy(), np.ones(surfaces.shape, np.float32)
        for shift in range(stride, stride * (TILE // 2) + 1, stride):
            if shift >= surfaces.shape[axis]:
                break
            ahead = tuple(slice(shift, None) if k == axis else slice(None) for k in (0, 1))
            behind = tuple(slice(None, -shift) if k == axis else slice(None) for k in (0, 1))
            same = (surfaces[ahead] == surfaces[behind]).astype(np.float32)
            total[(slice(None), *ahead)] += values[(slice(None), *behind)] * same
            total[(slice(None), *behind)] += values[(slice(None), *ahead)] * same
            count[ahead] += same
            count[behind] += same
        values = total / count
    flat = values.reshape(2, -1)[:, seen - part.start]
    return flat[0], flat[1]
