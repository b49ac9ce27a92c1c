"""The hands of a cell: which different ones there are, and which of them each arm carries."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from soma_bullet.errors import InputError
from soma_bullet.frames import Mask, readonly
from soma_bullet.grasp.hand import Hand


@dataclass(frozen=True, eq=False)
class HandSet:
    """The hands of some arms. A kind is the index of one of the different hands.

    Attributes:
        kinds: the different hands.
        arms: kind of each arm's hand, in the order of the arms; every kind is that of some arm.
    """

    kinds: tuple[Hand, ...]
    arms: tuple[int, ...]

    def __post_init__(self) -> None:
        if not self.arms or set(self.arms) != set(range(len(self.kinds))):
            raise InputError(
                "hands", f"arms with hands {self.arms} do not use each of {len(self.kinds)} kinds"
            )

    @staticmethod
    def of(hands: Sequence[Hand]) -> HandSet:
        """The hands of arms, one an arm, in the order of the arms.

        Those of one URDF and equal figures are one kind."""
        kinds: list[Hand] = []
        arms = []
        for hand in hands:
            kind = next((k for k, known in enumerate(kinds) if _equal(known, hand)), len(kinds))
            if kind == len(kinds):
                kinds.append(hand)
            arms.append(kind)
        return HandSet(tuple(kinds), tuple(arms))

    @staticmethod
    def alike(hand: Hand, count: int = 2) -> HandSet:
        """The same hand on each of `count` arms."""
        return HandSet((hand,), (0,) * count)

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each arm's hand, in the order of the arms."""
        return tuple(self.kinds[kind].name for kind in self.arms)

    def of_arm(self, arm: int) -> Hand:
        """The hand of an arm."""
        return self.kinds[self.arms[arm]]

    def can(self, kinds: Iterable[int]) -> bool:
        """Whether different arms have hands of these kinds, all at once."""
        return Counter(kinds) <= Counter(self.arms)

    @cached_property
    def pairs(self) -> Mask:
        """Which two kinds different arms have at once: bool (k, k)."""
        count = range(len(self.kinds))
        return readonly(np.array([[self.can((first, second)) for second in count] for first in count]), bool)

    def at_least(self, count: int) -> HandSet:
        """This set, with further arms that carry the same hands in turn until there are `count`."""
        extra = max(0, count - len(self.arms))
        return HandSet(self.kinds, self.arms + tuple(self.arms[k % len(self.arms)] for k in range(extra)))


def _equal(first: Hand, second: Hand) -> bool:
    return first is second or (first.urdf == second.urdf and first.figures == second.figures)
