"""What a camera would see of the pieces: an explicit sensing step, as inexact as the perception of the
feed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import Array, readonly
from soma_bullet.task.feed import Feed, misplace
from soma_bullet.task.feed_options import FeedOptions
from soma_bullet.world.simulator import Simulator


class Perception:
    """Looks at the pieces; every look is logged, and errs anew.

    Args:
        seed: of the errors; feed: names the pieces; options: how exact it is.
        event: is told of each sensing step: kind, piece, words.
    """

    def __init__(
        self,
        world: Simulator,
        assembly: Assembly,
        feed: Feed,
        options: FeedOptions,
        seed: int,
        event: Callable[[str, str, str], None],
    ):
        self.world, self.assembly, self.feed, self.options = world, assembly, feed, options
        self.seed, self.event, self.count = seed, event, 0

    @property
    def noise(self) -> tuple[float, float]:
        """One sigma of the errors of a look [mm], [deg]."""
        return self.options.noise

    def looks(self, times: int) -> list[dict[str, Array]]:
        """Perceived T_world_piece (4, 4) of every piece, so many times."""
        poses, names = self.world.piece_poses(), self.feed.names
        there = replace(self.feed, poses=readonly(np.array([poses[name] for name in names])))
        numbers = range(self.count, self.count + times)
        self.count += times
        self.event("looked", "", f"{times} times" if times > 1 else "")
        looks = [misplace(self.assembly, there, self.options, self.seed, number) for number in numbers]
        return [{name: seen.pose(name) for name in names} for seen in looks]

    def look(self) -> dict[str, Array]:
        """One of them."""
        return self.looks(1)[0]
