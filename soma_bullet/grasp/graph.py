"""The grasp graph of a piece: which grasps serve in which resting pose, and which pairs of hands may hold it
together.

Nodes are the steady resting poses and the goal; two nodes are joined by the grasps that serve at both
(P. Tournassoud et al., "Regrasping", ICRA 1987; W. Wan, K. Harada, "Regrasp planning using 10,000 grasps",
2016). A put-down goes from node to node, a hand-over from grasp to grasp.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from soma_bullet.assembly.resting import steady_poses
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.frames import Array, Indices, Mask
from soma_bullet.grasp.clearance import OPENING, SUPPORT_MARGIN, HandSweep, hands_clear, sweep_hands
from soma_bullet.grasp.hand_set import HandSet


@dataclass(frozen=True, eq=False)
class Grip:
    """One grasp of a piece.

    Attributes:
        index: in the piece's table, None for a hand that squeezes without lifting.
        T_piece_tcp: (4, 4).
        width: distance between the pads [m].
        contact: fraction of the pad on the piece.
    """

    index: int | None
    T_piece_tcp: Array
    width: float
    contact: float

    @property
    def number(self) -> int:
        """Its index in the piece's table."""
        assert self.index is not None
        return self.index


class GraspGraph:
    """One piece, its table of grasps, and the hands; its parts are computed when they are asked for, and
    once.

    Args:
        poses: T_piece_tcp (n, 4, 4); widths (n,) [m]; contact: fraction of the pad on the piece (n,).
        kinds: of the hand (n,), as in the set of hands.
    """

    def __init__(
        self, piece: Workpiece, hands: HandSet, poses: Array, widths: Array, contact: Array, kinds: Indices
    ):
        self.piece, self.hands = piece, hands
        self.poses, self.widths, self.contact, self.kinds = poses, widths, contact, kinds
        self._meets: dict[int, Mask] = {}
        self._grips: dict[int, Grip] = {}

    def __len__(self) -> int:
        return len(self.widths)

    def grip(self, index: int) -> Grip:
        """A grasp of the table; the same object each time."""
        if index not in self._grips:
            width, contact = float(self.widths[index]), float(self.contact[index])
            self._grips[index] = Grip(index, self.poses[index], width, contact)
        return self._grips[index]

    @cached_property
    def resting(self) -> Array:
        """T_plane_piece (k, 4, 4) of the steady resting poses."""
        return steady_poses(self.piece)

    @cached_property
    def serving(self) -> Mask:
        """Whether the hand is clear of the plane in each resting pose by each grasp: bool (k, n)."""
        rows = [self.above_table(pose) for pose in self.resting]
        return np.array(rows, bool).reshape(len(self.resting), len(self))

    def above_table(self, T_table_piece: Array) -> Mask:
        """Whether the hand is clear of the table by each grasp with the piece at a pose: bool (n,)."""
        return np.asarray(self.sweep(T_table_piece).above(0.0) > SUPPORT_MARGIN)

    @cached_property
    def openings(self) -> Array:
        """Widest distance between the pads of each grasp's hand (n,) [m]."""
        return np.array([hand.opening for hand in self.hands.kinds])[self.kinds]

    def usable(self, arm: int) -> Mask:
        """Which grasps are those of an arm's hand: bool (n,)."""
        return np.asarray(self.kinds == self.hands.arms[arm])

    def sweep(
        self,
        T_piece: Array,
        indices: Indices | slice = slice(None),
        opening: float = OPENING,
        way_out: float | None = None,
        sweep: Array | None = None,
    ) -> HandSweep:
        """The hands at some grasps with the piece at a pose (4, 4); see `sweep_hands`."""
        Ts, widths = T_piece @ self.poses[indices], self.widths[indices]
        return sweep_hands(self.hands, self.kinds[indices], Ts, widths, opening, way_out, sweep)

    def together(self, index: int) -> Mask:
        """Which grasps (n,) another hand may have at the same time as one hand has this one, on their ways in
        and out too."""
        if index not in self._meets:
            here = np.eye(4)
            clear = hands_clear(self.sweep(here), self.sweep(here, np.array([index])))[:, 0]
            self._meets[index] = clear & self.hands.pairs[self.kinds, self.kinds[index]]
        return self._meets[index]

    def nearest(self, T_piece_tcp: Array, among: Mask) -> tuple[int, float, float]:
        """The grasp nearest to a hand's pose on the piece (4, 4), and how far it is off: index, [m], [rad].

        The two fingers may be swapped.

        Args:
            among: which grasps count (n,).
        """
        distance = np.linalg.norm(self.poses[:, :3, 3] - T_piece_tcp[:3, 3], axis=1)
        turned = [T_piece_tcp[:3, :3] @ np.diag(signs) for signs in ((1, 1, 1), (-1, -1, 1))]
        traces = [np.einsum("nij,ij->n", self.poses[:, :3, :3], rotation) for rotation in turned]
        angle = np.arccos(np.clip((np.max(traces, axis=0) - 1) / 2, -1, 1))
        far = np.round(distance / 0.01 + angle / 0.3, 9)
        k = int(np.argmin(np.where(among, far, np.inf)))
        return k, float(distance[k]), float(angle[k])
