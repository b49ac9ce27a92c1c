"""The plan as a value: the chosen order with its steps, holds and grasps, and the matrices of all orders."""

from __future__ import annotations

from dataclasses import dataclass

from soma_bullet.frames import Array, Indices
from soma_bullet.planner.assist import HoldCertificate
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.orders import OrderRow


@dataclass(frozen=True, eq=False)
class GraspTable:
    """Grasps of one piece, alone in the air, by every kind of hand that an arm has.

    Attributes:
        piece: its name.
        poses: T_piece_tcp as position [m] and quat_xyzw (n, 7).
        widths: (n,) [m].
        contact: fraction of the pad on the piece (n,).
        kinds: kind of the hand (n,), as in `AssemblyPlan.hand_kinds`.
    """

    piece: str
    poses: Array
    widths: Array
    contact: Array
    kinds: Indices


@dataclass(frozen=True)
class Hold:
    """A piece that a hand holds after a step.

    Attributes:
        piece: its name.
        grasps: indices of the assisting grasps in the piece's table: clear of the placed set, the support,
            the next piece, its way and the hand that brings it.
        taken: the hand takes a placed piece; otherwise it stays on what it put down, or goes on holding.
        grasp: index of the assisting grasp with the largest margin among those that were certified.
        certificate: what that grasp can take.
    """

    piece: str
    grasps: tuple[int, ...]
    taken: bool
    grasp: int
    certificate: HoldCertificate


@dataclass(frozen=True)
class PlanStep:
    """One insertion.

    Attributes:
        piece: what is inserted.
        direction: unit assembly direction in the assembly frame.
        way: length of the straight way in [m].
        type: contact type.
        bears: force with which the piece may press on what it meets before something moves [N].
        borne: share of what a placing does to the placed pieces that these bear, up to all of it (1).
        pressed: the piece that bears the least, where that is not all.
        grasps: indices of the candidate grasps in the piece's table: clear on the way in, at the goal and on
            the way out.
        holds: what equilibrium asks to hold afterwards.
        verdict, margin, margin_sides: equilibrium of the state with the holds [g].
    """

    piece: str
    direction: tuple[float, float, float]
    way: float
    type: str
    bears: float
    borne: float
    pressed: str
    grasps: tuple[int, ...]
    holds: tuple[Hold, ...]
    verdict: str
    margin: float
    margin_sides: float


@dataclass(frozen=True)
class PlannedOrder:
    """An order worked out step by step.

    Attributes:
        order: names of the pieces, first to last.
        score: min S * min G * min A.
        steps: one for each piece.
    """

    order: tuple[str, ...]
    score: float
    steps: tuple[PlanStep, ...]


@dataclass(frozen=True)
class Sensitivity:
    """Paper mode: how an s of the chosen order depends on the frame of the friction pyramid.

    Attributes:
        state: names of the placed pieces, in order.
        piece: the one just placed, or the one whose s is the recomputed one of the step.
        s: as pinned.
        low, high: extremes over rotations of the pyramid.
    """

    state: tuple[str, ...]
    piece: str
    s: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class AssemblyPlan:
    """Output of the planner.

    Attributes:
        assembly, digest: name and content hash of the input.
        hands: name of each arm's hand, in the order of the arms.
        hand_kinds: kind of each arm's hand, as in the grasp tables; equal hands are of one kind.
        options: how it was judged.
        order: names of the pieces, first to last.
        score: of the order.
        steps: one for each piece of the order.
        alternatives: the next best orders, where more than one was asked for.
        grasps: one table a piece.
        orders: the row of every order, best first; of more than MOST_ENUMERATED pieces the best orders alone.
            Their holds are certified in the chosen order and its alternatives only.
        optimality: what the search guarantees.
        ties: orders whose score equals the best one's; the seed picks among those with the fewest holds.
        warnings: sentences.
        passed_over: orders that scored better and cannot be built, with the reason.
        sensitivity: paper mode only.
        versions: packages that the numbers depend on.
    """

    assembly: str
    digest: str
    hands: tuple[str, ...]
    hand_kinds: tuple[int, ...]
    options: PlannerOptions
    order: tuple[str, ...]
    score: float
    steps: tuple[PlanStep, ...]
    alternatives: tuple[PlannedOrder, ...]
    grasps: tuple[GraspTable, ...]
    orders: tuple[OrderRow, ...]
    optimality: str
    ties: tuple[tuple[str, ...], ...]
    warnings: tuple[str, ...]
    passed_over: tuple[str, ...]
    sensitivity: tuple[Sensitivity, ...]
    versions: dict[str, str]

    @property
    def named_hands(self) -> str:
        """The names of the different hands, in the order of the arms, for people."""
        return " and ".join(dict.fromkeys(self.hands))
