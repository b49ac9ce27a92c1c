"""Clearance of hands: their boxes at many grasps, along the way out and along an insertion, in one call
each. Hands of several kinds go together: the boxes of each kind are looked at in one piece."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from soma_bullet.assembly.hulls import Hull, box_hull
from soma_bullet.assembly.separation import pair_separation, plane_separation, zonotope_separation
from soma_bullet.frames import Array, Indices, Mask
from soma_bullet.grasp.hand import Box, Hand
from soma_bullet.grasp.hand_set import HandSet

OPENING = 0.004  # [m] a side by which a hand opens to let go
MARGIN = 1e-3  # [m] kept to placed pieces and to other hands
SUPPORT_MARGIN = 2e-3  # [m] kept to the support
MOST_PAIRS = 20_000  # of boxes that are looked at together, for the sake of memory
TOUCH = 1e-4  # [m] the pads touch the piece that they grip


@dataclass(frozen=True, eq=False)
class SweptBoxes:
    """The boxes of hands of one kind, each swept: b zonotopes a hand.

    Attributes:
        rows: which hands of the sweep these are (k,).
        centres: (b, k, 3) [m].
        generators: (b, k, g, 3) [m], half extents and half sweeps.
    """

    rows: Indices
    centres: Array
    generators: Array

    def take(self, some: slice) -> SweptBoxes:
        """Some of the hands."""
        return SweptBoxes(self.rows[some], self.centres[:, some], self.generators[:, some])

    def flat(self) -> tuple[Array, Array]:
        """Centres (b * k, 3) and generators (b * k, g, 3) of all zonotopes [m]."""
        return self.centres.reshape(-1, 3), self.generators.reshape(-1, *self.generators.shape[2:])


@dataclass(frozen=True, eq=False)
class HandSweep:
    """n hands at grasps, each swept.

    Attributes:
        count: n.
        groups: the boxes, one group for each kind of hand; each hand is in one group.
    """

    count: int
    groups: tuple[SweptBoxes, ...]

    def __len__(self) -> int:
        return self.count

    def separation(self, hulls: Sequence[Hull]) -> Array:
        """Smallest gap (n,) [m] between any box and any polytope; negative is a penetration."""
        gaps = np.full(self.count, np.inf)
        for group in self.groups:
            boxes, hands = group.centres.shape[:2]
            gaps[group.rows] = zonotope_separation(*group.flat(), hulls).reshape(boxes, hands).min(axis=0)
        return gaps

    def above(self, height: float) -> Array:
        """Smallest gap (n,) [m] to the half-space below `height`."""
        gaps = np.full(self.count, np.inf)
        for group in self.groups:
            boxes = zip(group.centres, group.generators, strict=True)
            gaps[group.rows] = np.min([plane_separation(c, g, height) for c, g in boxes], axis=0)
        return gaps


def sweep_hands(
    hands: HandSet,
    kinds: Indices,
    Ts_tcp: Array,
    widths: Array,
    opening: float = OPENING,
    way_out: float | None = None,
    sweep: Array | None = None,
    gap: float = 0.0,
) -> HandSweep:
    """Hands of some kinds (n,) at TCP poses (n, 4, 4) gripping widths (n,) [m], from closed to open by
    `opening` [m] a side.

    Args:
        way_out: the boxes reach this far back along the approach direction [m]; None for the hand's own way.
        sweep: they are also swept by this vector (3,) [m] of the outer frame, from the grasp on.
        gap: the sweep starts with the pads this far off the piece [m] a side.
    """
    groups = []
    for kind in np.unique(kinds):
        rows = np.flatnonzero(kinds == kind)
        hand, Ts = hands.kinds[kind], Ts_tcp[rows]
        groups.append(SweptBoxes(rows, *_swept_boxes(hand, Ts, widths[rows], opening, way_out, sweep, gap)))
    return HandSweep(len(widths), tuple(groups))


def sweep_hand(
    hand: Hand,
    Ts_tcp: Array,
    widths: Array,
    opening: float = OPENING,
    way_out: float | None = None,
    sweep: Array | None = None,
    gap: float = 0.0,
) -> HandSweep:
    """As `sweep_hands`, all by the same hand."""
    boxes = _swept_boxes(hand, Ts_tcp, widths, opening, way_out, sweep, gap)
    return HandSweep(len(widths), (SweptBoxes(np.arange(len(widths)), *boxes),))


def _swept_boxes(
    hand: Hand,
    Ts_tcp: Array,
    widths: Array,
    opening: float,
    way_out: float | None,
    sweep: Array | None,
    gap: float,
) -> tuple[Array, Array]:
    """Centres (b, n, 3) and generators (b, n, g, 3) of one hand at n grasps; see `sweep_hands`."""
    way_out = hand.way_out if way_out is None else way_out
    zeros = np.zeros(len(widths))
    boxes: list[tuple[Array, Array]] = []
    boxes += [_swept_box(box, zeros, zeros, way_out) for box in hand.palm_boxes]
    boxes += [_swept_box(box, widths / 2 + gap, widths / 2 + opening, way_out) for box in hand.left_boxes]
    boxes += [_swept_box(box, -widths / 2 - opening, -widths / 2 - gap, way_out) for box in hand.right_boxes]
    most = max(generators.shape[1] for _, generators in boxes)
    centres, generators = [], []
    for local_centres, local_generators in boxes:
        rotation = Ts_tcp[:, :3, :3]
        centre = np.einsum("nij,nj->ni", rotation, local_centres) + Ts_tcp[:, :3, 3]
        generator = np.einsum("nij,ngj->ngi", rotation, local_generators)
        if generator.shape[1] < most:  # a turned box has two more
            missing = np.zeros((len(widths), most - generator.shape[1], 3))
            generator = np.concatenate([generator, missing], axis=1)
        if sweep is not None:
            centre = centre + sweep / 2
            generator = np.concatenate([generator, np.broadcast_to(sweep / 2, (len(widths), 1, 3))], axis=1)
        centres.append(centre)
        generators.append(generator)
    return np.array(centres), np.array(generators)


def _swept_box(box: Box, x_low: Array, x_high: Array, way_out: float) -> tuple[Array, Array]:
    """A hand box whose x travels over [x_low, x_high] (n,) and whose z reaches back by way_out: centres,
    generators."""
    n = len(x_low)
    centre = np.tile(box.T[:3, 3], (n, 1))
    centre[:, 0] += (x_low + x_high) / 2
    centre[:, 2] -= way_out / 2
    if box.aligned:  # stays a box
        generators = np.zeros((n, 3, 3))
        generators[:, 0, 0] = box.half[0] + (x_high - x_low) / 2
        generators[:, 1, 1] = box.half[1]
        generators[:, 2, 2] = box.half[2] + way_out / 2
        return centre, generators
    generators = np.zeros((n, 5, 3))
    generators[:, :3] = box.T[:3, :3].T * box.half[:, None]
    generators[:, 3, 0] = (x_high - x_low) / 2
    generators[:, 4, 2] = way_out / 2
    return centre, generators


def hands_clear(first: HandSweep, second: HandSweep) -> Mask:
    """Which of a swept hands keep their margin to which of b others: bool (a, b)."""
    clear = np.ones((len(first), len(second)), bool)
    for one in first.groups:
        for other in second.groups:
            clear[np.ix_(one.rows, other.rows)] = _boxes_clear(one, other)
    return clear


def _boxes_clear(first: SweptBoxes, second: SweptBoxes) -> Mask:
    """As `hands_clear`, of hands of one kind each."""
    (boxes_a, a), (boxes_b, b) = first.centres.shape[:2], second.centres.shape[:2]
    if boxes_a * a * boxes_b * b > MOST_PAIRS and a > 1:  # in two halves
        halves = (first.take(slice(a // 2)), first.take(slice(a // 2, a)))
        return np.vstack([_boxes_clear(half, second) for half in halves])
    # every box of either in one call
    gaps = pair_separation(first.flat(), second.flat()).reshape(boxes_a, a, boxes_b, b)
    return np.asarray(gaps.min(axis=(0, 2)) > MARGIN)


def hand_hulls(hand: Hand, T_tcp: Array, width: float) -> list[Hull]:
    """The hand's boxes at one TCP pose (4, 4), gripping `width` [m], as polytopes of the outer frame."""
    shifts = [(hand.palm_boxes, 0.0), (hand.left_boxes, width / 2), (hand.right_boxes, -width / 2)]
    hulls = []
    for boxes, shift in shifts:
        for box in boxes:
            pose = T_tcp @ box.T
            pose[:3, 3] += T_tcp[:3, 0] * shift
            hulls.append(box_hull(pose[:3, 3], pose[:3, :3].T, box.half))
    return hulls


def clear_of_piece(
    hands: HandSet, kinds: Indices, Ts_tcp: Array, widths: Array, parts: Sequence[Hull]
) -> Mask:
    """Which of n grasps (kinds of hand, and TCP poses in the parts' frame) keep the hand out of the gripped
    piece itself: bool (n,).

    Only the pads touch it: the flank of a finger along another face would drag the piece along when the hand
    opens."""
    return sweep_hands(hands, kinds, Ts_tcp, widths, gap=MARGIN).separation(parts) > MARGIN - TOUCH


def clear_of_scene(sweep: HandSweep, hulls: Sequence[Hull], support_height: float | None) -> Mask:
    """Which of n swept hands keep their margins to polytopes and to the support: bool (n,)."""
    clear = sweep.separation(hulls) > MARGIN
    if support_height is not None:
        clear &= sweep.above(support_height) > SUPPORT_MARGIN
    return clear
