"""The assembly in the cell: where it stands, what its settled goals are, and scenes of who is where."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import cached_property

import numpy as np

from soma_bullet.assembly.contacts import SUPPORT
from soma_bullet.assembly.model import Assembly
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.errors import InputError
from soma_bullet.frames import Array, inverse, make_transform, readonly, rotation_angle
from soma_bullet.grasp.hand import Hand
from soma_bullet.robot.collision import CollisionModel, Scene, Situation
from soma_bullet.robot.kinematics import Robot
from soma_bullet.robot.model import Cell
from soma_bullet.task.state import CellState

STAND = "stand"
# [m], [rad] a piece in place that is off by less counts as where it should be
OFF, TURNED = 2e-3, np.deg2rad(2.0)
HEAD_ON = 0.5  # cosine between a direction and what stops a motion along it


def footprint(assembly: Assembly) -> tuple[Array, Array]:
    """Low and high corner (2,) [m] of the assembly's contact with its support, in the assembly frame."""
    feet = np.vstack([c.points[:, :2] for c in assembly.contacts if c.body_a == SUPPORT])
    return feet.min(axis=0), feet.max(axis=0)


def stand_size(assembly: Assembly) -> tuple[float, float]:
    """Footprint of the stand [m]: the assembly's, with a rim."""
    low, high = footprint(assembly)
    size = np.maximum(high - low + 2 * assembly.sizes.rim, assembly.sizes.smallest_stand)
    return float(size[0]), float(size[1])


def assembly_frame(assembly: Assembly, cell: Cell) -> Array:
    """T_world_assembly (4, 4): the middle of the footprint on the middle of the stand's top, axes parallel to
    the world's."""
    low, high = footprint(assembly)
    middle = (low + high) / 2
    return make_transform(
        translation=(*(cell.stand_centre - middle), cell.stand_height - assembly.support.height)
    )


class Workcell:
    """One assembly in one cell: robot, collision model, and goals in the world."""

    def __init__(self, assembly: Assembly, cell: Cell):
        self.assembly, self.cell = assembly, cell
        self.robot = Robot(cell, stand_size(assembly))
        clashes = sorted(set(assembly.names) & {frame.name for frame in self.robot.model.frames})
        if clashes:
            raise InputError(
                assembly.name,
                [f"piece {name!r} is called like a part of the cell {cell.name}" for name in clashes],
            )
        self.collision = CollisionModel(
            self.robot, {piece.name: piece.body_parts for piece in assembly.pieces}
        )
        self.T_world_assembly = readonly(assembly_frame(assembly, cell))
        self.sizes = assembly.sizes

    @cached_property
    def goals(self) -> dict[str, Array]:
        """Nominal T_world_piece of every piece."""
        return {
            name: self.T_world_assembly @ goal
            for name, goal in zip(self.assembly.names, self.assembly.goals, strict=True)
        }

    @cached_property
    def settled(self) -> dict[str, Array]:
        """T_world_piece of every piece where it settles: the goal less its drop."""
        lowered = {}
        for name, drop in zip(self.assembly.names, self.assembly.drops, strict=True):
            pose = self.goals[name].copy()
            pose[2, 3] -= drop
            lowered[name] = pose
        return lowered

    def stands(self, piece: str, pose: Array) -> Array:
        """T_world_piece (4, 4) of a piece in place for what comes after it: where it should be, unless it was
        found far off."""
        settled = self.settled[piece]
        off = float(np.linalg.norm(pose[:3, 3] - settled[:3, 3]))
        return settled if off < OFF and rotation_angle(pose[:3, :3], settled[:3, :3]) < TURNED else pose

    @cached_property
    def touching(self) -> frozenset[frozenset[str]]:
        """Pairs of bodies that touch in the finished assembly, also along an edge or at a corner."""
        name = lambda k: STAND if k == SUPPORT else self.assembly.names[k]  # noqa: E731
        return frozenset(frozenset(name(k) for k in pair) for pair in self.assembly.meeting)

    def stopped(self, piece: str, direction: Array, placed: Collection[str]) -> bool:
        """Whether a piece that comes to its goal along a unit vector (3,) meets a placed piece, or the stand,
        head on there."""
        index, along = self.assembly.index(piece), self.T_world_assembly[:3, :3].T @ direction
        there = {SUPPORT, *(self.assembly.index(name) for name in placed)}
        contacts = [c.into(index) for c in self.assembly.contacts if index in (c.body_a, c.body_b)]
        return any(float(c.normal @ along) < -HEAD_ON for c in contacts if c.body_a in there)

    def carries(self, lower: str, upper: str) -> bool:
        """Whether in the finished assembly a piece stands on another."""
        below, above, up = (
            self.assembly.index(lower),
            self.assembly.index(upper),
            self.T_world_assembly[2, :3],
        )
        contacts = [c.into(above) for c in self.assembly.contacts if {c.body_a, c.body_b} == {below, above}]
        return any(float(c.normal @ up) > HEAD_ON for c in contacts)

    def body(self, name: str) -> Workpiece:
        """A piece by its name."""
        return self.assembly.pieces[self.assembly.index(name)]

    def hand(self, arm: int) -> Hand:
        """The hand of an arm."""
        return self.cell.arms[arm].hand

    def idle(self, poses: Mapping[str, Array] | None = None) -> CellState:
        """All arms at home, hands closed and empty, nothing in place, the pieces at T_world_piece (4, 4)."""
        return CellState(poses or {}, tuple(self.robot.home), self.robot.closed)

    def carried(self, state: CellState, arm: int) -> dict[str, Array]:
        """T_tcp_piece (4, 4) of each piece that moves with an arm."""
        if arm not in state.carried:
            return {}
        body = state.gripped[arm]
        T_body = inverse(state.poses[body]) if len(state.members(body)) > 1 else np.eye(4)
        others = {
            piece: state.carried[arm] @ T_body @ state.poses[piece] for piece in state.members(body)[1:]
        }
        return {body: state.carried[arm], **others}

    def scene(
        self,
        state: CellState,
        arm: int,
        touching: frozenset[frozenset[str]] = frozenset(),
        alone: bool = False,
    ) -> Scene:
        """The scene in which one arm moves, with what it carries; the others stand still or (`alone`) are
        left out."""
        carried = {piece: (arm, T) for piece, T in self.carried(state, arm).items()}
        still = {name: pose for name, pose in state.poses.items() if name not in carried}
        absent = frozenset(k for k in range(len(self.cell.arms)) if alone and k != arm)
        gripped: dict[str, int] = {}
        for hand, name in sorted(
            state.gripped.items(), key=lambda item: item[0] == arm
        ):  # the mover's counts
            gripped |= dict.fromkeys(state.members(name), hand)
        return self.collision.scene(Situation(still, frozenset({arm}), carried, gripped, touching, absent))

    def configuration(self, state: CellState, arm: int, q: Array, opening: float | None = None) -> Array:
        """pinocchio's vector with one arm at q."""
        moved = state.with_arm(arm, q, opening)
        return self.robot.configuration(moved.qs, moved.openings)
