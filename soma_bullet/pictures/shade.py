"""The look of a still: soft light, ink on edges, glass in front, a shadow on the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soma_bullet.frames import Array
from soma_bullet.pictures.light import KEY, SKY, key_direction, light_rays, power, tile_mean
from soma_bullet.pictures.raster import Body, Camera, Caster, Color, Hits, Pixels, Samples

SHADOW = (0.12, 0.13, 0.18)  # colour of the ground where no light arrives
CREASE = 0.86  # cosine below which two neighbouring normals make an edge
STEP = 4e-3  # height of a step that makes an edge, as a fraction of the scene


@dataclass(frozen=True)
class Look:
    """How a still looks.

    Attributes:
        samples: rays along each side of a pixel.
        line: width of the ink on edges [pixels].
        ink: colour of edges.
        silhouette, crease: how dark edges between bodies, and those within one, are.
        smoothing: strides [samples] over which light is averaged in turn; a large picture shows the steps
            between 25 shares of light, and takes a second one.
        shadow: how dark the ground's shadow is.
        background: colour behind everything; None is transparent.
    """

    samples: int = 3
    line: float = 1.0
    ink: Color = (0.10, 0.11, 0.14)
    silhouette: float = 0.85
    crease: float = 0.5
    smoothing: tuple[int, ...] = (1,)
    shadow: float = 0.55
    background: Color | None = None


def render(
    bodies: tuple[Body, ...], camera: Camera, ground: float | None = None, look: Look | None = None
) -> Pixels:
    """A picture (height, width, 4) RGBA, not premultiplied.

    Args:
        ground: height [m] of a plane that is seen by the shadow on it alone; None for no ground.
    """
    look = look or Look()
    window = camera.window(_corners(bodies), border=2)
    grid = camera.rays(look.samples, window)
    shape, rays = (grid.shape[0], grid.shape[1]), grid.reshape(-1, 3)
    solid = Caster(tuple(b for b in bodies if b.alpha >= 1 and not b.on_top))
    glass = Caster(tuple(b for b in bodies if b.alpha < 1 and not b.on_top))
    marks = Caster(tuple(b for b in bodies if b.on_top))
    hits = solid.first(camera.eye, rays)
    size = float(np.linalg.norm(np.ptp(_corners(bodies), axis=0)))
    color, cover = np.zeros((len(rays), 3), np.float32), np.zeros(len(rays), np.float32)
    seen = np.flatnonzero(hits.body >= 0)
    if len(seen):
        color[seen], cover[seen] = _lit_bodies(solid, hits, rays, seen, camera, size, look, shape), 1.0
        _ink(color, cover, hits, rays, size, look, shape)
    for layer, limit in ((glass, hits.distance), (marks, None)):
        if layer.bodies:
            _add_layer(color, cover, layer, rays, camera, limit, size, look, shape)
    over = np.zeros((camera.height, camera.width, 4), np.float32)
    left, top, right, bottom = window
    over[top:bottom, left:right] = _pixel_means(color, cover, look.samples, shape)
    shadow = np.zeros(camera.width * camera.height, np.float32)
    if ground is not None and solid.bodies:
        shadow = _ground_shadow(solid, camera, ground, size, look)
    return _over_ground(over, shadow.reshape(over.shape[:2]), look)


def faded(image: Pixels) -> Pixels:
    """The picture in pale greys, for what cannot be done."""
    grey = image[..., :3] @ np.array((0.3, 0.59, 0.11)) * 0.35 + 255 * 0.62
    return np.dstack([np.repeat(grey[..., None], 3, axis=2), image[..., 3] * 0.8]).round().astype(np.uint8)


def _corners(bodies: tuple[Body, ...]) -> Array:
    return np.concatenate([b.triangles.reshape(-1, 3) for b in bodies])


def _lit_bodies(
    solid: Caster, hits: Hits, rays: Samples, seen: NDArray[np.intp], camera: Camera,
    size: float, look: Look, shape: tuple[int, int],
) -> Samples:  # fmt: skip
    """Colour (n, 3) of the n rays numbered `seen`, which hit a body."""
    light = key_direction(camera)
    normal = hits.normal[seen]
    eye = camera.eye.astype(np.float32)
    points = eye + hits.distance[seen, None] * rays[seen] + normal * np.float32(1e-4 * size)
    direct, sky = light_rays(solid, points, normal, seen, light, size, shape)
    surface = _surface(hits)
    for stride in look.smoothing:
        direct, sky = tile_mean(direct, sky, surface, seen, shape, stride)
    facing = np.maximum(normal @ light.astype(np.float32), 0)
    palette = np.array([b.color for b in solid.bodies], np.float32)
    # a gamma of 2: the square root of the light times the display colour
    return np.minimum(
        palette[hits.body[seen]] * np.sqrt(power(facing, normal[:, 2], direct, sky) * 1.06), 1.0
    )


def _ground_shadow(solid: Caster, camera: Camera, ground: float, size: float, look: Look) -> Samples:
    """How dark the ground is at each pixel (n,), 0..1: once a pixel is enough for what is soft anyway."""
    rays = camera.rays(1).reshape(-1, 3)
    shape = (camera.height, camera.width)
    light = key_direction(camera)
    with np.errstate(divide="ignore"):
        t = ((ground - camera.eye[2]) / rays[:, 2]).astype(np.float32)
    corners = _corners(solid.bodies)
    centre = (corners.min(axis=0) + corners.max(axis=0)) / 2
    # the shadow of the highest point reaches furthest from the foot of the scene
    middle = centre[:2] - light[:2] / light[2] * max(centre[2] - ground, 0) * 0.5
    reach = np.hypot(*(camera.eye[:2, None] + t * rays[:, :2].T - middle[:, None])) / (1.2 * size)
    seen = np.flatnonzero((t > 0) & (reach < 1))
    shadow = np.zeros(len(rays), np.float32)
    if not len(seen):
        return shadow
    points = (camera.eye + t[seen, None] * rays[seen]).astype(np.float32)
    points[:, 2] = ground + 1e-4 * size
    normal = np.tile(np.array((0, 0, 1), np.float32), (len(seen), 1))
    key = np.full(len(rays), -1, np.int32)
    key[seen] = 0
    direct, sky = light_rays(solid, points, normal, seen, light, size, shape)
    for stride in (1, 1, *look.smoothing[1:]):  # the second time smooths what is left of the tiles
        direct, sky = tile_mean(direct, sky, key, seen, shape, stride)
    arriving = KEY * float(light[2]) * direct + SKY * sky
    dark = 1 - np.sqrt(np.clip(arriving / (KEY * float(light[2]) + SKY), 0, 1))
    # it fades away from the scene and towards the border of the picture, so that no edge cuts it
    row, column = seen // shape[1], seen % shape[1]
    border = np.minimum(np.minimum(row, shape[0] - 1 - row), np.minimum(column, shape[1] - 1 - column)) / (
        0.1 * min(shape)
    )
    fade = np.clip(2.5 - 2.5 * reach[seen], 0, 1) * np.clip(border, 0, 1)
    shadow[seen] = look.shadow * np.minimum(dark * 1.4, 1.0) * fade
    return shadow


def _surface(hits: Hits) -> NDArray[np.int32]:
    """A number (n,) for each surface within which light may be averaged: body and rounded normal; -1 for
    none."""
    rounded = np.rint(hits.normal * 3) @ np.array((49, 7, 1), np.float32)  # -171 to 171
    return np.where(hits.body >= 0, hits.body * 343 + rounded.astype(np.int32) + 171, -1).astype(np.int32)


def _edges(hits: Hits, rays: Samples, size: float, look: Look, shape: tuple[int, int]) -> Samples:
    """Ink (n,) in 0..1: between bodies and against the background, at creases, and at steps within one
    body."""
    body = hits.body.reshape(shape)
    normal = hits.normal.reshape(*shape, 3)
    near = np.where(hits.body >= 0, hits.distance, 0)
    # distance of the plane through the hit from the eye: alike within a plane, so that it jumps at a step
    # alone
    plane = (near * np.einsum("ij,ij->i", hits.normal, rays)).reshape(shape)
    ink = np.zeros(shape, np.float32)
    for a, b in (
        ((slice(1, None),), (slice(None, -1),)),
        ((slice(None), slice(1, None)), (slice(None), slice(None, -1))),
    ):
        other = body[a] != body[b]
        turn = np.einsum("ijk,ijk->ij", normal[a], normal[b])
        within = (body[a] >= 0) & ~other
        crease = within & (turn < CREASE)
        step = within & (turn > 0.999) & (np.abs(plane[a] - plane[b]) > STEP * size)
        strength = np.maximum(look.silhouette * (other | step), look.crease * crease).astype(np.float32)
        ink[a] = np.maximum(ink[a], strength)
        ink[b] = np.maximum(ink[b], strength)
    return _widened(ink, round(look.line * look.samples) - 2).reshape(-1)


def _widened(ink: Samples, by: int) -> Samples:
    """Ink spread by `by` samples along both axes, to either side in turn."""
    for k in range(by):
        wide = ink.copy()
        for axis in (0, 1):
            ahead = tuple(slice(1, None) if j == axis else slice(None) for j in (0, 1))
            behind = tuple(slice(None, -1) if j == axis else slice(None) for j in (0, 1))
            to, source = (ahead, behind) if k % 2 else (behind, ahead)
            wide[to] = np.maximum(wide[to], ink[source])
        ink = wide
    return ink


def _ink(
    color: Samples, cover: Samples, hits: Hits, rays: Samples, size: float, look: Look, shape: tuple[int, int]
) -> None:
    """Draw the edges of the solid bodies over colour and cover."""
    ink = _edges(hits, rays, size, look, shape)
    at = np.flatnonzero(ink)
    color[at] = color[at] * (1 - ink[at, None]) + ink[at, None] * np.array(look.ink, np.float32)
    cover[at] = cover[at] * (1 - ink[at]) + ink[at]


def _add_layer(
    color: Samples, cover: Samples, layer: Caster, rays: Samples, camera: Camera, limit: Samples | None,
    size: float, look: Look, shape: tuple[int, int],
) -> None:  # fmt: skip
    """Draw glass, or marks on top, over colour and cover: its nearest surface alone, so that a cluster stays
    readable."""
    hits = layer.first(camera.eye, rays)
    if limit is not None:
        hidden = hits.distance > limit
        hits.body[hidden], hits.distance[hidden], hits.normal[hidden] = -1, np.inf, 0
    palette = np.array([b.color for b in layer.bodies], np.float32)
    alphas = np.array([b.alpha for b in layer.bodies], np.float32)
    at = np.flatnonzero(hits.body >= 0)
    light = key_direction(camera).astype(np.float32)
    shade = np.sqrt(0.50 + 0.28 * (hits.normal[at] @ light) + 0.22 * hits.normal[at, 2])
    alpha = alphas[hits.body[at]]
    tone = np.minimum(palette[hits.body[at]] * (0.12 + shade[:, None]), 1.0)
    color[at] = color[at] * (1 - alpha[:, None]) + tone * alpha[:, None]
    cover[at] = cover[at] * (1 - alpha) + alpha
    ink = _edges(hits, rays, size, look, shape)
    if limit is not None:  # a line where glass passes behind a body would double that body's own
        ink[np.isfinite(limit) & (hits.body < 0)] = 0
    at = np.flatnonzero(ink)
    # lines take the colour of their own glass; those that spread off it, the mean's
    tint = np.where(hits.body[at, None] >= 0, palette[hits.body[at]], palette.mean(axis=0)) * 0.45
    strength = ink[at] * 0.8
    color[at] = color[at] * (1 - strength[:, None]) + tint * strength[:, None]
    cover[at] = cover[at] * (1 - strength) + strength


def _pixel_means(color: Samples, cover: Samples, k: int, shape: tuple[int, int]) -> Samples:
    """Means over the k x k samples of each pixel: premultiplied RGBA (height, width, 4)."""
    stacked = np.empty((len(cover), 4), np.float32)
    stacked[:, :3], stacked[:, 3] = color, cover
    rows = stacked.reshape(shape[0] // k, k, shape[1] * 4).sum(axis=1)
    means: Samples = rows.reshape(shape[0] // k, shape[1] // k, k, 4).sum(axis=2) / np.float32(k**2)
    return means


def _over_ground(over: Samples, shadow: Samples, look: Look) -> Pixels:
    """A picture (h, w, 4) above the ground's shadow (h, w) and the background, as bytes."""
    under = np.empty_like(over)
    under[..., 3] = shadow
    under[..., :3] = under[..., 3:] * np.array(SHADOW, np.float32)
    if look.background is not None:
        under[..., :3] += (1 - under[..., 3:]) * np.array(look.background, np.float32)
        under[..., 3] = 1
    picture = over + (1 - over[..., 3:]) * under
    picture[..., :3] /= np.maximum(picture[..., 3:], 1e-6)
    return np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8)
