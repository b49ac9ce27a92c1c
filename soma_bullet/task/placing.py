"""How the piece of a step goes into its place: by which grasps and along which lines, and what changes hands
afterwards."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from soma_bullet.frames import Array, Indices, Mask, inverse
from soma_bullet.grasp.clearance import MARGIN, hand_hulls, sweep_hand
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.assist import HoldCertificate
from soma_bullet.task.assignments import Pick, Release, Take
from soma_bullet.task.fetch import Fetcher
from soma_bullet.task.guarded import guarded_length
from soma_bullet.task.holding import SMALLEST_MARGIN, Holding, State
from soma_bullet.task.options import Candidate, OptionFinder
from soma_bullet.task.tracing import Mover, Tracer
from soma_bullet.task.workcell import Hands, Workcell

RUN_IN = 0.012  # [m] of insertion beyond the piece's own size


@dataclass(frozen=True, eq=False)
class Placing:
    """The end of a step: how the piece goes in, and what happens afterwards."""

    candidate: Candidate
    q_goal: Array
    q_ready: Array
    certificate: HoldCertificate | None
    takes: tuple[Take, ...]
    releases: tuple[Release, ...]
    after: State


class Placer:
    """Puts pieces in their places, step by step of a plan.

    Args:
        poses: T_world_piece (4, 4) of what lies on the table, or stands already; looked up when asked.
        first: the step that comes first; the pieces of those before it stand.
    """

    def __init__(
        self, tracer: Tracer, plan: AssemblyPlan, fetcher: Fetcher, poses: Mapping[str, Array], first: int
    ):
        self.tracer, self.plan, self.fetcher, self.poses, self.first = tracer, plan, fetcher, poses, first
        self.workcell: Workcell = tracer.workcell
        self.robot, self.hand = tracer.robot, fetcher.hand
        self.holding = Holding(tracer, plan, fetcher)
        self.finder = OptionFinder(self.workcell, fetcher, self.lines_in)
        self._slow: dict[int, float] = {}
        self._insertions: dict[tuple[int, int, bytes], list[Array]] = {}

    def lying(self, k: int) -> dict[str, Array]:
        """The pieces on the table besides that of step k."""
        return {s.piece: self.poses[s.piece] for s in self.plan.steps[k + 1 :]}

    def placed_pose(self, piece: str) -> Array:
        """T_world_piece (4, 4) of a piece that stands."""
        early = piece in [s.piece for s in self.plan.steps[: self.first]]
        return self.workcell.stands(piece, self.poses[piece]) if early else self.workcell.settled[piece]

    def allowed(self, k: int) -> set[int]:
        """Grasps of the step's piece that serve at the goal and while it is held."""
        step = self.plan.steps[k]
        held = [set(hold.grasps) for hold in step.holds if hold.piece == step.piece and not hold.taken]
        return set(step.grasps).intersection(*held)

    def chosen(self, k: int, state: State) -> Indices:
        """Grasps of the step's piece that serve at the goal, while it is held, and beside the hands that
        hold."""
        step = self.plan.steps[k]
        indices = np.array(sorted(self.allowed(k)), int)
        if not len(indices):
            self.tracer.reject(
                step.piece, "no accessible grasp" + (" that may hold it" if step.holds else "")
            )
            return indices
        clear = self._clear_of_holders(k, state, indices)
        met = int((~clear).sum())
        self.tracer.reject(step.piece, "hand meets a holding hand or a placed piece on its way in", met)
        return indices[clear]

    def _clear_of_holders(self, k: int, state: State, indices: Indices) -> Mask:
        """Whether the hand, swept along the insertion, keeps clear of placed pieces and of the hands that
        hold."""
        step, graph = self.plan.steps[k], self.fetcher.graph(self.plan.steps[k].piece)
        Ts, widths = self.workcell.goals[step.piece] @ graph.poses[indices], graph.widths[indices]
        sweep = sweep_hand(
            self.hand, Ts, widths, way_out=0.0, sweep=-np.array(step.direction) * (step.way + RUN_IN)
        )
        obstacles = []
        for name in state.placed:
            parts = self.workcell.assembly.pieces[self.workcell.assembly.index(name)].parts
            obstacles += [part.moved(self.workcell.goals[name]) for part in parts]
        clear = np.asarray(sweep.separation(obstacles) > 0.0)
        leaving = sweep_hand(self.hand, Ts, widths)
        for T_world_tcp in state.grip.values():
            holder = hand_hulls(self.hand, T_world_tcp, 0.03)
            clear &= (sweep.separation(holder) > MARGIN) & (leaving.separation(holder) > MARGIN)
        return clear

    def placing(self, k: int, state: State, candidate: Candidate, pick: Pick | None = None) -> Placing | None:
        """Insertion, soon after the pick if there is one, and what follows it; or None with the reason
        counted."""
        step, certificate = self.plan.steps[k], None
        if any(hold.piece == step.piece and not hold.taken for hold in step.holds):
            certificate = self.holding.certificate(k, step.piece, candidate.grip)
            if certificate.margin < SMALLEST_MARGIN:
                self.tracer.reject(step.piece, f"the hold would slip (margin below {SMALLEST_MARGIN:g})")
                return None
        hands = state.hands.gripping(candidate.arm, step.piece)
        lines = (
            self.lines_in(k, candidate) if pick is None else self.finder.nearest(k, candidate, pick.q_lifted)
        )
        for line in lines:
            if not self.tracer.free("insertion", self._inserter(k, hands, state.placed, candidate), line):
                continue
            changes = self.holding.changes(k, state, candidate.arm, candidate.grip, line[0], self.lying(k))
            if changes is not None:
                return Placing(candidate, line[0], line[-1], certificate, *changes)
            break
        return None

    def lines_in(self, k: int, candidate: Candidate) -> list[Array]:
        """Insertions of all branches that are free of table, stand, pieces and the arm itself."""
        memory = (k, candidate.arm, candidate.grip.T_piece_tcp.tobytes())
        if memory not in self._insertions:
            step, cell = self.plan.steps[k], self.workcell
            T_goal = cell.settled[step.piece] @ candidate.grip.T_piece_tcp
            placed = {s.piece: self.placed_pose(s.piece) for s in self.plan.steps[:k]}
            mover = self._inserter(
                k, cell.idle().gripping(candidate.arm, step.piece), placed, candidate, alone=True
            )
            solutions = self.robot.inverse(candidate.arm, T_goal, self.robot.home[candidate.arm])
            if not len(solutions):
                self.tracer.reject(
                    step.piece, f"{self.robot.arm(candidate.arm).name} arm does not reach the goal"
                )
            away, length = -np.array(step.direction), step.way + RUN_IN
            lines = [self.tracer.line("insertion", mover, q, T_goal, away, length) for q in solutions]
            self._insertions[memory] = [line for line in lines if line is not None]
        return self._insertions[memory]

    def guarded(self, k: int) -> float:
        """How much of an insertion is slow and guarded [m]."""
        if k not in self._slow:
            step = self.plan.steps[k]
            standing = {s.piece: self.placed_pose(s.piece) for s in self.plan.steps[:k]}
            self._slow[k] = guarded_length(
                self.workcell, step.piece, np.array(step.direction), step.way + RUN_IN, standing
            )
        return self._slow[k]

    def _inserter(
        self, k: int, hands: Hands, placed: dict[str, Array], candidate: Candidate, alone: bool = False
    ) -> Mover:
        step = self.plan.steps[k]
        meant = frozenset(pair for pair in self.workcell.touching if step.piece in pair)
        carried = (step.piece, inverse(candidate.grip.T_piece_tcp))
        poses = {**placed, **self.lying(k)}
        scene = self.tracer.scene(("insertion", k), poses, hands, candidate.arm, carried, meant, alone)
        return Mover(step.piece, candidate.arm, scene, hands, candidate.grip.width)
