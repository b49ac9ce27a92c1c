"""Square: a hand closes on a piece as it lies on the table, which makes its place exact by contact alone.

A hand that closes centres what it grips along its closing axis and turns it true, but leaves it where it is
along the pads. Two level closings across each other make place and yaw exact: one before the pick, or two
where the pick itself closes upwards (sensorless alignment by squeezing: K. Goldberg, "Orienting polygonal
parts without sensors", Algorithmica 1993)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.frames import Array, Mask, apply, inverse, make_transform, readonly
from soma_bullet.grasp.clearance import SUPPORT_MARGIN
from soma_bullet.grasp.graph import GraspGraph, Grip
from soma_bullet.grasp.hand import Hand
from soma_bullet.sizes import Sizes
from soma_bullet.task.actions.action import Action, Identity, Steps
from soma_bullet.task.actions.pick import Pick, close, opened_at
from soma_bullet.task.actions.release import leave
from soma_bullet.task.posture import spread
from soma_bullet.task.state import CellState, Stance

if TYPE_CHECKING:
    from soma_bullet.task.search.planning import Fetch, Planning
    from soma_bullet.task.workcell import Workcell

ACROSS = np.sin(np.deg2rad(15.0))  # closing axes that are off by less count as level, or as perpendicular
TILTED = 0.5  # as bad as no contact at all, for each radian that the hand is off from reaching straight down
TRIED = 12
CIRCLE = np.deg2rad(np.arange(0.0, 180.0, 15.0))  # [rad] closing axes that are looked at where none is known
TILTS = tuple(np.deg2rad((0.0, 30.0, -30.0, 50.0, -50.0)))  # [rad] of a squeezing hand about its closing axis
FLAT, SMALLEST_LINE = (
    1e-4,
    5e-3,
)  # [m] corners that are farther out by less are as far out; shortest line along a pad


@dataclass(frozen=True, eq=False)
class Square(Action):
    """A hand closes on a piece as it lies, opens again and goes back: that centres the piece between the pads
    and trues it up.

    Attributes:
        piece, arm: what, and by which arm.
        way: what tells it from other ways: numbers of the axis, of the hand among those that were looked at,
            and of the joints.
        width: distance between the pads [m]; opened: before it.
        q_before, q_grasp: joints (n,) before the approach, and after the retreat; at the grasp.
    """

    piece: str
    arm: int
    way: tuple[int, ...]
    width: float
    opened: float
    q_before: Array
    q_grasp: Array

    @property
    def identity(self) -> Identity:
        return "square", self.piece, self.arm, *self.way

    @property
    def regrasps(self) -> bool:
        return True

    def steps(self, cell: Workcell, state: CellState) -> Steps:
        who = self.arm, self.piece
        state = yield from close(cell, *who, self.q_before, self.q_grasp, self.width, self.opened)
        return (yield from leave(cell, state, *who, self.q_before))


# --- planning -----------------------------------------------------------------------------------------------


class SquaresKey(NamedTuple):
    """Of how a piece is squared before an arm picks it by a grip."""

    placed: frozenset[str]
    stance: Stance
    arm: int
    grip: Grip
    excluded: frozenset[Identity]


def candidates(planning: Planning, fetch: Fetch, arm: int, axes: list[Array]) -> list[tuple[int, Grip]]:
    """Hands of an arm that square a piece across the known axes, best first, each with its number."""
    graph, source = planning.graph(fetch.piece), fetch.source
    clear = planning.clear_at(fetch, source) & planning.usable(fetch.piece, arm)
    grips = squaring_grips(graph, clear, source.pose, axes, planning.sizes)
    squeezing = squeezing_grips(graph.piece, planning.workcell.hand(arm), source.pose, axes, planning.sizes)
    if squeezing:
        free = planning.clear_hands(fetch, source, arm, squeezing)
        grips += [grip for grip, is_free in zip(squeezing, free, strict=True) if is_free]
    return list(enumerate(grips))


def check(planning: Planning, fetch: Fetch, arm: int, grip: Grip, pick: Pick) -> tuple[Square, ...]:
    """What makes the place of a piece of the feed exact before an arm picks it; nothing where it is exact
    already."""
    if not planning.feed.square or not planning.off(fetch.piece):
        return ()
    ruled_out = frozenset(entry for entry in planning.excluded.actions if entry[0] == "square")
    key = SquaresKey(fetch.state.placed, fetch.state.stance, arm, grip, ruled_out)
    return planning.squares.get(key, lambda: _squares(planning, fetch, arm, grip, pick))


def _squares(planning: Planning, fetch: Fetch, arm: int, grip: Grip, pick: Pick) -> tuple[Square, ...]:
    source, found = fetch.source.pose, list[Square]()
    axes = level_axes((source @ grip.T_piece_tcp)[:3, 0])
    while len(axes) < 2:
        for number, other in candidates(planning, fetch, arm, axes):
            square = _square(planning, fetch, arm, other, (len(found), number), pick)
            if square is not None:
                found.append(square)
                axes.append((source @ other.T_piece_tcp)[:3, 0])
                break
        else:
            planning.lines.refuse(fetch.piece, "no grasp squares it; taken as seen")
            return ()
    return tuple(found)


def _square(
    planning: Planning, fetch: Fetch, arm: int, grip: Grip, number: tuple[int, ...], pick: Pick
) -> Square | None:
    """How an arm squares the piece by a grasp: by the branch that is nearest to how it picks it then."""
    robot, spot = planning.robot, fetch.source
    T, state = spot.pose @ grip.T_piece_tcp, fetch.state.gripping(arm, fetch.piece)
    arriving = opened_at(planning, fetch, state, spot, arm, grip)
    solutions = sorted(
        robot.inverse(arm, T, pick.q_pick), key=lambda q: float(np.abs(q - pick.q_pick).max().round(9))
    )
    way_out = planning.workcell.hand(arm).way_out
    for branch, q in enumerate(solutions):
        line = planning.lines.line("approach to square", arriving, q, T, -T[:3, 2], way_out)
        if line is not None:
            joints = readonly(line[-1]), readonly(line[0])
            square = Square(fetch.piece, arm, (*number, branch), grip.width, arriving.width, *joints)
            if square.identity not in planning.excluded.actions:
                return square
    return None


def level_axes(closing: Array) -> list[Array]:
    """The axis (3,) along which a grasp centres on the table; none where it closes upwards."""
    return [closing] if abs(closing[2]) < ACROSS else []


def squaring_grips(
    graph: GraspGraph, clear: Mask, T_world_piece: Array, known: list[Array], sizes: Sizes
) -> list[Grip]:
    """Clear grasps (mask of n) that centre a piece on the table across the known axes, best first.

    The hand should reach down, with the pads well on the faces and the line of closing near the centre of
    mass, so that the piece is not turned on the way."""
    tcp = T_world_piece @ graph.poses
    closing = tcp[:, :3, 0]
    fit = clear & (np.abs(closing[:, 2]) < ACROSS)
    for axis in known:
        fit &= np.abs(closing @ axis) < ACROSS
    aside = np.linalg.norm(
        np.cross(closing, apply(T_world_piece, graph.piece.center_of_mass) - tcp[:, :3, 3]), axis=1
    )
    tilt = np.arccos(np.clip(-tcp[:, 2, 2], -1.0, 1.0))
    indices = np.flatnonzero(fit)
    cost = (aside / sizes.askew + TILTED * tilt - graph.contact)[indices]
    return [graph.grip(g) for g in spread(graph.poses, indices, cost)[:TRIED]]


def squeezing_grips(
    piece: Workpiece, hand: Hand, T_world_piece: Array, known: list[Array], sizes: Sizes
) -> list[Grip]:
    """Hands that squeeze a piece on the table between its outermost faces or edges across the known axes,
    best first.

    They need no parallel faces, since nothing is lifted: outermost lines along the pads on both sides will
    do."""
    axes = (
        [np.cross((0.0, 0.0, 1.0), known[0])]
        if known
        else [np.array((np.cos(a), np.sin(a), 0.0)) for a in CIRCLE]
    )
    corners = apply(T_world_piece, piece.vertices)
    found: list[tuple[float, int, Grip]] = []
    com = apply(T_world_piece, piece.center_of_mass)
    for axis in axes:
        axis = axis / np.linalg.norm(axis)
        along = np.array((-axis[1], axis[0], 0.0))  # the pads
        across = corners @ axis
        sides = [corners[across < across.min() + FLAT], corners[across > across.max() - FLAT]]
        low = max(float((side @ along).min()) for side in sides)
        high = min(float((side @ along).max()) for side in sides)
        bottom, top = (
            max(float(side[:, 2].min()) for side in sides),
            min(float(side[:, 2].max()) for side in sides),
        )
        width = float(np.ptp(across))
        if high - low < SMALLEST_LINE or width > hand.opening or bottom - top > hand.pad_size[1] / 2:
            continue
        place = float(np.clip(com @ along, low, high))
        for tilt, back in product(TILTS, (1.0, -1.0)):
            approach = np.cos(tilt) * np.array((0.0, 0.0, -1.0)) + np.sin(tilt) * along
            rotation = np.column_stack([back * axis, np.cross(approach, back * axis), approach])
            reach = (
                float(np.abs(rotation[2, 1:]) @ hand.pad_size) / 2 + SUPPORT_MARGIN + FLAT
            )  # of a pad below its middle
            height = max(reach, (bottom + top) / 2)
            centre = axis * (across.min() + across.max()) / 2 + along * place + np.array((0.0, 0.0, height))
            T = inverse(T_world_piece) @ make_transform(rotation, centre)
            aside = abs(place - float(com @ along))
            found.append(
                (
                    round(aside / sizes.askew + TILTED * abs(tilt), 9),
                    len(found),
                    Grip(None, readonly(T), width, 1.0),
                )
            )
    found.sort(key=lambda item: item[:2])
    return [grip for _, _, grip in found]
