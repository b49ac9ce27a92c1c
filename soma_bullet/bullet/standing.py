"""Does a placed set stand by itself? Its pieces alone on the stand, in the physics of an episode, with no
robot in sight."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from soma_bullet.assembly.model import Assembly
from soma_bullet.bullet.quiet import pybullet as p
from soma_bullet.bullet.stage import Stage
from soma_bullet.frames import Array, apply, make_transform, readonly, rotation_angle, translate
from soma_bullet.frames import from_quat_xyzw as transform_of
from soma_bullet.robot.model import Cell
from soma_bullet.world.options import Physics

SECONDS = 2.0  # [s] that a set is watched
FALLEN_MM = 5.0  # [mm] a quarter of a Soma cell; leaning until gaps of 0.2 mm close stays well below
FALLEN_DEG = 10.0  # [deg]
WIDE = (0.8, 0.8)  # [m] footprint of a stand from which nothing tumbles down


@dataclass(frozen=True)
class Standing:
    """How far the pieces of a placed set moved from where they were put down.

    Attributes:
        names: of the placed pieces.
        moved_mm: displacement of each piece's centre of mass [mm].
        turned_deg: rotation of each piece [deg].
        fell: whether a piece moved by more than FALLEN_MM or turned by more than FALLEN_DEG.
    """

    names: tuple[str, ...]
    moved_mm: tuple[float, ...]
    turned_deg: tuple[float, ...]

    @property
    def fell(self) -> bool:
        return max(self.moved_mm) > FALLEN_MM or max(self.turned_deg) > FALLEN_DEG


def stands(
    assembly: Assembly,
    placed: Iterable[int],
    cell: Cell,
    physics: Physics | None = None,
    seconds: float = SECONDS,
) -> Standing:
    """Put the placed pieces down where they settle, let time run, and measure how far they got.

    Args:
        placed: indices of the pieces; the others are not there.
        cell: whose table and stand carry them; its robot is left out.
        seconds: simulated time [s].
    """
    chosen = sorted(placed)
    alone = replace(
        assembly, pieces=tuple(assembly.pieces[k] for k in chosen), goals=readonly(assembly.goals[chosen])
    )
    # drops are those of the placed set: a piece that is not there carries nothing
    starts = [translate(goal, (0, 0, -drop)) for goal, drop in zip(alone.goals, alone.drops, strict=True)]
    middle = np.mean(alone.goal_centres[:, :2], axis=0)
    T_world_assembly = make_transform(
        translation=(*(cell.stand_centre - middle), cell.stand_height - assembly.support.height)
    )
    poses = {piece.name: T_world_assembly @ start for piece, start in zip(alone.pieces, starts, strict=True)}
    bench = _Bench(cell, alone, poses, physics or Physics())
    try:
        bench.run(seconds)
        ends = bench.piece_poses()
    finally:
        bench.close()
    moved = [
        np.linalg.norm(apply(ends[q.name], q.center_of_mass) - apply(poses[q.name], q.center_of_mass))
        for q in alone.pieces
    ]
    turned = [rotation_angle(poses[name][:3, :3], ends[name][:3, :3]) for name in alone.names]
    return Standing(
        alone.names,
        tuple(float(m) * 1e3 for m in moved),
        tuple(float(np.rad2deg(t)) for t in turned),
    )


class _Bench(Stage):
    """A stage without a robot, whose clock runs."""

    def __init__(self, cell: Cell, assembly: Assembly, poses: dict[str, Array], physics: Physics):
        super().__init__(cell, assembly, WIDE, poses, (), physics)

    def _load_robot(self, folder: Path, stand: tuple[float, float]) -> None:
        pass

    def _couple_fingers(self) -> None:
        pass

    def _place_robot(self, home: Sequence[Array]) -> None:
        pass

    def run(self, seconds: float) -> None:
        """Let time pass [s]."""
        for _ in range(round(seconds / self.time_step)):
            p.stepSimulation(physicsClientId=self.client)

    def piece_poses(self) -> dict[str, Array]:
        """T_world_piece (4, 4) of every piece."""
        poses = {}
        for name, body in self.pieces.items():
            position, quat_xyzw = p.getBasePositionAndOrientation(body, physicsClientId=self.client)
            poses[name] = transform_of(position, quat_xyzw) @ self.T_inertial_piece[name]
        return poses
