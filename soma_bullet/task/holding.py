"""Which hands let go after a step, and which take hold of a piece in place, in an order that keeps the state
up."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from soma_bullet.frames import Array, readonly
from soma_bullet.grasp.clearance import OPENING
from soma_bullet.planner.assembly_plan import AssemblyPlan, Hold
from soma_bullet.planner.assist import HoldCertificate, certify_hold
from soma_bullet.planner.equilibrium import classify
from soma_bullet.task.assignments import Release, Take
from soma_bullet.task.fetch import Fetcher
from soma_bullet.task.spots import comfort, spread
from soma_bullet.task.tracing import APPROACH, Grip, Mover, Tracer
from soma_bullet.task.workcell import Hands, Workcell

SMALLEST_MARGIN = 1.0  # of a hold's certificate
TAKES = 40  # grasps that are tried to take a piece in place


@dataclass(frozen=True, eq=False)
class State:
    """Where the search stands.

    Attributes:
        placed: T_world_piece of the pieces in place.
        hands: what the hands do; idle ones are at home.
        grip: held piece -> T_world_tcp.
        last: the arm that inserted last.
    """

    placed: dict[str, Array]
    hands: Hands
    grip: dict[str, Array] = field(default_factory=dict)
    last: int | None = None


class Holding:
    """What changes hands after a step."""

    def __init__(self, tracer: Tracer, plan: AssemblyPlan, fetcher: Fetcher):
        self.tracer, self.plan, self.fetcher = tracer, plan, fetcher
        self.workcell: Workcell = tracer.workcell
        self.robot, self.hand = tracer.robot, fetcher.hand
        self._certificates: dict[tuple[int, str, bytes], HoldCertificate] = {}
        self._stands: dict[tuple[frozenset[str], frozenset[str]], bool] = {}

    def certificate(self, k: int, piece: str, grip: Grip) -> HoldCertificate:
        """What a hold on a piece in place can take after step k."""
        key = (k, piece, grip.T_piece_tcp.tobytes())
        if key not in self._certificates:
            assembly, step = self.workcell.assembly, self.plan.steps[k]
            following = self.plan.steps[k + 1] if k + 1 < len(self.plan.steps) else None
            placed = frozenset(assembly.index(s.piece) for s in self.plan.steps[: k + 1])
            held = assembly.index(piece)
            self._certificates[key] = certify_hold(
                assembly, self.hand, placed, held, assembly.goals[held] @ grip.T_piece_tcp,
                "dropped" if step.verdict == "robust" else "frictionless",
                None if following is None else assembly.index(following.piece),
                None if following is None else np.array(following.direction), contact=grip.contact,
            )  # fmt: skip
        return self._certificates[key]

    def changes(
        self, k: int, state: State, arm: int, grip: Grip, q_goal: Array, lying: Mapping[str, Array]
    ) -> tuple[tuple[Take, ...], tuple[Release, ...], State] | None:
        """Takes, releases and the state after step k, whose piece an arm has just placed; None where there is
        no way."""
        step = self.plan.steps[k]
        placed = {**state.placed, step.piece: self.workcell.settled[step.piece]}
        hands = state.hands.with_arm(arm, q_goal, grip.width).gripping(arm, step.piece)
        held = {**state.grip, step.piece: self.workcell.goals[step.piece] @ grip.T_piece_tcp}
        return self.settle(k, State(placed, hands, held, arm), lying)

    def settle(
        self, k: int, state: State, lying: Mapping[str, Array]
    ) -> tuple[tuple[Take, ...], tuple[Release, ...], State] | None:
        """As `changes`, from the state in which the piece of step k is in place and all hands are where they
        are."""
        step = self.plan.steps[k]
        wanted = {hold.piece: hold for hold in step.holds}
        missing = [hold for name, hold in wanted.items() if name not in state.grip]
        go = sorted(
            set(state.grip) - set(wanted), key=lambda name: (name == step.piece, name)
        )  # the inserter last, if it may
        standing = False
        for order, after in _sequences(go, bool(missing)):
            taken = [hold.piece for hold in missing]
            if not self._stands_all_along(frozenset(state.placed), set(state.grip), order, after, taken):
                continue
            standing = True
            found = self._carry_out(k, state, order, after, missing, lying)
            if found is not None:
                return found
        if not standing:
            self.tracer.reject(step.piece, "letting go would let the state fall in any order")
        return None

    def _stands_all_along(
        self, placed: frozenset[str], held: set[str], order: list[str], after: int, taken: list[str]
    ) -> bool:
        for k in range(len(order) + 1):
            if k == after:
                held = held | set(taken)
            if k < len(order):
                held = held - {order[k]}
                if not self._stand(placed, frozenset(held)):
                    return False
        return True

    def _stand(self, placed: frozenset[str], held: frozenset[str]) -> bool:
        if (placed, held) not in self._stands:
            assembly = self.workcell.assembly
            indices = (frozenset(assembly.index(name) for name in names) for names in (placed, held))
            self._stands[placed, held] = classify(assembly, *indices).verdict != "unstable"
        return self._stands[placed, held]

    def _carry_out(
        self,
        k: int,
        state: State,
        order: list[str],
        after: int,
        missing: list[Hold],
        lying: Mapping[str, Array],
    ) -> tuple[tuple[Take, ...], tuple[Release, ...], State] | None:
        """The lines of one sequence of changes."""
        hands, grip = state.hands, dict(state.grip)
        releases: list[Release] = []
        takes: list[Take] = []
        for n in range(len(order) + 1):
            if n == after:
                for hold in missing:
                    take = self._take(k, state.placed, self._at_home(hands), hold, n, lying)
                    if take is None:
                        return None
                    takes.append(take)
                    hands = (
                        self._at_home(hands)
                        .with_arm(take.arm, take.q_hold, take.width)
                        .gripping(take.arm, hold.piece)
                    )
                    grip[hold.piece] = self.robot.tcp(take.arm, take.q_hold)
            if n == len(order):
                break
            arm = hands.holder(order[n])
            assert arm is not None
            q_end = self._retreat(k, state.placed, hands, arm, order[n], lying)
            if q_end is None:
                return None
            releases.append(Release(arm, order[n], readonly(q_end)))
            hands = hands.with_arm(arm, q_end).gripping(arm, None)
            del grip[order[n]]
        return tuple(takes), tuple(releases), State(state.placed, self._at_home(hands), grip, state.last)

    def _at_home(self, hands: Hands) -> Hands:
        """Idle arms wait at home."""
        for arm in range(len(self.workcell.cell.arms)):
            if arm not in hands.gripped:
                hands = hands.with_arm(arm, self.robot.home[arm], 0.0)
        return hands

    def _retreat(
        self,
        k: int,
        placed: Mapping[str, Array],
        hands: Hands,
        arm: int,
        piece: str,
        lying: Mapping[str, Array],
    ) -> Array | None:
        """Joints at the end of the straight retreat from a piece in place."""
        scene = self.tracer.scene(("placed", k), {**placed, **lying}, hands, arm)
        T = self.robot.tcp(arm, hands.qs[arm])
        mover = Mover(self.plan.steps[k].piece, arm, scene, hands, float(hands.openings[arm]) + 2 * OPENING)
        line = self.tracer.line(f"retreat from {piece}", mover, hands.qs[arm], T, -T[:3, 2], APPROACH)
        return None if line is None else line[-1]

    def _take(
        self,
        k: int,
        placed: Mapping[str, Array],
        hands: Hands,
        hold: Hold,
        after: int,
        lying: Mapping[str, Array],
    ) -> Take | None:
        """How a free hand takes hold of a piece in place."""
        step = self.plan.steps[k]
        free = [arm for arm in range(len(self.workcell.cell.arms)) if arm not in hands.gripped]
        if not free:
            self.tracer.reject(step.piece, f"no hand is free to take {hold.piece}")
        graph = self.fetcher.graph(hold.piece)
        indices = np.array(sorted(hold.grasps), int)
        for arm in free:
            gripping = hands.gripping(arm, hold.piece)
            scene = self.tracer.scene(("placed", k), {**placed, **lying}, gripping, arm)
            cost = comfort(self.robot, arm, placed[hold.piece] @ graph.poses[indices]) - (
                indices == hold.grasp
            )
            for g in spread(graph.poses, indices, cost)[:TAKES]:
                grip = graph.grip(g)
                certificate = self.certificate(k, hold.piece, grip)
                if certificate.margin < SMALLEST_MARGIN:
                    self.tracer.reject(
                        step.piece, f"the hold on {hold.piece} would slip (margin below {SMALLEST_MARGIN:g})"
                    )
                    continue
                T = placed[hold.piece] @ grip.T_piece_tcp
                mover = Mover(step.piece, arm, scene, gripping, grip.width + 2 * OPENING)
                for q in self.robot.inverse(arm, T, self.robot.home[arm]):
                    line = self.tracer.line(
                        f"approach to hold {hold.piece}", mover, q, T, -T[:3, 2], APPROACH
                    )
                    if line is not None:
                        return Take(
                            arm,
                            hold.piece,
                            grip.index,
                            grip.width,
                            readonly(line[-1]),
                            readonly(line[0]),
                            after,
                            certificate,
                        )
        return None


def _sequences(go: list[str], taking: bool) -> Iterator[tuple[list[str], int]]:
    """Orders in which to let go, each with how many come before what is taken."""
    for after in range(len(go) + 1 if taking else 1):
        for order in (go, go[::-1])[: 1 if len(go) < 2 else 2]:
            yield order, after
