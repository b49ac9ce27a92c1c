"""What all actions of one search plan with: the cell, the plan, where pieces lie, and what is known
already."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from soma_bullet.frames import Array, Indices, Mask
from soma_bullet.grasp.clearance import MARGIN, OPENING, SUPPORT_MARGIN, HandSweep, sweep_hand
from soma_bullet.grasp.graph import GraspGraph, Grip
from soma_bullet.planner.assembly_plan import AssemblyPlan, GraspTable
from soma_bullet.planner.assist import HoldCertificate
from soma_bullet.planner.tables import grasp_table, table_poses
from soma_bullet.task.actions import hand_over, hold, insert, pick, put_down, square
from soma_bullet.task.actions.action import Identity
from soma_bullet.task.actions.hand_over import HandOver
from soma_bullet.task.actions.pick import Pick
from soma_bullet.task.actions.put_down import PutDown
from soma_bullet.task.actions.square import Square
from soma_bullet.task.feed import Feed
from soma_bullet.task.insertion import Insertion
from soma_bullet.task.lines import Lines, Spot
from soma_bullet.task.memo import Memo
from soma_bullet.task.posture import posture_cost, spread
from soma_bullet.task.state import CellState
from soma_bullet.task.workcell import Workcell

GIVERS = 8  # grasps by which one arm may bring a piece that are tried
KEPT = 20_000  # results of each kind that a search keeps


@dataclass
class Excluded:
    """What a later stage has ruled out.

    Attributes:
        actions: by themselves, wherever they come.
        steps: a step of the plan with its insertion, and what brings the piece if that is to blame too.
        beginnings: what may not come before the first step.
    """

    actions: set[Identity] = field(default_factory=set)
    steps: set[tuple[int, Identity, tuple[Identity, ...]]] = field(default_factory=set)
    beginnings: set[tuple[Identity, ...]] = field(default_factory=set)


@dataclass(frozen=True, eq=False)
class Fetch:
    """What is to be brought into a hand.

    Attributes:
        piece: its name.
        source: where it is.
        state: what else is where, and what the hands do; those that hold nothing are at home.
        carrying: the arm and the grip that have it already.
    """

    piece: str
    source: Spot
    state: CellState
    carrying: tuple[int, Grip] | None = None

    @property
    def free(self) -> tuple[int, ...]:
        """Arms that may have a part in it."""
        return self.state.free


class ClearKey(NamedTuple):
    """Of the grasps that are clear with a piece at a spot."""

    placed: frozenset[str]
    piece: str
    spot: Spot


_GRAPHS: WeakKeyDictionary[GraspTable, GraspGraph] = WeakKeyDictionary()


class Planning:
    """What the actions of one search plan with.

    Attributes:
        workcell, plan, feed, lines, excluded: of the search.
        spots: where each piece lies that is not in place.
        first: the step of the plan that comes first; the pieces of those before it stand.
        found: T_world_piece (4, 4) of the pieces that stand at the start, as they were found.
    """

    def __init__(
        self,
        lines: Lines,
        plan: AssemblyPlan,
        feed: Feed,
        excluded: Excluded,
        spots: Mapping[str, Spot],
        first: int = 0,
        found: Mapping[str, Array] | None = None,
    ):
        self.lines, self.plan, self.feed, self.excluded = lines, plan, feed, excluded
        self.workcell: Workcell = lines.workcell
        self.robot, self.sizes = self.workcell.robot, self.workcell.sizes
        self.spots, self.first, self.found = dict(spots), first, dict(found or {})
        self.clear: Memo[ClearKey, Mask] = Memo(KEPT)
        self.picks_alone: Memo[pick.AloneKey, list[tuple[Array, Array]]] = Memo(KEPT)
        self.picks: Memo[pick.BesideKey, Pick | None] = Memo(KEPT)
        self.squares: Memo[square.SquaresKey, tuple[Square, ...]] = Memo(KEPT)
        self.places: Memo[put_down.PlacesKey, list[Spot]] = Memo(KEPT)
        self.brought: Memo[put_down.BroughtKey, list[tuple[Spot, int, Grip]]] = Memo(KEPT)
        self.put_downs: Memo[put_down.PutDownKey, PutDown | None] = Memo(KEPT)
        self.hand_overs: Memo[hand_over.MeetKey, HandOver | None] = Memo(KEPT)
        self.insertions: Memo[int, Insertion] = Memo(KEPT)
        self.insertion_lines: Memo[insert.LinesKey, list[Array]] = Memo(KEPT)
        self.certificates: Memo[hold.CertificateKey, HoldCertificate] = Memo(KEPT)

    def forget(self) -> None:
        """Pieces lie elsewhere: what was found with them where they lay does not count any more."""
        self.lines.forget()
        memos: list[Memo[Any, Any]] = [self.clear, self.picks_alone, self.picks, self.squares, self.places]
        for memo in (*memos, self.brought, self.put_downs, self.hand_overs, self.insertion_lines):
            memo.forget()

    # --- where pieces are --------------------------------------------------------------------------------

    def off(self, piece: str) -> float:
        """How far a piece on the table may be from where it seems to be [m]."""
        return self.spots[piece].off

    def standing(self, k: int) -> dict[str, Array]:
        """T_world_piece (4, 4) of the pieces that stand before step k."""
        pieces = [step.piece for step in self.plan.steps[:k]]
        return {
            piece: self.workcell.stands(piece, self.found[piece])
            if n < self.first and piece in self.found
            else self.workcell.settled[piece]
            for n, piece in enumerate(pieces)
        }

    def empty(self, k: int) -> CellState:
        """All arms at home with empty hands before step k, the pieces before it in place."""
        placed = self.standing(k)
        lying = {step.piece: self.spots[step.piece].pose for step in self.plan.steps[k:]}
        state = self.workcell.idle({**placed, **lying})
        for piece in placed:
            state = state.placing(piece)
        return state

    # --- grasps --------------------------------------------------------------------------------------------

    def graph(self, piece: str) -> GraspGraph:
        """The grasp graph of a piece: one for all searches of a plan."""
        table, body, hands = (
            grasp_table(self.plan, piece),
            self.workcell.body(piece),
            self.workcell.cell.hands,
        )
        graph = _GRAPHS.get(table)
        if graph is None or graph.piece is not body or graph.hands is not hands:
            poses = table_poses(table)
            graph = GraspGraph(body, hands, poses, table.widths, table.contact, table.kinds)
            _GRAPHS[table] = graph
        return graph

    def usable(self, piece: str, arm: int) -> Mask:
        """Which grasps of a piece's table are those of an arm's hand: bool (n,)."""
        return self.graph(piece).usable(arm)

    def opened(self, piece: str, spot: Spot, arm: int, grip: Grip) -> float:
        """Distance [m] between the pads on the way to a piece at a spot: enough also if it is not quite
        there."""
        return min(grip.width + 2 * (OPENING + spot.off), self.workcell.hand(arm).opening)

    def allowed(self, k: int) -> Indices:
        """Grasps of the piece of step k that serve at the goal and while it is held."""
        step = self.plan.steps[k]
        held = [set(hold.grasps) for hold in step.holds if hold.piece == step.piece and not hold.taken]
        return np.array(sorted(set(step.grasps).intersection(*held)), int)

    def clear_at(self, fetch: Fetch, spot: Spot) -> Mask:
        """Whether the hand is clear of the table and of the other pieces by each grasp, the piece at a spot:
        bool (n,)."""
        graph, key = self.graph(fetch.piece), ClearKey(fetch.state.placed, fetch.piece, spot)

        def make() -> Mask:
            sweep = graph.sweep(spot.pose, opening=OPENING + spot.off)
            return self._clear(fetch, spot, sweep, graph.widths, graph.openings)

        return self.clear.get(key, make)

    def clear_hands(self, fetch: Fetch, spot: Spot, arm: int, grips: Sequence[Grip]) -> Mask:
        """The same for some hands of an arm that are in no table."""
        hand, widths = self.workcell.hand(arm), np.array([grip.width for grip in grips])
        Ts = spot.pose @ np.array([grip.T_piece_tcp for grip in grips])
        sweep = sweep_hand(hand, Ts, widths, OPENING + spot.off)
        return self._clear(fetch, spot, sweep, widths, np.full(len(grips), hand.opening))

    def _clear(self, fetch: Fetch, spot: Spot, sweep: HandSweep, widths: Array, openings: Array) -> Mask:
        clear = np.asarray(sweep.above(0.0) > SUPPORT_MARGIN) & (widths + 2 * spot.off <= openings)
        for name, pose in fetch.state.on_table(fetch.piece).items():
            parts = [part.moved(pose) for part in self.workcell.body(name).parts]
            clear &= sweep.separation(parts) > MARGIN + self.off(name)
        return clear

    def givers(self, fetch: Fetch, giver: int, allowed: Mask, before: tuple[str, ...]) -> list[Grip]:
        """The grasps by which an arm may bring the piece, of every direction the most comfortable one.

        Args:
            allowed: grasps (n,) that serve what comes next; before: the regrasps before it.
        """
        if fetch.carrying is not None and not before:
            arm, grip = fetch.carrying
            return [grip] if arm == giver and allowed[grip.number] else []
        graph = self.graph(fetch.piece)
        serves = allowed & self.usable(fetch.piece, giver) & self._at_first(fetch, before)
        indices = np.flatnonzero(serves)
        Ts = fetch.source.pose @ graph.poses[indices]
        cost = posture_cost(self.robot, giver, Ts) - graph.contact[indices]
        return [graph.grip(int(g)) for g in spread(graph.poses, indices, cost)[:GIVERS]]

    def _at_first(self, fetch: Fetch, before: tuple[str, ...]) -> Mask:
        """The grasps (n,) in which the piece can come to its first or next regrasp."""
        graph = self.graph(fetch.piece)
        if not before:
            return self.clear_at(fetch, fetch.source)
        serves = graph.serving.any(axis=0)
        return np.asarray(serves if before[-1] == "put down" else np.ones_like(serves))
