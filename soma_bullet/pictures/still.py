"""Stills of the steps of an order: what stands, how the next piece is gripped, what is held, which way the
piece goes in."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import Array, Indices
from soma_bullet.pictures.raster import Body, Camera, Color, Pixels, fit_camera
from soma_bullet.pictures.shade import faded, render
from soma_bullet.pictures.shapes import (
    ELEVATION,
    arrow,
    assembly_size,
    best_azimuth,
    hand_body,
    piece_body,
    spread_grasps,
)
from soma_bullet.planner.orders import OrderRow
from soma_bullet.planner.qualities import Qualities

View = Literal["state", "hands", "way"]
GROUPS = ("stability", "graspability", "assisting", "assemblability")
GREEN: Color = (0.16, 0.66, 0.32)
RED: Color = (0.86, 0.20, 0.18)
ARROW: Color = (0.95, 0.18, 0.15)
VIEWS: tuple[View, ...] = ("state", "hands", "way")
GLASS = 0.5  # alpha of a hand
HANDS = 4  # drawn of all the grasps of a piece
REACH = 0.32  # of the assembly's size that is drawn of a hand
PULL = 0.5  # a piece is drawn this fraction of its own size before its goal


@dataclass(frozen=True)
class Scene:
    """What one still shows; scenes with the same key show the same."""

    key: Hashable
    bodies: tuple[Body, ...]
    view: View


@dataclass
class StepStills:
    """Stills of one assembly and its hands, all from one side; those that orders share are rendered once.

    Attributes:
        width, height: of a still [pixels].
        azimuth: of all cameras [rad].
        cameras: one a view; it frames all scenes of its view.
    """

    assembly: Assembly
    qualities: Qualities
    width: int
    height: int
    azimuth: float = 0.0
    cameras: dict[View, Camera] = field(default_factory=dict)
    _images: dict[Hashable, Pixels] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.size = assembly_size(self.assembly)

    def frame(self, rows: tuple[OrderRow, ...]) -> list[dict[str, list[Scene]]]:
        """The scenes of the rows, one list a group, and the cameras that show them all."""
        everything = tuple(piece_body(self.assembly, k) for k in range(len(self.assembly.pieces)))
        ways = np.array([d for row in rows for d in row.directions if d is not None]).reshape(-1, 3)
        self.azimuth = best_azimuth(everything, ways if len(ways) else None)
        scenes = [self._scenes(row) for row in rows]
        if not any(held for row in rows for held in row.held):  # nothing to leave room for
            for groups in scenes:
                groups["assisting"] = list(groups["stability"])
        flat = [scene for groups in scenes for group in groups.values() for scene in group]
        for view in VIEWS:
            points = np.concatenate([_corners(scene.bodies) for scene in flat if scene.view == view])
            self.cameras[view] = fit_camera(points, self.azimuth, ELEVATION, self.width, self.height, 0.04)
        return scenes

    def image(self, scene: Scene, feasible: bool = True) -> Pixels:
        """The still of a scene on a transparent background; pale grey where the order cannot be built."""
        if scene.key not in self._images:
            self._images[scene.key] = render(
                scene.bodies, self.cameras[scene.view], self.assembly.support.height
            )
        image = self._images[scene.key]
        return image if feasible else faded(image)

    def _scenes(self, row: OrderRow) -> dict[str, list[Scene]]:
        order = [self.assembly.index(name) for name in row.order]
        groups: dict[str, list[Scene]] = {name: [] for name in GROUPS}
        for k, piece in enumerate(order):
            before, placed = frozenset(order[:k]), frozenset(order[: k + 1])
            held = frozenset(self.assembly.index(name) for name in row.held[k])
            upcoming = order[k + 1] if k + 1 < len(order) else None
            groups["stability"].append(Scene(("stands", placed), self._pieces(placed), "state"))
            groups["graspability"].append(self._gripped(piece, before))
            groups["assisting"].append(
                self._held(placed, held, upcoming, None if upcoming is None else row.directions[k + 1])
            )
            groups["assemblability"].append(self._going_in(piece, before, row.directions[k]))
        return groups

    def _pieces(self, placed: frozenset[int]) -> tuple[Body, ...]:
        return tuple(piece_body(self.assembly, k) for k in sorted(placed))

    def _hands(self, piece: int, grasps: Indices, color: Color, count: int) -> list[Body]:
        table, kinds = self.qualities.grasps(piece), self.qualities.hands.kinds
        Ts = self.assembly.goals[piece] @ table.Ts_piece_tcp[grasps]
        to_camera = np.array((np.cos(self.azimuth), np.sin(self.azimuth), np.tan(ELEVATION))) * np.cos(
            ELEVATION
        )
        reach = REACH * self.size
        return [
            hand_body(kinds[table.kinds[k]], Ts[i], float(table.widths[k]), color, GLASS, reach)
            for i, k in ((i, grasps[i]) for i in spread_grasps(Ts, count, to_camera))
        ]

    def _gripped(self, piece: int, before: frozenset[int]) -> Scene:
        hands = self._hands(piece, self.qualities.candidates(piece, before), GREEN, HANDS)
        return Scene(("gripped", piece, before), (*self._pieces(before | {piece}), *hands), "hands")

    def _held(
        self,
        placed: frozenset[int],
        held: frozenset[int],
        upcoming: int | None,
        direction: tuple[float, ...] | None,
    ) -> Scene:
        hands: list[Body] = []
        for piece in sorted(held):
            way = None if direction is None else np.array(direction)
            grasps = self.qualities.assisting(piece, placed, upcoming, way)
            hands += self._hands(piece, grasps, RED, max(1, HANDS // len(held)))
        return Scene(("held", placed, held, upcoming, direction), (*self._pieces(placed), *hands), "hands")

    def _going_in(self, piece: int, before: frozenset[int], direction: tuple[float, ...] | None) -> Scene:
        if direction is None:
            return Scene(("stays out", before, piece), self._pieces(before | {piece}), "way")
        way = np.array(direction)
        corners = _corners((piece_body(self.assembly, piece),))
        pull = -PULL * float(np.ptp(corners @ way)) * way
        centre = (corners.min(axis=0) + corners.max(axis=0)) / 2 + pull
        back, front = centre - 0.16 * self.size * way, centre + 0.26 * self.size * way
        pointer = arrow(back, front, 0.02 * self.size, ARROW, on_top=True)
        bodies = (*self._pieces(before), piece_body(self.assembly, piece, pull), pointer)
        return Scene(("goes in", piece, before, direction), bodies, "way")


def _corners(bodies: tuple[Body, ...]) -> Array:
    return np.concatenate([b.triangles.reshape(-1, 3) for b in bodies])
