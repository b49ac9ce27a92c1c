"""The exploded view of a plan: every piece moved back along its way in, later ones farther, with numbers and
directions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import Array, Mask
from soma_bullet.pictures.raster import Body, Camera, Caster, Color, fit_camera
from soma_bullet.pictures.shade import Look, render
from soma_bullet.pictures.shapes import ELEVATION, arrow, assembly_size, best_azimuth, piece_body, plate
from soma_bullet.pictures.sheet import DPI, INK, QUIET, Sheet, format_of
from soma_bullet.pictures.still import ARROW
from soma_bullet.planner.assembly_plan import AssemblyPlan

STEP = 0.02  # of the assembly's size by which a piece is moved at a time
FARTHEST = 8.0  # of the assembly's size: a piece is moved no farther
APART = 0.16  # of the assembly's size that pieces keep from each other
DASH = 0.022  # of the assembly's size: a dash, and the gap after it
PLATE: Color = (0.88, 0.88, 0.87)
LINE: Color = (0.36, 0.37, 0.42)
WIDTH, HEIGHT = 7.5, 6.0  # [in]
BORDER = 8  # [pixels] that stay free at the sheet's edge
BADGE = (0.22, 0.1, 0.085)  # [in] height of a label, its fixed width, its width a letter


def draw_exploded(assembly: Assembly, plan: AssemblyPlan, path: Path | str) -> Path:
    """Draw the exploded view of the plan's order into a PNG, SVG or PDF.

    Raises:
        InputError: the ending of `path` is none of these.
    """
    format_of(path)  # a wrong ending is said before the work
    order = [assembly.index(step.piece) for step in plan.steps]
    shifts = explode(assembly, order, np.array([step.direction for step in plan.steps]))
    pieces = tuple(piece_body(assembly, k, shift) for k, shift in zip(order, shifts, strict=True))
    size = assembly_size(assembly)
    ways = [body for k, shift in zip(order, shifts, strict=True) for body in _way(assembly, k, shift, size)]
    bodies = (*pieces, *ways, _support(assembly, size))
    azimuth = best_azimuth(
        (*pieces, *ways), np.array([s / np.linalg.norm(s) for s in shifts if s.any()]).reshape(-1, 3)
    )
    points = np.concatenate([body.triangles.reshape(-1, 3) for body in bodies])
    camera = fit_camera(points, azimuth, ELEVATION, round(WIDTH * DPI), round(HEIGHT * DPI), 0.06)
    sheet = Sheet(WIDTH, HEIGHT)
    sheet.image(render(bodies, camera, look=Look(samples=2, line=1.8, smoothing=(1, 5))), 0, 0, "exploded")
    names = [f"{number + 1}  {assembly.names[k]}" for number, k in enumerate(order)]
    for k, name, place in zip(order, names, place_labels(bodies, names, camera), strict=True):
        _draw_label(sheet, name, assembly.pieces[k].color, place)
    return sheet.save(path)


def explode(assembly: Assembly, order: list[int], directions: Array) -> list[Array]:
    """Shifts (3,) [m] of the pieces in assembly order, each against its unit assembly direction of (n, 3).

    The first stays where it is. Every other goes back until it is clear of all before it, and at least as far
    as those before it that come the same way; but never below the support."""
    size = assembly_size(assembly)
    bounds = [_bounds(assembly, k) for k in order]
    shifts = [np.zeros(3)]
    for k in range(1, len(order)):
        lowest = float(bounds[k][0][:, 2].min()) - assembly.support.height
        placed = [(low + s, high + s) for (low, high), s in zip(bounds[:k], shifts, strict=True)]
        same = [float(np.linalg.norm(shifts[j])) for j in range(k) if directions[j] @ directions[k] > 0.99]
        far = max([APART * size, *same])
        rise = float(directions[k][2])
        limit = max(lowest, 0.0) / rise if rise > 1e-6 else FARTHEST * size
        while far < limit:
            shift = -directions[k] * far
            if (
                min(_gap((bounds[k][0] + shift, bounds[k][1] + shift), other) for other in placed)
                > APART * size
            ):
                break
            far += STEP * size
        far = min(far, limit)
        shifts.append(-directions[k] * far)
    return shifts


def _bounds(assembly: Assembly, piece: int) -> tuple[Array, Array]:
    """Low and high corners (p, 3) [m] of the boxes about a piece's convex parts at its goal."""
    parts = assembly.goal_parts[piece]
    return np.array([part.vertices.min(axis=0) for part in parts]), np.array(
        [part.vertices.max(axis=0) for part in parts]
    )


def _gap(a: tuple[Array, Array], b: tuple[Array, Array]) -> float:
    """Smallest gap [m] between any box of one set and any of another; negative where two overlap."""
    between = np.maximum(a[0][:, None] - b[1][None], b[0][None] - a[1][:, None])
    return float(between.max(axis=2).min())


def _way(assembly: Assembly, piece: int, shift: Array, size: float) -> list[Body]:
    """The dashed line of a piece's centre on its way in, and an arrow where it leaves the piece."""
    far = float(np.linalg.norm(shift))
    if far == 0.0:
        return []
    goal, direction = assembly.goal_centres[piece], -shift / far
    corners = np.vstack([part.vertices for part in assembly.goal_parts[piece]])
    front = goal + shift + direction * float((corners @ direction).max() - goal @ direction)
    pointer = arrow(front + 0.01 * size * direction, front + 0.13 * size * direction, 0.011 * size, ARROW)
    dashes = []
    for start in np.arange(0.15 * size, far, 2 * DASH * size):
        ends = front + np.array((start, min(start + DASH * size, far)))[:, None] * direction
        if np.linalg.norm(ends[1] - ends[0]) > 1e-6:
            dashes.append(trimesh.creation.cylinder(0.0035 * size, segment=ends, sections=12).triangles)
    return [pointer, *([Body(np.concatenate(dashes), LINE)] if dashes else [])]


def _support(assembly: Assembly, size: float) -> Body:
    """The support plane about the footprint of the finished assembly."""
    corners = np.vstack([part.vertices for parts in assembly.goal_parts for part in parts])[:, :2]
    border = 0.22 * size
    return plate(
        corners.min(axis=0) - border,
        corners.max(axis=0) + border,
        assembly.support.height,
        0.03 * size,
        PLATE,
    )


@dataclass(frozen=True)
class Place:
    """Where a label goes [in]: left, top, width, and the point of the piece that it names."""

    left: float
    top: float
    width: float
    anchor: tuple[float, float]


def place_labels(bodies: tuple[Body, ...], names: list[str], camera: Camera) -> list[Place]:
    """Places of the names of the first bodies: close to each, and over as little as can be of the others and
    of each other."""
    hits = Caster(bodies).first(camera.eye, camera.rays(1).reshape(-1, 3))
    seen = hits.body.reshape(camera.height, camera.width)
    taken = seen >= 0
    places = []
    for k, name in enumerate(names):
        rows, columns = np.nonzero(seen == k)
        if not len(rows):  # hidden: named where its middle would be
            column, row = camera.project(bodies[k].triangles.reshape(-1, 3).mean(axis=0))
            rows, columns = np.array([row]), np.array([column])
        width = BADGE[1] + BADGE[2] * len(name)
        size = (round(width * DPI), round(BADGE[0] * DPI))
        middle = np.array((columns.mean(), rows.mean()))
        nearest = int(np.argmin((columns - middle[0]) ** 2 + (rows - middle[1]) ** 2))
        anchor = (float(columns[nearest]), float(rows[nearest]))
        left, top = _free_place(taken, middle, np.array((np.ptp(columns), np.ptp(rows))), size)
        taken[max(top - 6, 0) : top + size[1] + 6, max(left - 6, 0) : left + size[0] + 6] = True
        places.append(Place(left / DPI, top / DPI, width, (anchor[0] / DPI, anchor[1] / DPI)))
    return places


def _free_place(taken: Mask, middle: Array, extent: Array, size: tuple[int, int]) -> tuple[int, int]:
    """Left and top [pixels] of a label of `size` beside what is seen about `middle` over `extent` (2,); it
    covers little."""
    height, width = taken.shape
    corner = middle - np.array(size) / 2
    room = (width - size[0] - BORDER, height - size[1] - BORDER)
    best, least = (int(np.clip(corner[0], BORDER, room[0])), int(np.clip(corner[1], BORDER, room[1]))), np.inf
    for grow in (1.06, 1.3, 1.6):
        for angle in np.arange(0, 2 * np.pi, np.pi / 12):
            ray = np.array((np.cos(angle), np.sin(angle)))
            offset = ray * grow / np.max(np.abs(ray) / (extent + size) * 2)
            left, top = (int(value) for value in np.round(corner + offset))
            if not (BORDER <= left <= room[0] and BORDER <= top <= room[1]):
                continue
            covered = float(taken[top : top + size[1], left : left + size[0]].mean())
            cost = 60 * covered + 6 * float(np.linalg.norm(offset)) / width
            if cost < least - 1e-9:
                best, least = (left, top), cost
    return best


def _draw_label(sheet: Sheet, name: str, color: Color, place: Place) -> None:
    """A label with a line to its piece."""
    middle = (place.left + place.width / 2, place.top + BADGE[0] / 2)
    sheet.line([middle, place.anchor], QUIET, 0.8)
    sheet.dot(*place.anchor, INK)
    sheet.box(
        place.left,
        place.top,
        place.width,
        BADGE[0],
        edge=color,
        fill=(1.0, 1.0, 1.0),
        line=1.4,
        radius=0.06,
        above=True,
    )
    sheet.text(*middle, name, 9, INK, bold=True, align="center")
