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

DISPLACED_DEG = 2.0  # [deg] a placed piece that is seen turned farther is placed again
SIGMAS = 3.0  # of a look, that a piece may seem displaced by
FALLEN_DEG = 10.0  # [deg] a placed piece that is seen turned farther has fallen


@dataclass(frozen=True, eq=False)
class Trouble:
    """What did not go as planned: a segment of the program, or what was seen after it of other pieces."""

    index: int
    segment: Segment
    seen: Observation | None
    reason: str
    others: tuple[str, ...] = ()

    @property
    def piece(self) -> str:
        """The piece that it is about, or several."""
        return ", ".join(self.others) or self.segment.piece


class Recovery:
    """Finds the state to go on from."""

    def __init__(self, workcell: Workcell, plan: AssemblyPlan, executor: Executor, perception: Perception):
        self.workcell, self.plan = workcell, plan
        self.executor, self.perception = executor, perception

    def fallen(self, state: CellState, poses: Mapping[str, Array] | None = None) -> list[str]:
        """Pieces that were placed and are seen elsewhere, in the order of the plan."""
        poses = self.perception.look() if poses is None else poses
        placed = [name for name in self.plan.order if name in state.placed]
        return [
            name for name in placed if self._off(name, poses[name], self.workcell.sizes.fallen, FALLEN_DEG)
        ]

    def displaced(self, state: CellState, poses: Mapping[str, Array] | None = None) -> list[str]:
        """Pieces that were placed and are seen beside their goals, or elsewhere, and on which nothing lies
        that is where it should be; in the order of the plan. What perception errs by is allowed for."""
        poses = self.perception.look() if poses is None else poses
        mm, deg = (SIGMAS * sigma for sigma in self.perception.noise)
        most = self.workcell.sizes.displaced + mm * 1e-3, DISPLACED_DEG + deg
        off = [n for n in self.plan.order if n in state.placed and self._off(n, poses[n], *most)]
        there = state.placed - set(off)
        return [name for name in off if not any(self.workcell.carries(name, upper) for upper in there)]

    def _off(self, name: str, pose: Array, most: float, most_deg: float) -> bool:
        """Whether a piece is farther from its goal than so much [m], [deg]."""
        goal, piece = self.workcell.settled[name], self.workcell.body(name)
        shift = np.linalg.norm(apply(pose, piece.center_of_mass) - apply(goal, piece.center_of_mass))
        turned = rotation_angle(pose[:3, :3], goal[:3, :3])
        return bool(shift > most or turned > np.deg2rad(most_deg))

    def found(
        self, program: Program, state: CellState, trouble: Trouble | None
    ) -> tuple[CellState, list[str]]:
        """The state to go on from, as it is seen and measured: the hands clear of what they lost, and of all
        that stands where something fell or was displaced. And what was displaced without having fallen.

        Raises:
            NoSolutionError: a hand cannot leave.
        """
        if trouble is not None and trouble.seen is not None and trouble.seen.outcome == "lost":
            state = self._withdraw(program, state, trouble.index, trouble.segment)
        for arm, body in sorted(state.gripped.items()):
            if list(state.gripped.values()).count(body) > 1:  # amid a hand-over: one of the two hands lets go
                state = self._back_away(state, arm, body)
        poses = self.perception.look()
        down, beside = self.fallen(state, poses), self.displaced(state, poses)
        fallen = [name for name in self.plan.order if name in {*down, *beside}]
        if fallen:
            self.executor.note_event("fallen", ", ".join(fallen), "not in place")
            for arm, body in state.held.items():
                state = self._back_away(state, arm, body)
        placed = state.placed - set(fallen)
        world, robot = self.executor.world, self.workcell.robot
        qs = world.measured_joints()
        carried = {
            arm: inverse(robot.tcp(arm, qs[arm])) @ poses[body]
            for arm, body in sorted(state.gripped.items())
            if body not in placed
        }
        stands = self.workcell.stands
        known = {name: stands(name, T) if name in placed else T for name, T in poses.items()}
        joints = tuple(readonly(q) for q in qs)
        found = CellState(known, joints, world.openings(), state.gripped, carried, placed, state.joined)
        return found, [name for name in beside if name not in down]

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
