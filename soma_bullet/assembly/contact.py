"""A contact between two bodies, and the tolerances within which bodies touch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from soma_bullet.frames import Array

SUPPORT = -1  # index of the support where the index of a piece may stand
ANGLE_TOLERANCE = np.deg2rad(2.0)  # [rad] between opposite normals
GAP_TOLERANCE = 1e-4  # [m] beyond the fit gap, either sign


@dataclass(frozen=True, eq=False)
class Contact:
    """Where two bodies touch: a planar patch, a line, or a point.

    Attributes:
        body_a, body_b: indices of the pieces; SUPPORT for the support.
        normal: unit normal (3,) from a into b.
        points: (k, 3) [m]. Corners of a patch's convex hull, the two ends of a line, or one point: for
            wrenches they stand for all points of the contact.
        area: [m2] of the patch itself; 0 for a line and a point.
        recess_a, recess_b: how far the real body stands back from the contact along the normal, in its
            clearances: 1 at a face, more at an edge or a corner.
    """

    body_a: int
    body_b: int
    normal: Array
    points: Array
    area: float
    recess_a: float = 1.0
    recess_b: float = 1.0

    def into(self, piece: int) -> Contact:
        """The same contact with its normal pointing into `piece`."""
        if piece == self.body_b:
            return self
        return replace(
            self,
            body_a=self.body_b,
            body_b=self.body_a,
            normal=-self.normal,
            recess_a=self.recess_b,
            recess_b=self.recess_a,
        )

    @property
    def length(self) -> float:
        """Largest distance [m] between two points of the contact; 0 for a point."""
        return float(np.linalg.norm(self.points[:, None] - self.points, axis=2).max())

    @property
    def width(self) -> float:
        """Of a patch the side of a square as large, of a line its length [m]; 0 for a point."""
        return float(np.sqrt(self.area)) if self.area > 0 else self.length


def proportions(contacts: Sequence[Contact]) -> list[float]:
    """In what proportions contacts share a force that presses on all of them (k,): by area; by length where
    one has no area; alike where one has no length."""
    for sizes in ([c.area for c in contacts], [c.length for c in contacts]):
        if all(size > 0 for size in sizes):
            return sizes
    return [1.0] * len(contacts)
