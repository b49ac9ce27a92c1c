"""A piece that sits elsewhere in the hand than planned: how far, whether it is certain, and a placing that
makes up for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from soma_bullet.frames import Array, inverse, make_transform, readonly
from soma_bullet.robot.kinematics import Robot
from soma_bullet.task.program.motions import joined
from soma_bullet.task.program.overlap.concurrent import Concurrent
from soma_bullet.task.segment import Segment
from soma_bullet.task.workcell import Workcell

CERTAIN_MM, CERTAIN_DEG = 0.1, 0.2  # [mm], [deg] smaller differences are not worth a correction
# [rad] of each joint by a correction; of more it is a share: the arm's joints, and the last three, the
# wrist's
ARM_CHANGE, WRIST_CHANGE, WRIST = 0.02, 0.12, 3
UTMOST = 5  # times as much where nothing else is left to do
# [deg] that a correction may leave; a piece that has turned farther in the hand is planned with anew
TURNED_DEG = 1.5
# [rad] between joints that reach a place and what the Jacobian of the end says they are: else another branch
ROUNDING = 0.1
SHARES = (1.0, 0.75, 0.5, 0.25, 0.0)  # of a correction, the first of which leaves the arms apart is made
# [m] room between arms that no correction takes away; where less was planned, all but so much of that, or
# half
APART, NEARER = 3e-3, 1e-3
BEND = 0.3  # of a placing, over which its path is bent to where the piece is seen in the hand


@dataclass(frozen=True, eq=False)
class Displacement:
    """How the hand has to end elsewhere for the piece that is seen in it to get to its goal.

    Attributes:
        shift: of the hand's centre (3,) [m], in the world.
        turn: rotation vector (3,) [rad], in the world.
    """

    shift: Array
    turn: Array

    @property
    def size(self) -> float:
        """How far the hand has to move [m]."""
        return float(np.linalg.norm(self.shift))

    def counts(self, mm: float, deg: float) -> bool:
        """Whether it is worth a correction where up to so many [mm] and [deg] of it may be the eye's
        error."""
        shift, turn = np.linalg.norm(self.shift), np.linalg.norm(self.turn)
        return bool(shift >= max(CERTAIN_MM, mm) * 1e-3 or turn >= np.deg2rad(max(CERTAIN_DEG, deg)))


@dataclass(frozen=True, eq=False)
class Correction:
    """A placing as it is to be executed.

    Attributes:
        segment: bent to where the piece is seen in the hand, or as it was.
        fault: `lost` where the piece is not in the hand any more; `turned` where joints or the other arm
            forbid to bend the path so far, and it is better to plan anew; else empty.
    """

    segment: Segment
    fault: str = ""


def displacement(workcell: Workcell, segment: Segment, q: Array, seen: Sequence[Array]) -> Displacement:
    """Of the piece of a placing, the mean over some looks.

    Args:
        q: measured joints (n,) [rad] of the arm.
        seen: T_world_piece (4, 4) of each look.
    """
    robot, arm = workcell.robot, segment.arm
    here, planned, goal = robot.tcp(arm, q), robot.tcp(arm, segment.path[-1]), workcell.settled[segment.piece]
    found = []
    for pose in seen:
        wanted = goal @ inverse(inverse(here) @ pose)
        turn = Rotation.from_matrix(wanted[:3, :3] @ planned[:3, :3].T).as_rotvec()
        found.append((wanted[:3, 3] - planned[:3, 3], turn))
    shift, turn = np.mean(found, axis=0)
    return Displacement(shift, turn)


def correct(
    robot: Robot, segment: Segment, off: Displacement, arms: Concurrent, q: Array, utmost: bool
) -> Correction:
    """Bend a placing, by as much as joints and the other arms allow.

    Args:
        robot: which arm's it is says the segment.
        arms: the others, from now until the hand withdraws.
        q: measured joints (n,) [rad] of the arm.
        utmost: there is nothing else to do about it: joints may change by more, and what is left over is
            left.
    """
    limits = largest_change(segment.path.shape[1]) * (UTMOST if utmost else 1)
    largest = 1.0 / max(1.0, *(np.abs(_change(robot, segment, off, 1.0)) / limits))
    ramp = np.clip(np.linspace(0.0, 1.0 / BEND, len(segment.path)), 0.0, 1.0)[:, None]
    planned = arms.gap(segment.path, APART + NEARER)
    kept = min(APART, max(planned / 2, planned - NEARER) if planned > 0.0 else planned)
    for share in largest * np.array(SHARES):
        path = segment.path + ramp * _change(robot, segment, off, share)
        if arms.gap(path, kept) >= kept:
            break
    left = (1.0 - share) * np.linalg.norm(off.turn)
    if left > np.deg2rad(TURNED_DEG) and not utmost:
        return Correction(segment, "turned")
    return Correction(replace(segment, path=readonly(joined(path, q))))


def largest_change(joints: int) -> Array:
    """Of each of an arm's joints by a correction (n,) [rad]."""
    return np.array([*[ARM_CHANGE] * (joints - WRIST), *[WRIST_CHANGE] * WRIST])


def _change(robot: Robot, segment: Segment, off: Displacement, share: float) -> Array:
    """Of the joints at the end of a placing (n,) [rad] for a share of a correction.

    It is exact where the arm reaches so far on the same branch: along the Jacobian alone, which is damped
    near singularities, a turn of 8 deg leaves the hand several millimetres off. Else it is that."""
    end = segment.path[-1]
    along: Array = segment.compliance @ (share * np.concatenate([off.shift, off.turn]))
    planned = robot.tcp(segment.arm, end)
    turned = Rotation.from_rotvec(share * off.turn).as_matrix() @ planned[:3, :3]
    reached = robot.follow(
        segment.arm, make_transform(turned, planned[:3, 3] + share * off.shift), end + along
    )
    return along if reached is None or np.abs(reached - end - along).max() > ROUNDING else reached - end
