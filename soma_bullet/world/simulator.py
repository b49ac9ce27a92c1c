"""What a world offers to what runs a program in it: commands, measurements, and a record for the log.

A simulator is any object with these members; PyBullet is one of them. It is told joint targets and hand
commands, nothing else, and tells what a real cell would know. What only the log may know stands apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from soma_bullet.frames import Array
from soma_bullet.robot.model import Cell

Contact = tuple[
    int, int, float, float
]  # two bodies, as indices into the names; normal force [N]; distance [m]


@dataclass(frozen=True)
class Names:
    """What a log calls things.

    Attributes:
        joints: all joints that move; pieces; bodies: all that can touch anything.
    """

    joints: tuple[str, ...]
    pieces: tuple[str, ...]
    bodies: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Sample:
    """One moment of a world of a arms, n pieces and j joints.

    Attributes:
        joints: (j,) [rad, m]; targets: commanded joints of all arms, one after the other (t,) [rad].
        places: of the pieces (n, 7), as the simulator has them: `poses` makes them poses of the pieces.
        tcps: T_world_tcp as position and quat_xyzw (a, 7).
        wrenches: at the wrists (a, 6) [N, N m]; grips: force on the pads of each hand (a,) [N].
        contacts: of bodies that touch.
    """

    joints: Array
    targets: Array
    places: Array
    tcps: Array
    wrenches: Array
    grips: Array
    contacts: Sequence[Contact]


class Upkeep(Protocol):
    """What a simulator does to its contacts while an arm carries a piece along a path."""

    def at(self, sample: int) -> None:
        """The path is at a sample, which has not been commanded yet."""


class Arms(Protocol):
    """Commands."""

    def command_arm(self, arm: int, q: Array) -> None:
        """Joint targets (n,) [rad] of one arm for the next sample."""

    def grip_force(self, arm: int) -> float:
        """With which a hand grips [N]."""

    def squeeze(self, arm: int, force: float) -> None:
        """Close with a force [N] and keep squeezing; told so again, squeeze with another force."""

    def open_hand(self, arm: int, opening: float, speed: float = ...) -> None:
        """Move the pads to a distance of `opening` [m], each at up to `speed` [m/s]."""

    def target(self, arm: int) -> Array:
        """Joint targets (n,) [rad] that an arm was told last."""


class Sensors(Protocol):
    """What a real cell would know."""

    @property
    def time(self) -> float:
        """[s] since the start."""

    def measured_joints(self) -> tuple[Array, ...]:
        """Joints (n,) [rad] of each arm."""

    def openings(self) -> Array:
        """Distances between the pads (arms,) [m]."""

    def felt_grip(self, arm: int) -> float:
        """Force with which what is between the pads of a hand presses them apart [N]."""

    def load(self, arm: int) -> Array:
        """Force on a hand [N], and torque about its centre between the pads [N m], as the wrist feels them
        (6,), in the axes of the world."""


class Simulator(Arms, Sensors, Protocol):
    """A world whose clock runs."""

    @property
    def cell(self) -> Cell:
        """What is in it, beside the pieces."""

    @property
    def names(self) -> Names:
        """What the log calls things."""

    def advance(self) -> None:
        """Let one sample of a trajectory pass, with the commands as they are."""

    def upkeep(self, arm: int, piece: str, samples: int) -> Upkeep:
        """What keeps the contacts of a hand with the piece that it carries along a path of so many
        samples."""

    def piece_poses(self) -> dict[str, Array]:
        """T_world_piece (4, 4) of every piece: for the log, and for a sensing step."""

    def sample(self) -> Sample:
        """The moment, for the log."""

    def poses(self, places: Array) -> Array:
        """T_world_piece (m, n, 4, 4) of m times the places of the pieces."""

    def constraints(self) -> tuple[str, ...]:
        """Every constraint that is in the world now."""

    def close(self) -> None:
        """Free it."""
