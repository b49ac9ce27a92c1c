"""Clearance of the hand: its boxes at many grasps, along the way out and along an insertion, in one call
each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from soma_bullet.assembly.hulls import Hull, box_hull
from soma_bullet.assembly.separation import pair_separation, plane_separation, zonotope_separation
from soma_bullet.frames import Array, Mask
from soma_bullet.grasp.hand import Box, Hand

OPENING = 0.004  # [m] a side by which a hand opens to let go
WAY_OUT = 0.06  # [m] straight back along the approach direction
MARGIN = 1e-3  # [m] kept to placed pieces and to other hands
SUPPORT_MARGIN = 2e-3  # [m] kept to the support
MOST_PAIRS = 20_000  # of boxes that are looked at together, for the sake of memory
TOUCH = 1e-4  # [m] the pads touch the piece that they grip


@dataclass(frozen=True, eq=False)
class HandSweep:
    """The hand's boxes at n grasps, each swept: b zonotopes a grasp.

    Attributes:
        centres: (b, n, 3) [m].
        generators: (b, n, g, 3) [m], half extents and half sweeps.
    """

    centres: Array
    generators: Array

    def separation(self, hulls: Sequence[Hull]) -> Array:
        """Smallest gap (n,) [m] between any box and any polytope; negative is a penetration."""
        boxes, grasps, generators, _ = self.generators.shape
        gaps = zonotope_separation(
            self.centres.reshape(-1, 3), self.generators.reshape(-1, generators, 3), hulls
        )
        return gaps.reshape(boxes, grasps).min(axis=0)

    def take(self, hands: slice) -> HandSweep:
        """Some of the hands."""
        return HandSweep(self.centres[:, hands], self.generators[:, hands])

    def above(self, height: float) -> Array:
        """Smallest gap (n,) [m] to the half-space below `height`."""
        return np.min(
            [plane_separation(c, g, height) for c, g in zip(self.centres, self.generators, strict=True)],
            axis=0,
        )


def sweep_hand(
    hand: Hand,
    Ts_tcp: Array,
    widths: Array,
    opening: float = OPENING,
    way_out: float = WAY_OUT,
    sweep: Array | None = None,
    gap: float = 0.0,
) -> HandSweep:
    """The hand at TCP poses (n, 4, 4) gripping widths (n,) [m], from closed to open by `opening` [m] a side.

    Args:
        way_out: the boxes reach this far back along the approach direction [m].
        sweep: they are also swept by this vector (3,) [m] of the outer frame, from the grasp on.
        gap: the sweep starts with the pads this far off the piece [m] a side.
    """
    zeros = np.zeros(len(widths))
    boxes: list[tuple[Array, Array]] = []
    boxes += [_swept_box(box, zeros, zeros, way_out) for box in hand.palm_boxes]
    boxes += [_swept_box(box, widths / 2 + gap, widths / 2 + opening, way_out) for box in hand.left_boxes]
    boxes += [_swept_box(box, -widths / 2 - opening, -widths / 2 - gap, way_out) for box in hand.right_boxes]
    centres, generators = [], []
    for local_centres, local_generators in boxes:
        rotation = Ts_tcp[:, :3, :3]
        centre = np.einsum("nij,nj->ni", rotation, local_centres) + Ts_tcp[:, :3, 3]
        generator = np.einsum("nij,ngj->ngi", rotation, local_generators)
        if sweep is not None:
            centre = centre + sweep / 2
            generator = np.concatenate([generator, np.broadcast_to(sweep / 2, (len(widths), 1, 3))], axis=1)
        centres.append(centre)
        generators.append(generator)
    return HandSweep(np.array(centres), np.array(generators))


def _swept_box(box: Box, x_low: Array, x_high: Array, way_out: float) -> tuple[Array, Array]:
    """A hand box whose x travels over [x_low, x_high] (n,) and whose z reaches back by way_out: centres,
    generators."""
    n = len(x_low)
    centre = np.tile(box.T[:3, 3], (n, 1))
    centre[:, 0] += (x_low + x_high) / 2
    centre[:, 2] -= way_out / 2
    axes = box.T[:3, :3].T * box.half[:, None]
    if np.allclose(np.abs(box.T[:3, :3]), np.eye(3), atol=1e-9):  # stays a box
        generators = np.zeros((n, 3, 3))
        generators[:, 0, 0] = box.half[0] + (x_high - x_low) / 2
        generators[:, 1, 1] = box.half[1]
        generators[:, 2, 2] = box.half[2] + way_out / 2
        return centre, generators
    generators = np.zeros((n, 5, 3))
    generators[:, :3] = axes
    generators[:, 3, 0] = (x_high - x_low) / 2
    generators[:, 4, 2] = way_out / 2
    return centre, generators


def hands_clear(first: HandSweep, second: HandSweep) -> Mask:
    """Which of a swept hands keep their margin to which of b others: bool (a, b)."""
    (boxes_a, a), (boxes_b, b) = first.centres.shape[:2], second.centres.shape[:2]
    if boxes_a * a * boxes_b * b > MOST_PAIRS and a > 1:  # in two halves
        return np.vstack(
            [
                hands_clear(first.take(slice(a // 2)), second),
                hands_clear(first.take(slice(a // 2, a)), second),
            ]
        )
    # every box of either in one call
    flat = [
        (s.centres.reshape(-1, 3), s.generators.reshape(-1, *s.generators.shape[2:])) for s in (first, second)
    ]
    gaps = pair_separation(flat[0], flat[1]).reshape(boxes_a, a, boxes_b, b)
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


def clear_of_piece(hand: Hand, Ts_tcp: Array, widths: Array, parts: Sequence[Hull]) -> Mask:
    """Which of n grasps (TCP poses in the parts' frame) keep the hand out of the gripped piece itself: bool
    (n,).

    Only the pads touch it: the flank of a finger along another face would drag the piece along when the hand
    opens."""
    return sweep_hand(hand, Ts_tcp, widths, gap=MARGIN).separation(parts) > MARGIN - TOUCH


def clear_of_scene(sweep: HandSweep, hulls: Sequence[Hull], support_height: float | None) -> Mask:
    """Which of n swept hands keep their margins to polytopes and to the support: bool (n,)."""
    clear = sweep.separation(hulls) > MARGIN
    if support_height is not None:
        clear &= sweep.above(support_height) > SUPPORT_MARGIN
    return clear
