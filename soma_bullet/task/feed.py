"""Where the pieces lie before they are picked: a resting pose each, anywhere in the feed areas, at any yaw."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import shapely

from soma_bullet.assembly.model import Assembly
from soma_bullet.assembly.resting import resting_poses
from soma_bullet.errors import NoSolutionError
from soma_bullet.frames import Array, apply, make_transform, readonly, rotation_about
from soma_bullet.grasp.clearance import SUPPORT_MARGIN, sweep_hand
from soma_bullet.grasp.hand import Hand
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.robot.cell import Cell
from soma_bullet.task.grasps import grasp_poses

GAP = 0.010  # [m] between the footprints of two pieces
DRAWS = 10_000


@dataclass(frozen=True)
class FeedOptions:
    """How the pieces are fed.

    Attributes:
        layout: `random` draws places and yaws; `rows` lays the pieces out evenly, without yaw.
        noise_mm, noise_deg: one sigma of what the perceived poses are off by, in x, y [mm] and yaw [deg].
    """

    layout: Literal["random", "rows"] = "random"
    noise_mm: float = 0.0
    noise_deg: float = 0.0


@dataclass(frozen=True, eq=False)
class Feed:
    """The pieces at the start.

    Attributes:
        names: of the pieces.
        poses: T_world_piece (n, 4, 4).
        overlaps: draws rejected because two pieces would overlap.
        graspless: draws rejected because a piece has no grasp that serves both at the feed and at the goal.
        seed: of the draw.
    """

    names: tuple[str, ...]
    poses: Array
    overlaps: int
    graspless: int
    seed: int

    def pose(self, name: str) -> Array:
        """T_world_piece (4, 4) of one piece."""
        return self.poses[self.names.index(name)]

    @property
    def rejected(self) -> float:
        """Fraction of the draws that were rejected."""
        draws = len(self.names) + self.overlaps + self.graspless
        return (self.overlaps + self.graspless) / draws


def serving_grasps(assembly: Assembly, plan: AssemblyPlan, hand: Hand, name: str, T_plane_piece: Array) -> Array:
    """Indices of the grasps of a piece that serve at its goal (and while it is held) and with the piece resting on a plane."""
    step = next(step for step in plan.steps if step.piece == name)
    indices = set(step.grasps)
    for hold in step.holds:
        if hold.piece == name:
            indices &= set(hold.grasps)
    candidates = np.array(sorted(indices), int)
    poses, widths = grasp_poses(plan, name)
    sweep = sweep_hand(hand, T_plane_piece @ poses[candidates], widths[candidates])
    return candidates[sweep.above(0.0) > SUPPORT_MARGIN]


def preferred_resting_pose(assembly: Assembly, plan: AssemblyPlan, hand: Hand, name: str) -> Array:
    """T_plane_piece (4, 4) of the resting pose with the most common grasps.

    Raises:
        NoSolutionError: no resting pose has one.
    """
    poses = resting_poses(assembly.pieces[assembly.index(name)])
    counts = [len(serving_grasps(assembly, plan, hand, name, pose)) for pose in poses]
    if not len(poses) or max(counts) == 0:
        raise NoSolutionError(
            "schedule", f"{name}: none of its {len(poses)} resting poses has a grasp that also serves at the goal"
        )
    return poses[int(np.argmax(counts))]


def draw_feed(assembly: Assembly, plan: AssemblyPlan, cell: Cell, seed: int, options: FeedOptions | None = None) -> Feed:
    """The preferred resting pose of each piece, at uniform places over the whole feed areas and uniform yaw, or in rows.

    Raises:
        NoSolutionError: the pieces do not fit, or one has no common grasp.
    """
    options = options or FeedOptions()
    hand = cell.arms[0].hand
    if options.layout == "rows":
        return _rows(assembly, plan, cell, seed)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0xFEED,)))
    areas = cell.feed_areas
    sizes = np.prod(areas[:, :, 1] - areas[:, :, 0], axis=1)
    outlines: list[shapely.Geometry] = []
    poses, overlaps = [], 0
    for name in assembly.names:
        rest = preferred_resting_pose(assembly, plan, hand, name)
        piece = assembly.pieces[assembly.index(name)]
        while True:
            area = areas[rng.choice(len(areas), p=sizes / sizes.sum())]
            place = rng.uniform(area[:, 0], area[:, 1])
            pose = make_transform(rotation_about((0, 0, 1), rng.uniform(-np.pi, np.pi)), (*place, 0.0)) @ rest
            outline = shapely.multipoints(apply(pose, piece.vertices)[:, :2]).convex_hull
            if all(outline.distance(other) >= GAP for other in outlines):
                break
            overlaps += 1
            if overlaps > DRAWS:
                raise NoSolutionError("schedule", f"{name} does not fit into the feed areas beside the other pieces")
        outlines.append(outline)
        poses.append(pose)
    return Feed(assembly.names, readonly(np.array(poses)), overlaps, 0, seed)


def _rows(assembly: Assembly, plan: AssemblyPlan, cell: Cell, seed: int) -> Feed:
    """The pieces in the order of the plan, spread evenly over the feed areas in turn."""
    hand, areas = cell.arms[0].hand, cell.feed_areas
    poses = {}
    for k, name in enumerate(plan.order):
        area = areas[k % len(areas)]
        column, columns = k // len(areas), -(-len(plan.order) // len(areas))
        place = (area[0, 0] + (column + 0.5) / columns * (area[0, 1] - area[0, 0]), area[1].mean(), 0.0)
        poses[name] = make_transform(translation=place) @ preferred_resting_pose(assembly, plan, hand, name)
    return Feed(assembly.names, readonly(np.array([poses[name] for name in assembly.names])), 0, 0, seed)


def misplace(assembly: Assembly, feed: Feed, options: FeedOptions, seed: int) -> Feed:
    """Where the pieces really lie when `feed` is what was perceived: each turned about its centre of mass and shifted."""
    if options.noise_mm == 0.0 and options.noise_deg == 0.0:
        return feed
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0x0FF,)))
    poses = np.array(feed.poses)
    for piece, pose in zip(assembly.pieces, poses, strict=True):
        turn = rotation_about((0, 0, 1), np.deg2rad(rng.normal(0.0, options.noise_deg)))
        centre = apply(pose, piece.center_of_mass)
        pose[:3, :3] = turn @ pose[:3, :3]
        pose[:3, 3] = centre + turn @ (pose[:3, 3] - centre)
        pose[:2, 3] += rng.normal(0.0, options.noise_mm * 1e-3, 2)
    return replace(feed, poses=readonly(poses))
