"""How a piece gets into a hand by a given grasp: picked from the table, or brought there by put-downs and
hand-overs.

A chain is built backwards from the grasp that is wanted: the last regrasp first, then how its giver got the
piece. Fewer actions come first, and a hand-over before a put-down. Planned durations: a hand-over (carry,
approach, close, open, retreat, go home) adds about 7 s, a put-down (carry, lower, 10 mm at 10 mm/s, open,
retreat, and a pick) about 11 s."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from typing import Literal, TypeVar

import numpy as np

from soma_bullet.frames import Array, Mask, apply, inverse, readonly
from soma_bullet.grasp.clearance import MARGIN, OPENING, SUPPORT_MARGIN, sweep_hand
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.task.assignments import HandOver, Pick, PutDown, Regrasp, Square
from soma_bullet.task.feed import Feed
from soma_bullet.task.grasps import grasp_table
from soma_bullet.task.regrasp import GraspGraph, grasp_graph
from soma_bullet.task.spots import comfort, free_places, meeting_poses, spread
from soma_bullet.task.squaring import SQUARE, level_axes, square_key, squaring_grips, squeezing_grips
from soma_bullet.task.tracing import APPROACH, LIFT, UP, Grip, Mover, Tracer
from soma_bullet.task.workcell import TABLE, Hands

Action = Literal["hand over", "put down"]
CHAINS: tuple[tuple[Action, ...], ...] = (
    ("hand over",),
    ("put down",),
    ("put down", "hand over"),
    ("hand over", "put down"),
    ("put down", "put down"),
)  # in the order of their cost
GIVERS, PLACES, MEETINGS, BRANCHES = 8, 6, 6, 4  # that are tried for one grasp

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class View:
    """What fetching the piece of one step has to do with.

    Attributes:
        step: index of the plan's step, or -1 for a piece that is only put out of the way.
        piece: its name.
        source: T_world_piece (4, 4) where it is.
        carrying: the arm and the grip that have it already.
        lying: T_world_piece of the other pieces on the table; placed: of those in place.
        hands: what the arms do; those that hold nothing are at home.
        free: arms that hold nothing in place.
    """

    step: int
    piece: str
    source: Array
    carrying: tuple[int, Grip] | None
    lying: dict[str, Array]
    placed: dict[str, Array]
    hands: Hands
    free: tuple[int, ...]

    @property
    def others(self) -> dict[str, Array]:
        """T_world_piece of all other pieces."""
        return {**self.placed, **self.lying}

    @property
    def key(self) -> tuple[object, ...]:
        """Equal for views in which the same lines are free."""
        return self.step, self.piece, tuple(sorted(self.hands.gripped.items())), self.hands.qs.tobytes()


class Fetcher:
    """Picks, put-downs and hand-overs of the pieces of one plan."""

    def __init__(self, tracer: Tracer, plan: AssemblyPlan, feed: Feed, excluded: set[tuple[object, ...]]):
        self.tracer, self.plan, self.feed, self.excluded = tracer, plan, feed, excluded
        self.moved: frozenset[str] = (
            frozenset()
        )  # pieces that are no longer where the feed has them, but exactly somewhere
        self.workcell, self.robot = tracer.workcell, tracer.robot
        self.hand = self.workcell.cell.arms[0].hand
        self._memory: dict[tuple[object, ...], object] = {}

    def graph(self, piece: str) -> GraspGraph:
        """The grasp graph of a piece."""
        assembly = self.workcell.assembly
        return grasp_graph(assembly.pieces[assembly.index(piece)], grasp_table(self.plan, piece), self.hand)

    def _once(self, key: tuple[object, ...], make: Callable[[], T]) -> T:
        if key not in self._memory:
            self._memory[key] = make()
        return self._memory[key]  # type: ignore[return-value]

    def off(self, piece: str) -> float:
        """How far a piece on the table may be from where it seems to be [m]."""
        return 0.0 if piece in self.moved else self.feed.off(self.graph(piece).piece)

    def opened(self, view: View, pose: Array, grip: Grip) -> float:
        """Distance [m] between the pads on the way to the piece at a pose: enough also if it is not quite
        there."""
        off = self.off(view.piece) if pose is view.source else 0.0
        return min(grip.width + 2 * (OPENING + off), self.hand.opening)

    # --- from the table -------------------------------------------------------------------------------------

    def clear_at(self, view: View, pose: Array) -> Mask:
        """Whether the hand is clear of the table and of the other pieces by each grasp, the piece at a pose:
        bool (n,)."""
        return self._once(
            ("clear", view.step, view.piece, pose.tobytes()), lambda: self._clear_at(view, pose)
        )

    def _clear_at(self, view: View, pose: Array) -> Mask:
        graph = self.graph(view.piece)
        return self._clear(view, pose, graph.poses, graph.widths)

    def _clear(self, view: View, pose: Array, poses: Array, widths: Array) -> Mask:
        """The same for hands at T_piece_tcp (n, 4, 4) that are `widths` (n,) [m] wide."""
        assembly = self.workcell.assembly
        off = self.off(view.piece) if pose is view.source else 0.0
        sweep = sweep_hand(self.hand, pose @ poses, widths, OPENING + off)
        clear = np.asarray(sweep.above(0.0) > SUPPORT_MARGIN) & (widths + 2 * off <= self.hand.opening)
        for name, other in view.lying.items():
            parts = assembly.pieces[assembly.index(name)].parts
            clear &= sweep.separation([part.moved(other) for part in parts]) > MARGIN + self.off(name)
        return clear

    def picks_alone(self, view: View, pose: Array, arm: int, grip: Grip) -> list[tuple[Array, Array]]:
        """Approach and lift of every branch that is free of table, stand, pieces and the arm itself."""
        key = ("pick", view.step, view.piece, pose.tobytes(), arm, grip.T_piece_tcp.tobytes())
        return self._once(key, lambda: self._picks_alone(view, pose, arm, grip))

    def _picks_alone(self, view: View, pose: Array, arm: int, grip: Grip) -> list[tuple[Array, Array]]:
        T_pick = pose @ grip.T_piece_tcp
        hands = self.workcell.idle().gripping(arm, view.piece)
        arriving, leaving = self._pick_movers(view, hands, pose, arm, grip, alone=True)
        solutions = self.robot.inverse(arm, T_pick, self.robot.home[arm])
        if not len(solutions):
            self.tracer.reject(view.piece, f"{self.robot.arm(arm).name} arm does not reach the feed")
        picks = []
        for q in solutions:
            approach = self.tracer.line("approach", arriving, q, T_pick, -T_pick[:3, 2], APPROACH)
            if approach is None:
                continue
            lift = self.tracer.line("lift", leaving, q, T_pick, UP, LIFT)
            if lift is not None:
                picks.append((approach, lift))
        return picks

    def _pick_movers(
        self, view: View, hands: Hands, pose: Array, arm: int, grip: Grip, alone: bool = False
    ) -> tuple[Mover, Mover]:
        there = {**view.others, view.piece: pose}
        key = ("there", view.step, view.piece, pose.tobytes())
        arriving = self.tracer.scene(key, there, hands, arm, alone=alone)
        opened = Mover(view.piece, arm, arriving, hands, self.opened(view, pose, grip))
        return opened, self._carrying(view, hands, arm, grip, alone)

    def _carrying(self, view: View, hands: Hands, arm: int, grip: Grip, alone: bool = False) -> Mover:
        """An arm with the piece near the table."""
        carried, lying = (view.piece, inverse(grip.T_piece_tcp)), frozenset({frozenset({view.piece, TABLE})})
        scene = self.tracer.scene(
            ("carry", view.step, view.piece), view.others, hands, arm, carried, lying, alone
        )
        return Mover(view.piece, arm, scene, hands, grip.width)

    def pick(self, view: View, pose: Array, arm: int, grip: Grip) -> Pick | None:
        """How an arm picks the piece at a pose, the other arms being where they are."""
        key = ("pick beside", *view.key, pose is view.source, pose.tobytes(), arm, grip.T_piece_tcp.tobytes())
        return self._once(key, lambda: self._pick(view, pose, arm, grip))

    def _pick(self, view: View, pose: Array, arm: int, grip: Grip) -> Pick | None:
        hands = view.hands.gripping(arm, view.piece)
        for approach, lift in self.picks_alone(view, pose, arm, grip):
            arriving, leaving = self._pick_movers(view, hands, pose, arm, grip)
            if self.tracer.free("approach", arriving, approach) and self.tracer.free("lift", leaving, lift):
                joints = (readonly(q) for q in (approach[-1], approach[0], lift[-1]))
                return Pick(view.piece, arm, grip.index, grip.width, self.opened(view, pose, grip), *joints)
        return None

    def squares(self, view: View, arm: int, grip: Grip, pick: Pick) -> tuple[Square, ...]:
        """What makes the place of a piece of the feed exact before an arm picks it; nothing where it is exact
        already."""
        if not self.feed.square or not self.off(view.piece):
            return ()
        ruled_out = frozenset(entry for entry in self.excluded if entry[0] == SQUARE)
        key = (SQUARE, *view.key, arm, grip.T_piece_tcp.tobytes(), ruled_out)
        return self._once(key, lambda: self._squares(view, arm, grip, pick))

    def _squares(self, view: View, arm: int, grip: Grip, pick: Pick) -> tuple[Square, ...]:
        graph, clear = self.graph(view.piece), self.clear_at(view, view.source)
        found: list[Square] = []
        axes = level_axes((view.source @ grip.T_piece_tcp)[:3, 0])
        while len(axes) < 2:
            for other in [*squaring_grips(graph, clear, view.source, axes), *self._squeezes(view, axes)]:
                square = self._square(view, arm, other, pick)
                if square is not None:
                    found.append(square)
                    axes.append((view.source @ other.T_piece_tcp)[:3, 0])
                    break
            else:
                self.tracer.reject(view.piece, "no grasp squares it; taken as seen")
                return ()
        return tuple(found)

    def _squeezes(self, view: View, axes: list[Array]) -> list[Grip]:
        """The squeezing hands that are clear of the table and of the other pieces."""
        grips = squeezing_grips(self.graph(view.piece).piece, self.hand, view.source, axes)
        if not grips:
            return []
        widths = np.array([grip.width for grip in grips])
        free = self._clear(view, view.source, np.array([grip.T_piece_tcp for grip in grips]), widths)
        return [grip for grip, is_free in zip(grips, free, strict=True) if is_free]

    def _square(self, view: View, arm: int, grip: Grip, pick: Pick) -> Square | None:
        """How an arm squares the piece by a grasp: by the branch that is nearest to how it picks it then."""
        T, hands = view.source @ grip.T_piece_tcp, view.hands.gripping(arm, view.piece)
        arriving, _ = self._pick_movers(view, hands, view.source, arm, grip)
        solutions = sorted(
            self.robot.inverse(arm, T, pick.q_pick),
            key=lambda q: float(np.abs(q - pick.q_pick).max().round(9)),
        )
        for q in solutions:
            line = self.tracer.line("approach to square", arriving, q, T, -T[:3, 2], APPROACH)
            if line is not None:
                square = Square(
                    view.piece, arm, grip.width, arriving.width, readonly(line[-1]), readonly(line[0])
                )
                if square_key(square) not in self.excluded:
                    return square
        return None

    # --- chains ---------------------------------------------------------------------------------------------

    def chains(
        self, view: View, arm: int, grip: Grip, actions: tuple[Action, ...]
    ) -> Iterator[tuple[tuple[Regrasp, ...], Pick | None]]:
        """Regrasps of the given kinds after which an arm has the piece by a grip, with the last pick; None:
        it has it then."""
        if not actions:
            if view.carrying is None:
                pick = self.pick(view, view.source, arm, grip)
                if pick is not None:
                    yield self.squares(view, arm, grip, pick), pick
            elif (arm, grip) == view.carrying:
                yield (), None
        elif actions[-1] == "hand over":
            yield from self._handed_over(view, arm, grip, actions[:-1])
        else:
            yield from self._from_another_place(view, arm, grip, actions[:-1])

    def _at_first(self, view: View, before: tuple[Action, ...]) -> Mask:
        """The grasps (n,) in which the piece can come to its first or next regrasp."""
        graph = self.graph(view.piece)
        if not before:
            return self.clear_at(view, view.source)
        serves = graph.serving.any(axis=0)
        return np.asarray(serves if before[-1] == "put down" else np.ones_like(serves))

    def _givers(self, view: View, giver: int, allowed: Mask, before: tuple[Action, ...]) -> list[Grip]:
        """The grasps by which an arm may bring the piece, of every direction the most comfortable one."""
        if view.carrying is not None and not before:
            arm, grip = view.carrying
            return [grip] if arm == giver and allowed[grip.index] else []
        graph = self.graph(view.piece)
        indices = np.flatnonzero(allowed & self._at_first(view, before))
        cost = comfort(self.robot, giver, view.source @ graph.poses[indices]) - graph.contact[indices]
        return [graph.grip(int(g)) for g in spread(graph.poses, indices, cost)[:GIVERS]]

    def _handed_over(
        self, view: View, arm: int, grip: Grip, before: tuple[Action, ...]
    ) -> Iterator[tuple[tuple[Regrasp, ...], Pick | None]]:
        allowed = self.graph(view.piece).together(grip.index)
        for giver in view.free:
            if giver == arm:
                continue
            for held in self._givers(view, giver, allowed, before):
                for regrasps, pick in islice(self.chains(view, giver, held, before), 1):
                    key = (
                        "meet",
                        *view.key,
                        giver,
                        held.T_piece_tcp.tobytes(),
                        arm,
                        grip.T_piece_tcp.tobytes(),
                    )
                    met = self._once(key, partial(self._meet, view, giver, held, arm, grip))
                    if met is not None:
                        yield (*regrasps, replace(met, pick=pick)), None

    def _from_another_place(
        self, view: View, arm: int, grip: Grip, before: tuple[Action, ...]
    ) -> Iterator[tuple[tuple[Regrasp, ...], Pick | None]]:
        graph = self.graph(view.piece)
        for rest in np.flatnonzero(graph.serving[:, grip.index]):
            for pose, giver, held in self._places(view, int(rest), arm, grip, before):
                again = self.pick(view, pose, arm, grip)
                if again is None:
                    continue
                for regrasps, pick in islice(self.chains(view, giver, held, before), 1):
                    key = ("down", *view.key, giver, held.T_piece_tcp.tobytes(), pose.tobytes())
                    down = self._once(key, partial(self.put_down, view, giver, held, pose))
                    if down is not None:
                        yield (*regrasps, replace(down, pick=pick)), again

    # --- one put-down ---------------------------------------------------------------------------------------

    def _places(
        self, view: View, rest: int, arm: int, grip: Grip, before: tuple[Action, ...]
    ) -> list[tuple[Array, int, Grip]]:
        """Where one resting pose can go, who brings it and how: the most comfortable for both hands, and
        near, first."""
        key = ("brought", *view.key, rest, arm, grip.T_piece_tcp.tobytes(), before)
        return self._once(key, lambda: self._find_places(view, rest, arm, grip, before))

    def _find_places(
        self, view: View, rest: int, arm: int, grip: Grip, before: tuple[Action, ...]
    ) -> list[tuple[Array, int, Grip]]:
        poses = self.places(view, rest)
        if not len(poses):
            self.tracer.reject(view.piece, "no free place on the table")
            return []
        near = np.linalg.norm(poses[:, :2, 3] - view.source[:2, 3], axis=1)
        cost = near + comfort(self.robot, arm, poses @ grip.T_piece_tcp)
        allowed = self.graph(view.piece).serving[rest]
        found: list[tuple[float, int, int, Grip]] = []
        for giver in view.free:
            for held in self._givers(view, giver, allowed, before):
                total = cost + comfort(self.robot, giver, poses @ held.T_piece_tcp)
                best = np.argsort(np.round(total, 9), kind="stable")[:2]
                found += [(round(float(total[k]), 9), int(k), giver, held) for k in best]
        found.sort(key=lambda item: item[:3])
        return [(poses[k], giver, held) for _, k, giver, held in found[:PLACES]]

    def places(self, view: View, rest: int) -> Array:
        """T_world_piece (m, 4, 4) of one resting pose at free places of the table."""
        graph = self.graph(view.piece)
        return self._once(
            ("places", view.step, view.piece, rest),
            lambda: free_places(self.workcell, graph.piece, graph.resting[rest], view.source, view.others),
        )

    def put_down(self, view: View, arm: int, grip: Grip, pose: Array) -> PutDown | None:
        """How an arm that has the piece puts it down at a pose."""
        T_down = pose @ grip.T_piece_tcp
        hands = view.hands.gripping(arm, view.piece)
        leaving, lowering = self._pick_movers(view, hands, pose, arm, grip)
        for q in self.robot.inverse(arm, T_down, self.robot.home[arm]):
            lower = self.tracer.line("put-down", lowering, q, T_down, UP, LIFT)
            if lower is None:
                continue
            away = self.tracer.line("retreat from a put-down", leaving, q, T_down, -T_down[:3, 2], APPROACH)
            if away is not None:
                over, down, clear = (readonly(q) for q in (lower[-1], lower[0], away[-1]))
                return PutDown(view.piece, arm, None, over, down, clear, readonly(pose))
        return None

    # --- one hand-over --------------------------------------------------------------------------------------

    def _meet(self, view: View, giver: int, held: Grip, arm: int, grip: Grip) -> HandOver | None:
        piece = self.graph(view.piece).piece
        poses = meeting_poses(
            self.robot,
            (giver, arm),
            (held.T_piece_tcp, grip.T_piece_tcp),
            apply(view.source, piece.center_of_mass),
            piece.center_of_mass,
        )
        for pose in poses[:MEETINGS]:
            met = self._meet_at(view, pose, giver, held, arm, grip)
            if met is not None:
                return met
        self.tracer.reject(view.piece, "no free pose to hand over")
        return None

    def _meet_at(
        self, view: View, pose: Array, giver: int, held: Grip, arm: int, grip: Grip
    ) -> HandOver | None:
        T_give, T_take = pose @ held.T_piece_tcp, pose @ grip.T_piece_tcp
        gives = self.robot.inverse(giver, T_give, self.robot.home[giver])[:BRANCHES]
        takes = self.robot.inverse(arm, T_take, self.robot.home[arm])[:BRANCHES]
        if not len(gives) or not len(takes):
            return None
        carrying = self._carrying(view, view.hands.gripping(giver, view.piece), giver, held)
        there = {**view.others, view.piece: pose}
        both = view.hands.gripping(giver, view.piece).gripping(arm, view.piece)
        key = ("met", view.step, view.piece, pose.tobytes())
        for q_meet in gives:
            if not self.tracer.free("hand-over", carrying, q_meet[None]):
                continue
            waiting = both.with_arm(giver, q_meet, held.width)
            taker = Mover(
                view.piece,
                arm,
                self.tracer.scene(key, there, waiting, arm),
                waiting,
                grip.width + 2 * OPENING,
            )
            for q_take in takes:
                approach = self.tracer.line(
                    "approach to a hand-over", taker, q_take, T_take, -T_take[:3, 2], APPROACH
                )
                if approach is None:
                    continue
                held_by_both = waiting.with_arm(arm, q_take, grip.width)
                scene = self.tracer.scene(key, there, held_by_both, giver)
                leaver = Mover(view.piece, giver, scene, held_by_both, held.width + 2 * OPENING)
                away = self.tracer.line(
                    "retreat from a hand-over", leaver, q_meet, T_give, -T_give[:3, 2], APPROACH
                )
                if away is not None:
                    return HandOver(
                        view.piece,
                        giver,
                        None,
                        readonly(q_meet),
                        readonly(away[-1]),
                        arm,
                        grip.index,
                        grip.width,
                        readonly(approach[-1]),
                        readonly(q_take),
                        readonly(pose),
                    )
        return None
