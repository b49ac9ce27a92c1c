"""The log of an episode made by hand, in which pieces glide from the feed to their goals."""

from __future__ import annotations

import numpy as np

from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import make_transform, to_quat_xyzw
from soma_bullet.robot.model import Cell
from soma_bullet.world.log import ExecutionLog, SegmentRecord

DIAGONAL = (0.0, 0.05, -0.05)  # [m]
# kind, step, arm, piece, duration [s], outcome
EPISODE = (
    ("transit", 0, "right", "Z", 1.0, ""),
    ("approach", 0, "right", "Z", 0.5, ""),
    ("grasp", 0, "right", "Z", 0.5, ""),
    ("lift", 0, "right", "Z", 0.5, ""),
    ("transfer", 0, "right", "Z", 1.0, ""),
    ("insert", 0, "right", "Z", 1.0, ""),
    ("place", 0, "right", "Z", 1.0, ""),
    ("settle", 0, "right", "Z", 0.25, ""),
    ("transit", 1, "left", "BigL", 1.5, ""),
    ("grasp", 1, "left", "BigL", 0.5, ""),
    ("transfer", 1, "left", "BigL", 1.0, ""),
    ("insert", 1, "left", "BigL", 1.0, ""),
    ("place", 1, "left", "BigL", 1.25, "stopped early"),
    ("settle", 1, "left", "BigL", 0.25, ""),
    ("release", 1, "right", "Z", 0.5, ""),
    ("retreat", 1, "right", "Z", 0.5, ""),
    ("release", 1, "left", "BigL", 0.5, ""),
    ("retreat", 1, "left", "BigL", 0.5, ""),
    ("home", 1, "right", "Z", 1.25, ""),
    ("final", -1, "", "", 1.5, ""),
)
Row = tuple[str, int, str, str, float, str]


def made_log(cell: Cell, assembly: Assembly, episode: tuple[Row, ...] = EPISODE) -> ExecutionLog:
    """A log of arms at rest and of pieces that glide from the feed to their goals."""
    segments, clock = [], 0.0
    for kind, step, arm, piece, duration, outcome in episode:
        offset = np.array(DIAGONAL if kind in ("insert", "place") else (0.0, 0.0, 0.0))
        start, clock = clock, clock + duration
        segments.append(
            SegmentRecord(kind, step, arm, piece, start, clock, outcome or "as planned", offset, 0.0, 0.0)
        )
    times = np.arange(0.01, clock + 1e-9, 0.02)
    T_world_assembly = make_transform(translation=(0.0, 0.0, 0.1))
    poses = np.zeros((len(times), len(assembly.pieces), 7))
    for k, (piece, goal) in enumerate(zip(assembly.pieces, assembly.goals, strict=True)):
        position, quat_xyzw = to_quat_xyzw(T_world_assembly @ goal)
        grasped = next((s.start for s in segments if (s.kind, s.piece) == ("grasp", piece.name)), 0.0)
        placed = next((s.end for s in segments if (s.kind, s.piece) == ("settle", piece.name)), 1.0)
        s = np.clip((times - grasped) / (placed - grasped), 0, 1)[:, None]
        poses[:, k, :3] = position + (1 - s) * np.array((0.2 - 0.2 * k, -0.25, -0.1))
        poses[:, k, 3:] = quat_xyzw
    joints = {name: q for name, q in zip(cell.joint_names, cell.q_home, strict=True)}
    joints |= {finger: 0.02 for arm in cell.arms for finger in arm.finger_joints}
    tcp = np.array([[-0.3, 0.2, 0.3, 1, 0, 0, 0], [0.3, -0.2, 0.3, 1, 0, 0, 0]])
    arms, empty = len(cell.arms), np.zeros(0)
    return ExecutionLog(
        cell=cell.name, assembly=assembly.name, digest=assembly.digest, seed=7, order=("Z", "BigL", "smallL"),
        stand=(0.03, 0.03), T_world_assembly=T_world_assembly, joint_names=tuple(joints),
        target_names=cell.joint_names,
        arm_names=tuple(arm.name for arm in cell.arms), piece_names=assembly.names, times=times,
        joints=np.tile(list(joints.values()), (len(times), 1)), targets=empty, poses=poses,
        tcps=np.tile(tcp[:arms], (len(times), 1, 1)), wrenches=empty, grips=empty, contacts=empty, bodies=(),
        segments=tuple(segments), events=(), constraints=(), ended="done",
    )  # fmt: skip
