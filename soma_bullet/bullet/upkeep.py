"""Upkeep of the contacts between a hand and the piece that it carries: they form anew where they have grown
stale."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from soma_bullet.frames import rotation_angle

if TYPE_CHECKING:
    from soma_bullet.bullet.simulator import BulletSimulator

STALE = np.deg2rad(15.0)  # [rad] by which a hand may turn before the contacts of its pads are renewed
STALE_POINTS = np.deg2rad(7.0)  # [rad] the same where a pad touches in a few points, on which the piece rolls
EVERY = 5  # samples between looks at how far the hand has turned


class GripUpkeep:
    """Renews the contacts of one pad after the other, whenever the hand has turned, and before the path
    ends."""

    def __init__(self, world: BulletSimulator, arm: int, piece: str, samples: int):
        self.world, self.arm = world, arm
        flat = piece not in world.pieces or world.touches_flat(piece)
        self._lasting = STALE if flat else STALE_POINTS
        self._anchored, self._stale = world.tcp_pose(arm)[:3, :3], list[int]()
        self._ending = samples - 1 - EVERY * len(world.finger_links[arm])

    def at(self, sample: int) -> None:
        """The path is at a sample, which has not been commanded yet."""
        world, arm, ending = self.world, self.arm, self._ending
        if sample % EVERY and sample < ending:
            return
        turned = world.tcp_pose(arm)[:3, :3]
        if not self._stale and (rotation_angle(self._anchored, turned) > self._lasting or sample == ending):
            self._stale, self._anchored = list(range(len(world.finger_links[arm]))), turned
        if self._stale and (sample < ending or (sample - ending) % EVERY == 0):
            world.renew_contacts(arm, self._stale.pop())
