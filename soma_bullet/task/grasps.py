"""Grasps of a plan as transforms."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from soma_bullet.frames import Array, from_quat_xyzw, readonly
from soma_bullet.planner.assembly_plan import AssemblyPlan, GraspTable


def grasp_poses(plan: AssemblyPlan, piece: str) -> tuple[Array, Array]:
    """T_piece_tcp (n, 4, 4) and widths (n,) [m] of a piece's grasp table."""
    table = next(table for table in plan.grasps if table.piece == piece)
    return _transforms(table), table.widths


@lru_cache(maxsize=64)
def _transforms(table: GraspTable) -> Array:
    return readonly(np.array([from_quat_xyzw(row[:3], row[3:]) for row in table.poses]).reshape(-1, 4, 4))
