"""Where the pieces lie before they are picked: each in a steady resting pose, anywhere in the feed areas, at
any yaw."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import shapely

from soma_bullet.assembly.model import Assembly
from soma_bullet.assembly.resting import steady_poses
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.errors import NoSolutionError
from soma_bullet.frames import Array, apply, make_transform, readonly, rotation_about
from soma_bullet.grasp.clearance import SUPPORT_MARGIN, sweep_hands
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.tables import grasp_poses, grasp_table
from soma_bullet.robot.model import Cell
from soma_bullet.seeds import stream
from soma_bullet.sizes import Sizes
from soma_bullet.task.feed_options import SIGMAS, FeedOptions

DRAWS = 10_000


@dataclass(frozen=True, eq=False)
class Feed:
    """The pieces at the start.

    Attributes:
        names: of the pieces.
        poses: T_world_piece (n, 4, 4).
        overlaps: draws rejected because two pieces would overlap.
        regrasps_needed: pieces that lie so that no grasp serves both there and at the goal.
        seed: of the draw.
        noise: one sigma of what the poses may be off by: in x and y [mm], in yaw [deg]; SIGMAS times that is
            made room for.
        square: whether pieces are squared where there is noise.
    """

    names: tuple[str, ...]
    poses: Array
    overlaps: int
    regrasps_needed: int
    seed: int
    noise: tuple[float, float] = (0.0, 0.0)
    square: bool = True

    def pose(self, name: str) -> Array:
        """T_world_piece (4, 4) of one piece."""
        return self.poses[self.names.index(name)]

    @property
    def rejected(self) -> float:
        """Fraction of the draws that were rejected."""
        return self.overlaps / (len(self.names) + self.overlaps)

    def off(self, piece: Workpiece) -> float:
        """How far any point of a piece may be from where it seems to be, along the table [m]: SIGMAS times
        the noise."""
        return SIGMAS * (self.noise[0] * 1e-3 + np.deg2rad(self.noise[1]) * piece.radius)


def serving_grasps(
    assembly: Assembly, plan: AssemblyPlan, hands: HandSet, name: str, T_plane_piece: Array
) -> Array:
    """Indices of the grasps of a piece that serve at its goal (and while it is held) and with the piece
    resting on a plane."""
    step = next(step for step in plan.steps if step.piece == name)
    indices = set(step.grasps)
    for hold in step.holds:
        if hold.piece == name:
            indices &= set(hold.grasps)
    candidates = np.array(sorted(indices), int)
    poses, widths = grasp_poses(plan, name)
    kinds = grasp_table(plan, name).kinds[candidates]
    sweep = sweep_hands(hands, kinds, T_plane_piece @ poses[candidates], widths[candidates])
    return candidates[sweep.above(0.0) > SUPPORT_MARGIN]


def preferred_resting_pose(assembly: Assembly, plan: AssemblyPlan, hands: HandSet, name: str) -> Array:
    """T_plane_piece (4, 4) of the steady resting pose with the most grasps that also serve at the goal.

    Raises:
        NoSolutionError: the piece has no resting pose.
    """
    poses = _resting(assembly, name)
    return poses[int(np.argmax([len(serving_grasps(assembly, plan, hands, name, pose)) for pose in poses]))]


def _resting(assembly: Assembly, name: str) -> Array:
    poses = steady_poses(assembly.pieces[assembly.index(name)])
    if not len(poses):
        raise NoSolutionError("schedule", f"{name} has no resting pose on a table")
    return poses


def draw_feed(
    assembly: Assembly, plan: AssemblyPlan, cell: Cell, seed: int, options: FeedOptions | None = None
) -> Feed:
    """A steady resting pose of each piece, at uniform places over the whole feed areas and uniform yaw, or in
    rows.

    Raises:
        NoSolutionError: the pieces do not fit, or one has no resting pose.
    """
    options = options or FeedOptions()
    apart = Sizes.of([piece.radius for piece in assembly.pieces]).apart
    hands = cell.hands
    if options.layout == "rows":
        return _rows(assembly, plan, cell, seed, options)
    rng = stream(seed, "feed")
    areas = cell.feed_areas
    sizes = np.prod(areas[:, :, 1] - areas[:, :, 0], axis=1)
    outlines: list[shapely.Geometry] = []
    poses, overlaps, needed = [], 0, 0
    for name in assembly.names:
        if options.poses == "preferred":
            rest = preferred_resting_pose(assembly, plan, hands, name)
        else:
            resting = _resting(assembly, name)
            rest = resting[rng.integers(len(resting))]
        needed += not len(serving_grasps(assembly, plan, hands, name, rest))
        piece = assembly.pieces[assembly.index(name)]
        while True:
            area = areas[rng.choice(len(areas), p=sizes / sizes.sum())]
            place = rng.uniform(area[:, 0], area[:, 1])
            pose = make_transform(rotation_about((0, 0, 1), rng.uniform(-np.pi, np.pi)), (*place, 0.0)) @ rest
            outline = shapely.multipoints(apply(pose, piece.vertices)[:, :2]).convex_hull
            if all(outline.distance(other) >= apart for other in outlines):
                break
            overlaps += 1
            if overlaps > DRAWS:
                raise NoSolutionError(
                    "schedule", f"{name} does not fit into the feed areas beside the other pieces"
                )
        outlines.append(outline)
        poses.append(pose)
    return Feed(
        assembly.names, readonly(np.array(poses)), overlaps, needed, seed, options.noise, options.square
    )


def _rows(assembly: Assembly, plan: AssemblyPlan, cell: Cell, seed: int, options: FeedOptions) -> Feed:
    """The pieces in the order of the plan, spread evenly over the feed areas in turn."""
    hands, areas = cell.hands, cell.feed_areas
    poses = {}
    for k, name in enumerate(plan.order):
        area = areas[k % len(areas)]
        column, columns = k // len(areas), -(-len(plan.order) // len(areas))
        place = (area[0, 0] + (column + 0.5) / columns * (area[0, 1] - area[0, 0]), area[1].mean(), 0.0)
        poses[name] = make_transform(translation=place) @ preferred_resting_pose(assembly, plan, hands, name)
    placed = readonly(np.array([poses[name] for name in assembly.names]))
    needed = sum(
        not len(serving_grasps(assembly, plan, hands, *item))
        for item in zip(assembly.names, placed, strict=True)
    )
    return Feed(assembly.names, placed, 0, needed, seed, options.noise, options.square)


def misplace(
    assembly: Assembly, feed: Feed, options: FeedOptions, seed: int, look: int | None = None
) -> Feed:
    """Where the pieces really lie when `feed` is what was perceived, or the other way round: each turned
    about its centre of mass and shifted.

    Args:
        look: number of a later look, which errs anew; None for the first.
    """
    if options.noise_mm == 0.0 and options.noise_deg == 0.0:
        return feed
    rng = stream(seed, "errors") if look is None else stream(seed, "look", look)
    draw = _uniform if options.errors == "uniform" else _normal
    poses = np.array(feed.poses)
    for piece, pose in zip(assembly.pieces, poses, strict=True):
        yaw, shift = draw(rng, options.noise_mm * 1e-3, options.noise_deg)
        turn = rotation_about((0, 0, 1), np.deg2rad(yaw))
        centre = apply(pose, piece.center_of_mass)
        pose[:3, :3] = turn @ pose[:3, :3]
        pose[:3, 3] = centre + turn @ (pose[:3, 3] - centre)
        pose[:2, 3] += shift
    return replace(feed, poses=readonly(poses))


def _normal(rng: np.random.Generator, length: float, angle: float) -> tuple[float, Array]:
    """Yaw [deg] and shift (2,) [m] of the given sigmas."""
    return rng.normal(0.0, angle), rng.normal(0.0, length, 2)


def _uniform(rng: np.random.Generator, length: float, angle: float) -> tuple[float, Array]:
    """Yaw [deg] within +-angle and shift (2,) [m] in a disc of radius `length`."""
    yaw, towards = rng.uniform(-angle, angle), rng.uniform(-np.pi, np.pi)
    return yaw, length * np.sqrt(rng.uniform()) * np.array((np.cos(towards), np.sin(towards)))
