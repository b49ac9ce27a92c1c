"""The log of a good episode made by hand, what may be changed in it, and the verdict on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import Array, make_transform, to_quat_xyzw
from soma_bullet.robot.model import Cell
from soma_bullet.verdict.judge import Judgement, judge
from soma_bullet.verdict.options import Tolerance
from soma_bullet.world.log import ExecutionLog, SegmentRecord

T_WORLD_ASSEMBLY = make_transform(translation=(0.0, 0.0, 0.1))
# kind, arm, piece; one second each. The right hand brings Z and holds it until the left one has brought BigL.
EPISODE = (
    *(
        (kind, "right", "Z")
        for kind in ("approach", "grasp", "lift", "transfer", "insert", "place", "settle")
    ),
    *(
        (kind, "left", "BigL")
        for kind in ("approach", "grasp", "lift", "transfer", "insert", "place", "settle")
    ),
    ("release", "right", "Z"),
    ("retreat", "right", "Z"),
    ("release", "left", "BigL"),
    ("retreat", "left", "BigL"),
    ("final", "", ""),
)


def good_log(assembly: Assembly, cell: Cell) -> ExecutionLog:
    """Pieces at their goals all along, a sample every half second."""
    none = np.zeros(3)
    segments = tuple(
        SegmentRecord(
            kind, 0 if piece == "Z" else 1, arm, piece, float(k), k + 1.0, "as planned", none, 0.0, 0.0
        )
        for k, (kind, arm, piece) in enumerate(EPISODE)
    )
    times = np.arange(0.0, len(EPISODE) + 0.1, 0.5)
    rows = [np.concatenate(to_quat_xyzw(T_WORLD_ASSEMBLY @ goal)) for goal in assembly.goals]
    names = (*cell.joint_names, *(finger for arm in cell.arms for finger in arm.finger_joints))
    links = tuple(
        link
        for arm in cell.arms
        for link in (arm.prefixed("forearm_link"), arm.prefixed("palm"), *arm.finger_links)
    )
    return ExecutionLog(
        cell=cell.name,
        assembly=assembly.name,
        digest=assembly.digest,
        seed=0,
        order=("Z", "BigL", "smallL"),
        stand=(0.03, 0.03),
        T_world_assembly=T_WORLD_ASSEMBLY,
        joint_names=names,
        target_names=cell.joint_names,
        arm_names=tuple(arm.name for arm in cell.arms),
        piece_names=assembly.names,
        times=times,
        joints=np.tile([*cell.q_home, 0.0, 0.0, 0.0, 0.0], (len(times), 1)),
        targets=np.zeros((len(times), 12)),
        poses=np.tile(rows, (len(times), 1, 1)),
        tcps=np.tile([0.0, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0], (len(times), 2, 1)),
        wrenches=np.zeros((len(times), 2, 6)),
        grips=np.full((len(times), 2), 20.0),
        contacts=np.zeros((0, 5)),
        bodies=(*links, "table", "stand", *assembly.names),
        segments=segments,
        events=(),
        constraints=(),
        ended="done",
    )


def moved(log: ExecutionLog, piece: str, T: Array, start: float = -1.0, end: float = np.inf) -> ExecutionLog:
    """A piece moved by T (4, 4), in the world, in the samples of a time span [s]."""
    poses, k = log.poses.copy(), log.piece_names.index(piece)
    for i in log.between(start, end):
        poses[i, k] = np.concatenate(to_quat_xyzw(T @ log.piece_pose(int(i), piece)))
    return replace(log, poses=poses)


def touched(log: ExecutionLog, a: str, b: str, time: float, force: float = 3.0) -> ExecutionLog:
    """With one more contact at a time [s]."""
    row = [int(np.argmin(np.abs(log.times - time))), log.bodies.index(a), log.bodies.index(b), force, -1e-5]
    return replace(log, contacts=np.vstack([log.contacts, row]))


def verdict(log: ExecutionLog, assembly: Assembly, cell: Cell) -> Judgement:
    return judge(log, assembly, cell, Tolerance())
