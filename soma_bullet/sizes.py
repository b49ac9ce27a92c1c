"""Lengths and forces that depend on how large workpieces, hands and arms are: the one place that has them.

The values were measured with Soma pieces of 28 to 36 mm and 13 to 18 g, in a hand with fingers of 73 mm
on a UR5e. They hold as they are for about that size. Larger or smaller pieces, hands and arms scale them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

SMALLEST, LARGEST = 0.026, 0.040  # [m] median radius of pieces for which the values hold as they are
FINGER = 0.073  # [m] from the pads' centre to the palm of the hand for which way_out holds as it is
ARM = 1.1815  # [m] from shoulder to pads of the stretched arm for which the values of Reach hold as they are
CLEAR = 5e-4  # [m] that bodies keep from each other on their ways which do not touch in the end
LEAST, MOST = 0.4, 3.0  # factors beyond which nothing scales: no hand and no wrist is so fine, or so strong


@dataclass(frozen=True)
class Sizes:
    """What scales with the workpieces of one assembly.

    Lengths grow with the pieces. Forces grow likewise: what a piece's weight resists grows with the cube of
    its size, what a pad bears before the piece turns in the hand falls with its lever.

    Attributes:
        scale: of lengths and forces; 1 for Soma pieces.
    """

    scale: float

    @classmethod
    def of(cls, radii: Sequence[float]) -> Sizes:
        """Of pieces with the given radii [m]: the largest distance of a vertex from the centre of mass."""
        middle = float(np.median(radii))
        scale = middle / np.clip(middle, SMALLEST, LARGEST)
        return cls(float(np.clip(scale, LEAST, MOST)))

    @cached_property
    def run_in(self) -> float:
        """Insertion beyond the piece's own size [m]."""
        return 0.012 * self.scale

    @cached_property
    def lift(self) -> float:
        """Straight up from the table, and down to it [m]."""
        return 0.06 * self.scale

    @cached_property
    def place(self) -> float:
        """The end of an insertion, which is slowest and guarded [m]."""
        return 0.010 * self.scale

    @cached_property
    def near(self) -> float:
        """A piece that is nearer to another may meet it [m]."""
        return 1e-3 * self.scale

    @cached_property
    def before_near(self) -> float:
        """Slow insertion before it comes so near [m]."""
        return 3e-3 * self.scale

    @cached_property
    def beyond(self) -> float:
        """How far a guarded line goes on beyond its end until it meets what carries the piece [m]."""
        return 1.5e-3 * self.scale

    @cached_property
    def fall(self) -> float:
        """The last way straight down of what comes in at a slant [m]."""
        return 1e-3 * self.scale

    @cached_property
    def jam(self) -> float:
        """A guarded motion that stops farther from its end is jammed [m]."""
        return 1e-3 * self.scale

    @cached_property
    def seated(self) -> float:
        """A guided motion that meets resistance nearer to its end has arrived [m]."""
        return 0.35e-3 * self.scale

    @cached_property
    def empty(self) -> float:
        """Pads nearer to each other than a piece's width less this hold nothing [m]."""
        return 2e-3 * self.scale

    @cached_property
    def shut(self) -> float:
        """Pads nearer to each other have nothing between them [m]."""
        return 0.5e-3 * self.scale

    @cached_property
    def displaced(self) -> float:
        """A placed piece that is seen farther from its goal is placed again, if nothing lies on it [m]."""
        return 1.5e-3 * self.scale

    @cached_property
    def fallen(self) -> float:
        """A placed piece that is seen farther from its goal has fallen [m]."""
        return 5e-3 * self.scale

    @cached_property
    def gone(self) -> float:
        """A piece that a hand would have to move farther for is not in the hand any more [m]."""
        return 15e-3 * self.scale

    @cached_property
    def aside(self) -> float:
        """From a grasp to the centre of mass: costs as much as a pad of which nothing is on it [m]."""
        return 0.03 * self.scale

    @cached_property
    def askew(self) -> float:
        """From a line of closing on the table to the centre of mass: as bad as no contact at all [m]."""
        return 0.010 * self.scale

    @cached_property
    def rim(self) -> float:
        """Of the stand around the assembly's footprint [m]."""
        return 0.005 * self.scale

    @cached_property
    def smallest_stand(self) -> float:
        """Side of the stand where the footprint is narrower [m]."""
        return 0.03 * self.scale

    @cached_property
    def apart(self) -> float:
        """Between the outlines of two pieces of a feed [m]."""
        return 0.010 * self.scale

    @cached_property
    def room(self) -> float:
        """Between a piece that is put down and others [m]."""
        return 0.02 * self.scale

    @cached_property
    def guard(self) -> float:
        """Change of the wrist's force that ends a placing [N]."""
        return 1.0 * self.scale

    @cached_property
    def touch(self) -> float:
        """The same on the last way straight down: pressed on with more, a piece pivots in the hand [N]."""
        return 0.3 * self.scale

    @cached_property
    def leaning(self) -> float:
        """With which a guided piece may lean on what it slides by [N]."""
        return 0.06 * self.scale

    @cached_property
    def resting(self) -> float:
        """With which a piece rests that the hand does not press on [N]."""
        return 0.15 * self.scale


@dataclass(frozen=True)
class Reach:
    """What scales with an arm.

    Attributes:
        scale: of lengths; 1 for a UR5e with a slim hand.
    """

    scale: float

    @classmethod
    def of(cls, length: float) -> Reach:
        """Of an arm that is so long [m] from its shoulder to the pads."""
        return cls(round(length / ARM, 3))

    @cached_property
    def near(self) -> float:
        """A hand nearer to the arm's base is awkward [m]."""
        return 0.30 * self.scale

    @cached_property
    def far(self) -> float:
        """A hand farther from the arm's base is awkward [m]."""
        return 0.65 * self.scale

    @cached_property
    def wrist(self) -> float:
        """From the pads back to the wrist [m]."""
        return 0.25 * self.scale

    @cached_property
    def own_side(self) -> float:
        """A wrist that is no nearer to the stand's middle is in no other arm's way [m]."""
        return 0.05 * self.scale

    @cached_property
    def meeting_sides(self) -> tuple[float, float]:
        """Where two hands meet: beside the stand [m], the best first."""
        return 0.30 * self.scale, 0.18 * self.scale

    @cached_property
    def meeting_heights(self) -> tuple[float, float]:
        """Where two hands meet: above the table [m], the best first."""
        return 0.24 * self.scale, 0.34 * self.scale


def way_out(finger: float) -> float:
    """How far a hand goes straight to a grasp and back from it [m], by the length of its fingers [m]."""
    return 0.06 * (finger / FINGER)
