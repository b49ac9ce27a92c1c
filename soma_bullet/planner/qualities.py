"""The analyzers behind one door: qualities of a step, looked up by (placed set, piece) and computed once.

Qualities depend on the placed set and the piece alone, so that n! orders share a few hundred evaluations.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np

from soma_bullet.assembly.contacts import SUPPORT
from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import Array, Indices, Mask
from soma_bullet.grasp.clearance import (
    OPENING,
    HandSweep,
    clear_of_piece,
    clear_of_scene,
    hands_clear,
    sweep_hands,
)
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.grasp.sampling import GraspSet, sample_grasps
from soma_bullet.planner.assemblability import Assemblability
from soma_bullet.planner.equilibrium import StateStability, classify, friction_of
from soma_bullet.planner.options import PAPER, PlannerOptions
from soma_bullet.planner.paper_stability import contact_wrenches, wrench_margin
from soma_bullet.planner.pushes import Bearing, Pushes
from soma_bullet.planner.ways import Ways, way_length

Placed = frozenset[int]
NOTHING: Placed = frozenset()
FEW = 6  # grasps of either hand, of each kind, that are tried first where one pair is enough
SPREAD = 12  # grasps of an incoming hand, of each kind, that are tried before all of them


class Qualities:
    """S, G and A of every (placed set, piece) of one assembly and the hands of a cell; each evaluated at most
    once.

    Args:
        grasps: of pieces, by index, that `grasps` of the same piece, hands and options gave elsewhere.
    """

    def __init__(
        self,
        assembly: Assembly,
        hands: HandSet,
        options: PlannerOptions,
        grasps: Mapping[int, GraspSet] | None = None,
    ):
        self.assembly, self.hands, self.options = assembly, hands, options
        self._supply = hands.at_least(options.hand_count)
        self.ways = Ways(assembly, "ordinal" if options.stability == PAPER else "finite")
        self.pushes = Pushes(assembly, options.load)
        self._paper: dict[tuple[int, Placed, float], float] = {}
        self._stability: dict[tuple[Placed, Placed], StateStability] = {}
        self._grasps: dict[int, GraspSet] = dict(grasps or {})
        self._clear: dict[tuple[int, int], Mask] = {}
        self._chosen: dict[tuple[int, Placed], Assemblability] = {}
        self._entering: dict[tuple[int, int, tuple[float, ...]], Mask] = {}
        self._candidates: dict[tuple[int, Placed, tuple[float, ...]], Indices] = {}
        self._accessible: dict[tuple[int, Placed], Indices] = {}
        self._spared: dict[tuple[int, Placed, int], Indices] = {}
        self._assisting: dict[tuple[int, Placed, int | None], Indices] = {}

    def paper_stability(self, piece: int, placed: Placed, turn: float = 0.0) -> float:
        """s of `piece` in the placed set (that contains it), by the paper's wrench set. Unit: weights of the
        piece."""
        neighbours = frozenset(
            k for c in self.assembly.contacts if piece in (c.body_a, c.body_b) for k in (c.body_a, c.body_b)
        )
        key = (piece, neighbours & placed, turn)
        if key not in self._paper:
            contacts = self.assembly.contacts_of(piece, placed)
            friction = np.array([friction_of(c, self.assembly) for c in contacts])
            body = self.assembly.pieces[piece]
            generators = contact_wrenches(
                contacts, self.assembly.goal_centres[piece], body.radius, friction, turn
            )
            self._paper[key] = wrench_margin(generators)
        return self._paper[key]

    def stability(self, placed: Placed, held: Placed = frozenset()) -> StateStability:
        """Equilibrium of the placed set with some pieces held."""
        key = (placed, held & placed)
        if key not in self._stability:
            self._stability[key] = classify(
                self.assembly, placed, held & placed, self.options.load.disturbance
            )
        return self._stability[key]

    def grasps(self, piece: int) -> GraspSet:
        """Grasps of `piece` alone in the air, kind of hand after kind: closable, with the hand clear of the
        piece itself and its way out."""
        if piece not in self._grasps:
            body = self.assembly.pieces[piece]
            sampled = sample_grasps(body, self.hands, self.options.sampling)
            clear = clear_of_piece(
                self.hands, sampled.kinds, sampled.Ts_piece_tcp, sampled.widths, body.parts
            )
            self._grasps[piece] = sampled.take(np.flatnonzero(clear))
        return self._grasps[piece]

    def accessible(self, piece: int, placed: Placed) -> Indices:
        """Indices of the grasps of `piece` at its goal whose hand and way out are clear of the placed set and
        the support."""
        key = (piece, placed - {piece})
        if key not in self._accessible:
            clear = self._clear_of(piece, SUPPORT).copy()
            for other in sorted(placed - {piece}):
                clear &= self._clear_of(piece, other)
            self._accessible[key] = np.flatnonzero(clear)
        return self._accessible[key]

    def candidates(self, piece: int, placed: Placed) -> Indices:
        """Indices of the accessible grasps whose hand is clear of the placed set on the way in too, all along
        the insertion."""
        direction = self.assemblability(piece, placed).direction
        return self.candidates_along(piece, placed, direction)

    def candidates_along(self, piece: int, placed: Placed, direction: Array | None) -> Indices:
        """The candidates along a direction (3,) of one's own."""
        indices = self.accessible(piece, placed)
        if direction is None or not len(indices):
            return indices
        key = (piece, placed, tuple(np.round(direction, 9).tolist()))
        if key not in self._candidates:
            clear = self._enters(piece, SUPPORT, direction).copy()
            for other in sorted(placed):
                clear &= self._enters(piece, other, direction)
            self._candidates[key] = indices[clear[indices]]
        return self._candidates[key]

    def graspability(self, piece: int, placed: Placed) -> int:
        """G: the number of candidate grasps, by any hand that some arm has (paper Sec. IV-C)."""
        return len(self.candidates(piece, placed))

    def assemblability(self, piece: int, placed: Placed) -> Assemblability:
        """A and the assembly direction of `piece` into the placed set (without it).

        Paper mode: the widest free way. Otherwise the first of the free ways, by their clearance, by which a
        hand can bring the piece, and which what is placed bears without a hold; where none is borne, that of
        which it bears the most."""
        key = (piece, placed)
        if key not in self._chosen:
            self._chosen[key] = self._choose(piece, placed)
        return self._chosen[key]

    def _choose(self, piece: int, placed: Placed) -> Assemblability:
        ways = self.ways.into(piece, placed)
        first = best = next(ways)
        if first.direction is None or self.options.stability == PAPER:
            return first
        most = -1.0
        stands = self.stability(placed).verdict != "unstable"
        for way in (first, *ways):
            assert way.direction is not None
            if not len(self.candidates_along(piece, placed, way.direction)):
                continue
            margin = self.pushes.bearing(placed, NOTHING, piece, way.direction).margin if stands else 1.0
            if min(margin, 1.0) > most:
                best, most = way, min(margin, 1.0)
            if most >= 1.0:
                break
        return best

    def bearing(self, placed: Placed, held: Placed, piece: int) -> Bearing:
        """What the placed set, with some pieces held, bears of the insertion of a piece along its
        direction."""
        direction = self.assemblability(piece, placed).direction
        return Bearing(0.0, 0.0) if direction is None else self.pushes.bearing(placed, held, piece, direction)

    def why_no_grasp(self, piece: int, placed: Placed) -> str:
        """How many grasps of `piece` each body in the placed set is in the way of."""
        count = len(self.grasps(piece))
        if not count:
            return "no pair of its opposite faces lets the hand close on it"
        names = {SUPPORT: "the support"} | dict(enumerate(self.assembly.names))
        blocked = {
            names[k]: int((~self._clear_of(piece, k)).sum()) for k in (SUPPORT, *sorted(placed - {piece}))
        }
        ranked = sorted(((hits, name) for name, hits in blocked.items() if hits), key=lambda item: -item[0])
        said = [f"{hits} hit {name}" for hits, name in ranked]
        late = len(self.accessible(piece, placed)) - len(self.candidates(piece, placed))
        return f"of {count} " + ", ".join(
            [*said, f"{late} more hit something on the way in"] if late else said
        )

    def assisting(self, piece: int, placed: Placed, upcoming: int | None, direction: Array | None) -> Indices:
        """Indices of the grasps that may hold a placed piece while the next one comes in (paper Sec. IV-F).

        They are accessible, clear of the next piece at its goal and along its whole way in, and clear of the
        hand that brings it, for at least one of its grasps by the hand of another arm (the paper leaves hand
        against hand open)."""
        key = (piece, placed, upcoming)
        if key not in self._assisting:
            self._assisting[key] = self._find_assisting(piece, placed, upcoming, direction)
        return self._assisting[key]

    def can_assist(self, piece: int, placed: Placed, upcoming: int | None, direction: Array | None) -> bool:
        """Whether there is an assisting grasp at all: a few that are spread out are tried before all of
        them."""
        if upcoming is None or direction is None or (piece, placed, upcoming) in self._assisting:
            return bool(len(self.assisting(piece, placed, upcoming, direction)))
        way = direction * way_length(self.assembly, upcoming, direction)
        indices, inserting = (
            self._clear_of_way(piece, placed, upcoming, way),
            self.candidates(upcoming, placed),
        )
        if not len(indices) or not len(inserting):
            return False
        few, some = self._thinned(piece, indices, FEW), self._thinned(upcoming, inserting, FEW)
        if self._beside(piece, few, upcoming, some, way).any():
            return True
        return bool(len(self.assisting(piece, placed, upcoming, direction)))

    def _clear_of_way(self, piece: int, placed: Placed, upcoming: int, way: Array) -> Indices:
        """Indices of the accessible grasps of a placed piece whose hand is clear of the next piece all along
        its way (3,)."""
        key = (piece, placed, upcoming)
        if key not in self._spared:
            indices = self.accessible(piece, placed)
            # the hand seen from the incoming piece moves along the direction: sweep the hand instead of the
            # piece
            clear = clear_of_scene(
                self._holding(piece, indices, way), self.assembly.goal_parts[upcoming], None
            )
            self._spared[key] = indices[clear]
        return self._spared[key]

    def _find_assisting(
        self, piece: int, placed: Placed, upcoming: int | None, direction: Array | None
    ) -> Indices:
        if upcoming is None or direction is None:
            return self.accessible(piece, placed)
        way = direction * way_length(self.assembly, upcoming, direction)
        indices = self._clear_of_way(piece, placed, upcoming, way)
        inserting, clear = self.candidates(upcoming, placed), np.zeros(len(indices), bool)
        # a few that are spread out mostly suffice
        for few in (self._thinned(upcoming, inserting, SPREAD), inserting):
            left = np.flatnonzero(~clear)
            if not len(left) or not len(few):
                break
            clear[left] = self._beside(piece, indices[left], upcoming, few, way).any(axis=1)
        return indices[clear]

    def _beside(self, piece: int, holding: Indices, upcoming: int, inserting: Indices, way: Array) -> Mask:
        """Which grasps (a,) of a placed piece another arm's hand leaves free that brings the next piece along
        its way (3,) by some grasps (b,): bool (a, b)."""
        clear = hands_clear(self._holding(piece, holding), self._arriving(upcoming, inserting, way))
        kinds = self.grasps(piece).kinds[holding], self.grasps(upcoming).kinds[inserting]
        clear &= self._supply.pairs[np.ix_(*kinds)]
        return clear

    def _thinned(self, piece: int, indices: Indices, count: int) -> Indices:
        """About `count` of some grasps of each kind of hand, spread over them."""
        kinds = self.grasps(piece).kinds[indices]
        each = (indices[kinds == kind] for kind in range(len(self.hands.kinds)))
        return np.concatenate([group[:: max(1, len(group) // count)] for group in each])

    def together(self, held: Placed, placed: Placed, upcoming: int | None, direction: Array | None) -> bool:
        """Whether the hands of several arms can hold several pieces at once: with grasps clear of each other
        and of the incoming hand."""
        pieces = sorted(held)
        chosen = [self.assisting(k, placed, upcoming, direction) for k in pieces]
        chosen = [self._thinned(k, indices, 2 * SPREAD) for k, indices in zip(pieces, chosen, strict=True)]
        sweeps = [self._holding(k, indices) for k, indices in zip(pieces, chosen, strict=True)]
        if upcoming is not None and direction is not None:
            few = self._thinned(upcoming, self.candidates(upcoming, placed), 2 * SPREAD)
            way = direction * way_length(self.assembly, upcoming, direction)
            pieces, chosen = [*pieces, upcoming], [*chosen, few]
            sweeps.append(self._arriving(upcoming, few, way))
        kinds = [self.grasps(k).kinds[indices] for k, indices in zip(pieces, chosen, strict=True)]
        clear = {
            (i, j): hands_clear(sweeps[i], sweeps[j])
            for i, j in itertools.combinations(range(len(sweeps)), 2)
        }

        def extend(picked: list[int]) -> bool:
            k = len(picked)
            if k == len(sweeps):
                return True
            used = [int(kinds[earlier][index]) for earlier, index in enumerate(picked)]
            allowed = [self._supply.can([*used, kind]) for kind in range(len(self.hands.kinds))]
            fits = np.array(allowed)[kinds[k]]
            for earlier, index in enumerate(picked):
                fits &= clear[earlier, k][index]
            return any(extend([*picked, int(index)]) for index in np.flatnonzero(fits))

        return extend([])

    def _holding(self, piece: int, indices: Indices, sweep: Array | None = None) -> HandSweep:
        """The hand as it holds a placed piece with some of its grasps."""
        return self._swept(piece, self.grasps(piece).take(indices), way_out=0.0, sweep=sweep)

    def _arriving(self, piece: int, indices: Indices, way: Array) -> HandSweep:
        """The hand as it brings a piece along its way (3,) [m], lets go and leaves."""
        return self._swept(piece, self.grasps(piece).take(indices), sweep=-way)

    def _swept(
        self,
        piece: int,
        grasps: GraspSet,
        opening: float = OPENING,
        way_out: float | None = None,
        sweep: Array | None = None,
    ) -> HandSweep:
        """The hands at grasps of a piece at its goal; see `sweep_hands`."""
        Ts = self.assembly.goals[piece] @ grasps.Ts_piece_tcp
        return sweep_hands(self.hands, grasps.kinds, Ts, grasps.widths, opening, way_out, sweep)

    def _enters(self, piece: int, other: int, direction: Array) -> Mask:
        """Which grasps of `piece` keep the hand clear of another body all along the insertion of the piece:
        bool (n,)."""
        key = (piece, other, tuple(np.round(direction, 6)))
        if key not in self._entering:
            # a grasp that is not clear at the goal is no candidate anyway
            left = np.flatnonzero(self._clear_of(piece, other) & self._clear_of(piece, SUPPORT))
            way = direction * way_length(self.assembly, piece, direction)
            sweep = self._swept(piece, self.grasps(piece).take(left), opening=0.0, way_out=0.0, sweep=-way)
            hulls, height = (
                ((), self.assembly.support.height)
                if other == SUPPORT
                else (self.assembly.goal_parts[other], None)
            )
            self._entering[key] = np.zeros(len(self.grasps(piece)), bool)
            self._entering[key][left[clear_of_scene(sweep, hulls, height)]] = True
        return self._entering[key]

    def _clear_of(self, piece: int, other: int) -> Mask:
        """Which grasps of `piece` keep the hand and its way out clear of one other piece, or of the support:
        bool (n,)."""
        key = (piece, other)
        if key not in self._clear:
            sweep = self._swept(piece, self.grasps(piece))
            if other == SUPPORT:
                self._clear[key] = clear_of_scene(sweep, (), self.assembly.support.height)
            else:
                self._clear[key] = clear_of_scene(sweep, self.assembly.goal_parts[other], None)
        return self._clear[key]
