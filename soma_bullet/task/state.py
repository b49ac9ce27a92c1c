"""The state of a cell at one moment: where every body is, and what every hand does.

Search, program, executive and recovery all use this one value. What changes it stands in `kinds.py`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from soma_bullet.frames import Array, inverse, readonly

Stance = tuple[tuple[int, str, tuple[float, ...]], ...]


@dataclass(frozen=True, eq=False)
class CellState:
    """Where every body is, and what every hand does.

    A body is a piece, or a group of joined pieces that goes by the name of one of them and moves as one.

    Attributes:
        poses: T_world_piece (4, 4) of every piece, also of those in hands.
        qs: joints (n,) [rad] of each arm.
        openings: distance between the pads of each hand (arms,) [m].
        gripped: arm -> body between the fingers of its hand.
        carried: arm -> T_tcp_body (4, 4) of a gripped body that moves with the hand.
        placed: the pieces that stand at their goals.
        joined: piece -> the body that it is a part of; a piece that is a body of its own is left out.
    """

    poses: Mapping[str, Array]
    qs: tuple[Array, ...]
    openings: Array
    gripped: Mapping[int, str] = field(default_factory=dict)
    carried: Mapping[int, Array] = field(default_factory=dict)
    placed: frozenset[str] = frozenset()
    joined: Mapping[str, str] = field(default_factory=dict)

    @property
    def arms(self) -> range:
        """Indices of the arms."""
        return range(len(self.qs))

    @property
    def free(self) -> tuple[int, ...]:
        """Arms whose hands hold nothing."""
        return tuple(arm for arm in self.arms if arm not in self.gripped)

    @property
    def held(self) -> dict[int, str]:
        """Arm -> piece in place that it holds."""
        return {arm: body for arm, body in self.gripped.items() if body in self.placed}

    @property
    def stance(self) -> Stance:
        """The arms that hold something, what, and their joints: equal where the same lines are free."""
        return tuple((arm, body, tuple(self.qs[arm].tolist())) for arm, body in sorted(self.gripped.items()))

    def holder(self, body: str) -> int | None:
        """The arm whose hand has a body between its fingers."""
        return next((arm for arm, name in self.gripped.items() if name == body), None)

    def members(self, body: str) -> tuple[str, ...]:
        """The pieces that a body is made of, the one that it is called after first."""
        return body, *sorted(piece for piece, root in self.joined.items() if root == body)

    def on_table(self, without: str | None = None) -> dict[str, Array]:
        """T_world_piece of what is neither in place nor `without`."""
        return {n: T for n, T in self.poses.items() if n not in self.placed and n != without}

    # --- the same, but for one thing -----------------------------------------------------------------------

    def with_arm(self, arm: int, q: Array, opening: float | None = None) -> CellState:
        """One arm is elsewhere, at joints (n,) [rad]; its hand may be as wide as `opening` [m]."""
        qs = tuple(readonly(q) if k == arm else old for k, old in enumerate(self.qs))
        if opening is None:
            return replace(self, qs=qs)
        openings = np.array(self.openings)
        openings[arm] = opening
        return replace(self, qs=qs, openings=readonly(openings))

    def gripping(self, arm: int, body: str | None) -> CellState:
        """One hand has a body between its fingers, or none."""
        kept = {hand: name for hand, name in self.gripped.items() if hand != arm}
        return replace(self, gripped=kept if body is None else {**kept, arm: body})

    def carrying(self, arm: int, T_tcp_body: Array | None) -> CellState:
        """The body that a hand has moves with it, at T_tcp_body (4, 4), or not."""
        kept = {hand: T for hand, T in self.carried.items() if hand != arm}
        return replace(self, carried=kept if T_tcp_body is None else {**kept, arm: T_tcp_body})

    def moved(self, body: str, pose: Array) -> CellState:
        """A body is at T_world_body (4, 4), and all its pieces with it."""
        poses = {**self.poses, body: pose}
        for piece in self.members(body)[1:]:
            poses[piece] = pose @ inverse(self.poses[body]) @ self.poses[piece]
        return replace(self, poses=poses)

    def placing(self, body: str) -> CellState:
        """A body, all its pieces, stands in place."""
        return replace(self, placed=self.placed | frozenset(self.members(body)))

    def joining(self, body: str, pieces: Sequence[str]) -> CellState:
        """Pieces have become a part of a body, as they are now."""
        return replace(self, joined={**self.joined, **dict.fromkeys(pieces, body)})

    def empty_handed(self, home: Sequence[Array]) -> CellState:
        """Arms that hold nothing wait at home, with closed hands."""
        state = self
        for arm in self.free:
            state = state.with_arm(arm, home[arm], 0.0)
        return state
