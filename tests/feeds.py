"""Feeds laid out by hand: which piece lies in which resting pose, where, and how it is turned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from soma_bullet.assembly.resting import steady_poses
from soma_bullet.frames import Array, make_transform, readonly, rotation_about
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.task.feed import Feed, serving_grasps
from soma_bullet.task.workcell import Workcell


@dataclass(frozen=True)
class Lies:
    """How a piece lies.

    Attributes:
        x, y: of its centre of mass [m]; yaw: [deg].
        serving: rank of its resting pose among all of the piece, by how many of its grasps serve both there
            and at the goal: 0 has the most, -1 the fewest.
    """

    x: float
    y: float
    yaw: float = 0.0
    serving: int = 0


def serving(workcell: Workcell, plan: AssemblyPlan, piece: str) -> list[tuple[int, Array]]:
    """T_table_piece (4, 4) of the resting poses of a piece, each with how many grasps serve there and at the
    goal, most first."""
    hand, whole = workcell.hand(0), workcell.assembly
    counted = [
        (len(serving_grasps(whole, plan, hand, piece, rest)), rest)
        for rest in steady_poses(workcell.body(piece))
    ]
    return sorted(counted, key=lambda item: -item[0])


def laid(workcell: Workcell, plan: AssemblyPlan, **pieces: Lies) -> Feed:
    """The feed in which all pieces lie as they are told to."""
    poses, needed = [], 0
    for name in workcell.assembly.names:
        lies = pieces[name]
        count, rest = serving(workcell, plan, name)[lies.serving]
        turn = rotation_about((0, 0, 1), np.deg2rad(lies.yaw))
        poses.append(make_transform(turn, (lies.x, lies.y, 0.0)) @ rest)
        needed += not count
    return Feed(workcell.assembly.names, readonly(np.array(poses)), 0, needed, 0)
