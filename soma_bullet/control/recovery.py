"""The state from which a program goes on after something has gone wrong, the hands clear of what they
lost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from soma_bullet.control.execute import Executor, Observation
from soma_bullet.control.perception import Perception
from soma_bullet.errors import NoSolutionError
from soma_bullet.frames import Array, apply, inverse, readonly, rotation_angle
from soma_bullet.grasp.clearance import OPENING
from soma_bullet.motion.line import LineError, sample_line
from soma_bullet.motion.timing import time_path
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.task.kinds import APPROACH, BACK_OFF, GRASP, RELEASE, RETREAT
from soma_bullet.task.program.motions import joined
from soma_bullet.task.program.program import Program
from soma_bullet.task.segment import DT, NO_PATH, OPENING_TIME, Segment
from soma_bullet.task.state import CellState
from soma_bullet.task.workcell import Workcell

FALLEN_DEG = 10.0  # [deg] a placed piece that is seen turned farther has fallen


@dataclass(frozen=True, eq=False)
class Trouble:
    """What did not go as planned: a segment of the program."""

    index: int
    segment: Segment
    seen: Observation | None
    reason: str


class Recovery:
    """Finds the state to go on from."""

    def __init__(self, workcell: Workcell, plan: AssemblyPlan, executor: Executor, perception: Perception):
        self.workcell, self.plan = workcell, plan
        self.executor, self.perception = executor, perception

    def fallen(self, state: CellState, poses: Mapping[str, Array] | None = None) -> list[str]:
        """Pieces that were placed and are seen elsewhere, in the order of the plan."""
        poses = self.perception.look() if poses is None else poses
        placed = [name for name in self.plan.order if name in state.placed]
        return [name for name in placed if self._off(name, poses[name])]

    def _off(self, name: str, pose: Array) -> bool:
        goal, piece = self.workcell.settled[name], self.workcell.body(name)
        shift = np.linalg.norm(apply(pose, piece.center_of_mass) - apply(goal, piece.center_of_mass))
        turned = rotation_angle(pose[:3, :3], goal[:3, :3])
        return bool(shift > self.workcell.sizes.fallen or turned > np.deg2rad(FALLEN_DEG))

    def found(self, program: Program, state: CellState, trouble: Trouble | None) -> CellState:
        """The state to go on from, as it is seen and measured.

        Raises:
            NoSolutionError: the plan does not go on from what stands, or a hand cannot leave.
        """
        if trouble is not None and trouble.seen is not None and trouble.seen.outcome == "lost":
            state = self._withdraw(program, state, trouble.index, trouble.segment)
        for arm, body in sorted(state.gripped.items()):
            if list(state.gripped.values()).count(body) > 1:  # amid a hand-over: one of the two hands lets go
                state = self._back_away(state, arm, body)
        poses = self.perception.look()
        fallen = self.fallen(state, poses)
        if fallen:
            self.executor.note_event("fallen", fallen[0], f"{', '.join(fallen)} not in place")
            for arm, body in state.held.items():
                state = self._back_away(state, arm, body)
        placed = state.placed - set(fallen)
        order = self.plan.order
        step = next((k for k, name in enumerate(order) if name not in placed), len(order))
        if set(order[:step]) != placed:
            standing = ", ".join(name for name in order if name in placed)
            raise NoSolutionError(
                "schedule", f"{standing} are in place, which no step of the plan begins with"
            )
        world, robot = self.executor.world, self.workcell.robot
        qs = world.measured_joints()
        carried = {
            arm: inverse(robot.tcp(arm, qs[arm])) @ poses[body]
            for arm, body in sorted(state.gripped.items())
            if body not in placed
        }
        known = {name: self.workcell.settled[name] if name in placed else T for name, T in poses.items()}
        joints = tuple(readonly(q) for q in qs)
        return CellState(known, joints, world.openings(), state.gripped, carried, placed, state.joined)

    def _withdraw(self, program: Program, state: CellState, index: int, segment: Segment) -> CellState:
        """Open a hand that has nothing, and go back the way it came if it is at a grasp."""
        arm, run = segment.arm, self.executor.run
        opening = float(self.executor.world.openings()[arm])
        grasps = (s for s in reversed(program.segments) if s.kind is GRASP and s.piece == segment.piece)
        width = next((s.width for s in grasps if s.width is not None), opening)
        opened = max(opening, width) + 2 * OPENING
        run(replace(segment, kind=RELEASE, path=NO_PATH, opening=opened, duration=OPENING_TIME, guard=0.0))
        if segment.kind is GRASP:
            before = reversed(program.segments[:index])
            approach = next(s for s in before if s.kind is APPROACH and s.arm == arm)
            q = self.executor.world.measured_joints()[arm]
            back = readonly(joined(approach.path[::-1], q))
            run(replace(approach, kind=BACK_OFF, path=back, offset=-approach.offset, opening=None))
        return state.gripping(arm, None).carrying(arm, None)

    def _back_away(self, state: CellState, arm: int, piece: str) -> CellState:
        """Open a hand at what it has, and go straight back."""
        world, robot = self.executor.world, self.workcell.robot
        q = world.measured_joints()[arm]
        opened = float(world.openings()[arm]) + 2 * OPENING
        here = Segment(RELEASE, None, arm, piece, opening=opened, duration=OPENING_TIME)
        self.executor.run(here)
        offset = -robot.tcp(arm, q)[:3, 2] * self.workcell.hand(arm).way_out
        try:
            path, travel = sample_line(robot, arm, q, offset)
        except LineError as error:
            reason = f"{piece}: no way back from where it was held: {error}"
            raise NoSolutionError("motion", reason) from None
        joints, limits = robot.arm(arm), RETREAT.limits
        timed = readonly(time_path(path, joints.velocity, joints.acceleration, DT, travel, limits))
        back = replace(here, kind=BACK_OFF, path=timed, offset=readonly(offset), opening=None, duration=0.0)
        self.executor.run(back)
        return state.gripping(arm, None).carrying(arm, None)
