"""Arms, hands, table and stand of a cell, as its file describes them.

In the composed URDF (`compose.py`) links and joints carry their arm's prefix: `left_tool0`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from soma_bullet.errors import InputError
from soma_bullet.frames import Array, readonly
from soma_bullet.grasp.hand import Hand
from soma_bullet.grasp.hand_set import HandSet


@dataclass(frozen=True)
class MeshSwap:
    """Meshes that replace a link's own; `origin` (4, 4) is None where they stand as the link's first one
    stood."""

    meshes: tuple[Path, ...]
    origin: Array | None


@dataclass(frozen=True)
class ArmModel:
    """An arm's URDF and what to change in it; names as in that URDF.

    Attributes:
        lower, upper [rad]; velocity [rad/s]; acceleration [rad/s^2]; effort [N m]: each (n,), ordered as
        `joints`.
        collision, visual, colours: per link, what replaces its meshes, and its rgb (0..1).
    """

    name: str
    urdf: Path
    base_link: str
    tool_link: str
    joints: tuple[str, ...]
    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    effort: Array
    collision: Mapping[str, MeshSwap]
    visual: Mapping[str, MeshSwap]
    colours: Mapping[str, tuple[float, ...]]


@dataclass(frozen=True)
class Arm:
    """One arm of the cell with its hand. All names are those of the composed URDF.

    Attributes:
        T_world_base (4, 4): the arm's base link in the world.
        q_home (n,) [rad], ordered as `joint_names`, as all limits are.
    """

    name: str
    model: ArmModel
    hand: Hand
    T_world_base: Array
    q_home: Array

    def prefixed(self, name: str) -> str:
        """The name in the composed URDF of a link or joint of this arm or of its hand."""
        return f"{self.name}_{name}"

    @property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(self.prefixed(joint) for joint in self.model.joints)

    @property
    def lower(self) -> Array:
        """Lower joint limits (n,) [rad]."""
        return self.model.lower

    @property
    def upper(self) -> Array:
        """Upper joint limits (n,) [rad]."""
        return self.model.upper

    @property
    def velocity(self) -> Array:
        """Largest joint velocities (n,) [rad/s]."""
        return self.model.velocity

    @property
    def acceleration(self) -> Array:
        """Largest joint accelerations (n,) [rad/s^2]."""
        return self.model.acceleration

    @property
    def effort(self) -> Array:
        """Largest joint torques (n,) [N m]."""
        return self.model.effort

    @property
    def tool_link(self) -> str:
        """The link that the hand's mount link is fixed to, with the identity."""
        return self.prefixed(self.model.tool_link)

    @property
    def tcp_link(self) -> str:
        return self.prefixed(self.hand.tcp_link)

    @property
    def finger_joints(self) -> tuple[str, str]:
        first, second = self.hand.finger_joints
        return self.prefixed(first), self.prefixed(second)

    @property
    def finger_links(self) -> tuple[str, str]:
        first, second = self.hand.finger_links
        return self.prefixed(first), self.prefixed(second)


@dataclass(frozen=True)
class Slab:
    """A box of the cell: size (3,) and centre (2,) in x and y [m]; the table's top is z = 0, the stand's
    bottom."""

    size: Array
    centre: Array
    colour: tuple[float, ...]


@dataclass(frozen=True)
class Cell:
    """A described cell; lengths in m, angles in rad.

    Attributes:
        stand_height, stand_centre (2,): the top of the stand, which the assembly stands on; its width is the
            assembly's.
        feed_areas (k, 2, 2): each ((x_min, x_max), (y_min, y_max)) on the table.
        never_checked: pairs of link names that are not checked for collision, beside joint neighbours.
    """

    name: str
    path: Path
    arms: tuple[Arm, ...]
    table: Slab
    stand_height: float
    stand_centre: Array
    stand_colour: tuple[float, ...]
    feed_areas: Array
    never_checked: tuple[tuple[str, str], ...]

    def arm(self, name: str) -> Arm:
        """The arm of that name."""
        for arm in self.arms:
            if arm.name == name:
                return arm
        raise InputError(self.name, f"has no arm {name!r}; it has {', '.join(arm.name for arm in self.arms)}")

    @cached_property
    def hands(self) -> HandSet:
        """The arms' hands, in the order of the arms."""
        return HandSet.of([arm.hand for arm in self.arms])

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """All arm joints, arm after arm."""
        return tuple(name for arm in self.arms for name in arm.joint_names)

    @cached_property
    def q_home(self) -> Array:
        """All arms' home, in the order of `joint_names`."""
        return readonly(np.concatenate([arm.q_home for arm in self.arms]))
