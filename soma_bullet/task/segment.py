"""A segment: one thing that one arm does, timed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from soma_bullet.frames import Array, readonly
from soma_bullet.task.kinds import Kind

DT = 1 / 480  # [s] between samples of a trajectory: the simulator's step
LEVEL, STEEP = (
    0.2,
    0.98,
)  # downward parts of the directions up to which a line is level, and beyond which steep
DOWN = readonly(np.array((0.0, 0.0, -1.0)))
UP = readonly(np.array((0.0, 0.0, 1.0)))
NOWHERE = readonly(np.zeros(3))
NO_PATH = readonly(np.zeros((0, 0)))
SMALLEST_JUMP = 1e-4  # [rad] a segment that starts farther from the measured joints is made anew
SETTLING = 0.2  # [s] after a placing
LOOKING = 0.1  # [s] that a look at the placed pieces takes
FOLLOWING = 0.5  # [s] about, until a hand that follows down is stopped
CLOSING, OPENING_TIME = 0.5, 0.3  # [s] for the hand to grip, and to let go


@dataclass(frozen=True, eq=False)
class Segment:
    """One thing that one arm does, on an arm of n joints.

    Attributes:
        kind: what it is.
        step: of the plan, None for what comes before the first; arm: index; piece: what it is about.
        path: joints every DT (m, n) [rad]; empty for waits.
        offset: straight travel of the hand (3,) [m] for lines, else zero.
        opening: distance between the pads [m] that the hand goes to, None to leave it as it is.
        duration: [s] of waits.
        guard: change of the wrist's force [N] that ends the segment, 0 for none.
        width: distance between the pads [m] that is expected after a grasp, else None.
        compliance: change of the joints for a small twist of the hand in world axes at the end of a guarded
            line (n, 6), translation [rad/m] before rotation [rad/rad]; empty for the rest.
        beyond: how far a guarded line may go on beyond its end until the piece meets what should stop it
            there [m]: a piece that sits higher in the hand than planned is not let go in the air.
        raised: how far above its path a guarded line brings the piece [m], to let it down straight at the
            end: what it comes to rest on is not rubbed along.
    """

    kind: Kind
    step: int | None
    arm: int
    piece: str
    path: Array = field(default_factory=lambda: NO_PATH)
    offset: Array = field(default_factory=lambda: NOWHERE)
    opening: float | None = None
    duration: float = 0.0
    guard: float = 0.0
    width: float | None = None
    compliance: Array = field(default_factory=lambda: NO_PATH)
    beyond: float = 0.0
    raised: float = 0.0

    @property
    def q_end(self) -> Array | None:
        """Joints (n,) at its end, None where the arm stays where it is."""
        return self.path[-1] if len(self.path) else None

    @property
    def downward(self) -> float:
        """Downward part of its direction: 1 straight down, 0 where it is level."""
        return -float(self.offset[2]) / max(float(np.linalg.norm(self.offset)), 1e-12)

    @property
    def last_way(self) -> Array:
        """Unit vector (3,) along which a line ends."""
        return DOWN if self.raised or not self.offset.any() else self.offset / np.linalg.norm(self.offset)

    @property
    def seconds(self) -> float:
        """Planned duration [s]."""
        return max(self.duration, (len(self.path) - 1) * DT if len(self.path) else 0.0)
