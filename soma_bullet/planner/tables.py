"""Grasps of a plan as transforms."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from soma_bullet.frames import Array, from_quat_xyzw, readonly
from soma_bullet.planner.assembly_plan import AssemblyPlan, GraspTable


def grasp_poses(plan: AssemblyPlan, piece: str) -> tuple[Array, Array]:
    """T_piece_tcp (n, 4, 4) and widths (n,) [m] of a piece's grasp table."""
    table = grasp_table(plan, piece)
    return table_poses(table), table.widths


def grasp_table(plan: AssemblyPlan, piece: str) -> GraspTable:
    """A piece's grasp table."""
    return next(table for table in plan.grasps if table.piece == piece)


@lru_cache(maxsize=64)
def table_poses(table: GraspTable) -> Array:
    """T_piece_tcp (n, 4, 4) of a grasp table."""
    return readonly(np.array([from_quat_xyzw(row[:3], row[3:]) for row in table.poses]).reshape(-1, 4, 4))
