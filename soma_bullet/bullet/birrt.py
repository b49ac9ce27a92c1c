"""The same motions by another planner: the birrt of the package pybullet-planning."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from soma_bullet.bullet.quiet import pybullet as p
from soma_bullet.bullet.stage import Stage
from soma_bullet.frames import inverse, to_quat_xyzw
from soma_bullet.task.segment import Segment
from soma_bullet.task.state import CellState
from soma_bullet.task.workcell import Workcell
from soma_bullet.world.options import Physics


@dataclass(frozen=True)
class Answer:
    """Whether one motion was found, and what it took.

    Attributes:
        cpu, wall: times [s].
        note: why it was not begun; empty where it was.
    """

    solved: bool
    cpu: float
    wall: float
    note: str


class BirrtWorld:
    """The cell in PyBullet, for pybullet-planning: it takes the first client, which it expects to be its own.

    Each arm is a body; the other arm, table, stand and pieces are obstacles. Pairs that may touch are left
    out as in the scenes of ours: a hand and the piece that it carries, pieces that meet in the assembly, and
    the cell's `never_checked`."""

    def __init__(self, workcell: Workcell, resolution: float):
        self.workcell, self.resolution = workcell, resolution
        names = workcell.assembly.names
        poses = {name: np.eye(4) for name in names}
        # with all frames, as it would load the URDF; without them it takes 0.6 of the time
        self.stage = Stage(
            workcell.cell,
            workcell.assembly,
            workcell.robot.stand_size,
            poses,
            workcell.robot.home,
            Physics(),
            frames=True,
        )
        assert self.stage.client == 0, "another client is open"

    def __enter__(self) -> BirrtWorld:
        return self

    def __exit__(self, *_: object) -> None:
        self.stage.close()

    def solve(self, state: CellState, segment: Segment, width: float, seed: int) -> Answer:
        """A motion once more, ends checked first, all but the resolution as it is by default.

        Args:
            state: where pieces and hands are.
            segment: the motion that the program has for it.
            width: of the hand that moves [m].
        """
        from pybullet_planning import birrt, get_distance_fn, get_extend_fn, get_sample_fn

        stage, arm = self.stage, segment.arm
        body, joints = stage.robots[arm], stage.arm_joints[arm]
        blocked = self.lay_out(state, segment, width)
        start = [float(v) for v in state.qs[arm]]
        goal = [float(v) for v in segment.path[-1]]
        random.seed(seed)
        np.random.seed(seed % 2**32)  # noqa: NPY002 (it is what that package draws from)
        steps = np.full(len(joints), self.resolution)
        tools = (
            get_distance_fn(body, joints),
            get_sample_fn(body, joints),
            get_extend_fn(body, joints, resolutions=steps),
        )
        wall, cpu = time.perf_counter(), time.process_time()
        ends = {"start": blocked(start), "goal": blocked(goal)}
        path = None if any(ends.values()) else birrt(start, goal, *tools, blocked)
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
        note = ", ".join(f"{end} in collision" for end, hit in ends.items() if hit)
        return Answer(path is not None, cpu, wall, note)

    def lay_out(self, state: CellState, segment: Segment, width: float) -> Callable[..., bool]:
        """Put everything where it is; the collision function of the arm that moves."""
        from pybullet_planning import Attachment, get_collision_fn

        stage = self.stage
        arm, arms = segment.arm, self.workcell.cell.arms
        openings = [width if k == arm else float(state.openings[k]) for k in range(len(arms))]
        for k, body in enumerate(stage.robots):
            for joint, angle in zip(stage.arm_joints[k], state.qs[k], strict=True):
                p.resetJointState(body, joint, float(angle))
            for joint in stage.finger_joints[k]:
                p.resetJointState(body, joint, openings[k] / 2)
        for name, pose in state.poses.items():
            place = to_quat_xyzw(pose @ inverse(stage.T_inertial_piece[name]))
            p.resetBasePositionAndOrientation(stage.pieces[name], *place)
        body, attachments, allowed = stage.robots[arm], [], set[Any]()
        carried = self.workcell.carried(state, arm)
        for name, T_tcp_piece in carried.items():
            child = stage.pieces[name]
            grasp = to_quat_xyzw(
                arms[arm].hand.T_mount_tcp @ T_tcp_piece @ inverse(stage.T_inertial_piece[name])
            )
            attachments.append(Attachment(body, stage.wrists[arm], grasp, child))
            hand = self.workcell.collision.hand_links
            allowed |= {
                ((body, link[1]), (child, -1))
                for name, link in stage.links.items()
                if name in hand and link[0] == body
            }
        for meant in segment.kind.touching(self.workcell, segment.piece):
            parts = [(stage.pieces | stage.fixtures).get(name) for name in meant]
            if None not in parts and len(parts) == 2:
                allowed.add(tuple((part, -1) for part in parts))
        for gripping, piece in state.gripped.items():
            if gripping == arm:
                allowed |= {
                    ((body, link[1]), (stage.pieces[piece], -1))
                    for link in stage.links.values()
                    if link[0] == body
                }
        ignored = set[tuple[int, int]]()
        for pair in self.workcell.cell.never_checked:
            one, other = (stage.links.get(name, (-1, -1)) for name in pair)
            if one[0] == other[0] == body:
                ignored |= {(one[1], other[1]), (other[1], one[1])}
        moving = {stage.pieces[name] for name in carried}
        bodies = [*stage.robots, *stage.fixtures.values(), *(stage.pieces[name] for name in state.poses)]
        obstacles = [thing for thing in bodies if thing != body and thing not in moving]
        blocked: Callable[..., bool] = get_collision_fn(
            body, stage.arm_joints[arm], obstacles=obstacles, attachments=attachments, self_collisions=True,
            disabled_collisions=ignored, extra_disabled_collisions=allowed,
        )  # fmt: skip
        return blocked
