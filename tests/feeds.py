"""Feeds laid out by hand: which piece lies in which resting pose, where, and how it is turned."""

from __future__ import annotations

from collections.abc import Mapping
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
    hands, whole = workcell.cell.hands, workcell.assembly
    counted = [
        (len(serving_grasps(whole, plan, hands, piece, rest)), rest)
        for rest in steady_poses(workcell.body(piece))
    ]
    return sorted(counted, key=lambda item: -item[0])


def laid(
    workcell: Workcell,
    plan: AssemblyPlan,
    pieces: Mapping[str, Lies],
    noise: tuple[float, float] = (0.0, 0.0),
) -> Feed:
    """The feed in which all pieces lie as they are told to; `noise` as in `Feed`."""
    poses, needed = [], 0
    for name in workcell.assembly.names:
        lies = pieces[name]
        count, rest = serving(workcell, plan, name)[lies.serving]
        turn = rotation_about((0, 0, 1), np.deg2rad(lies.yaw))
        poses.append(make_transform(turn, (lies.x, lies.y, 0.0)) @ rest)
        needed += not count
    return Feed(workcell.assembly.names, readonly(np.array(poses)), 0, needed, 0, noise)


# --- soma3: Z, which is held, then BigL, which is held, then smallL -----------------------------------------

# all in their best poses, the first two on either side of the stand: one arm fetches while the other builds
APART = {"Z": Lies(0.12, 0.25, 20), "BigL": Lies(-0.12, -0.25, 70), "smallL": Lies(0.15, -0.22, -30)}
# likewise, but the first two not in their best poses
ASKEW = {"Z": Lies(0.12, 0.2, -15, 2), "BigL": Lies(0.02, -0.28, 40, 1), "smallL": Lies(-0.15, 0.25, 60)}
# no grasp of BigL serves both where it lies and at its goal, and one arm alone can fetch it, while Z is held
UNSERVED = {**APART, "BigL": Lies(-0.12, -0.25, 0, -1)}
# hardly any grasp of Z serves at both, and a hand that comes by these leaves BigL no room
CROWDED = {"Z": Lies(-0.2, 0.25, 35, -1), "BigL": Lies(0.05, -0.23, -125), "smallL": Lies(-0.22, -0.26, 30)}
# where Z may not be handed over, BigL can be brought from few places, and smallL lies badly
AWKWARD = {
    "Z": Lies(-0.17, -0.17, 170, 1),
    "BigL": Lies(-0.01, 0.22, -65, 3),
    "smallL": Lies(0.12, 0.32, 55, -1),
}

# --- soma4 --------------------------------------------------------------------------------------------------

# no grasp of the first piece serves both where it lies and at its goal, and both hands are free
UNSERVED_FIRST = {
    "V": Lies(0.1, 0.25, 0, -1),
    "Z": Lies(-0.15, 0.25),
    "A": Lies(0.15, -0.25),
    "L": Lies(-0.15, -0.25),
}
