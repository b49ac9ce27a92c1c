"""Which arm does what: arms and grasps of all steps chosen together, so that one arm can fetch while the
other inserts.

Each step has a few options: which arm fetches, which inserts, by which grasp. What one costs depends on the
one before it: the fetching is hidden behind the insertion before it only if another arm does it, and if the
two arms keep clear of each other meanwhile. The cheapest sequence is found backwards, step by step (dynamic
programming), and every option is worth what can follow it: where the best one turns out to be impossible, the
next best takes its place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from soma_bullet.frames import Array
from soma_bullet.grasp.graph import Grip
from soma_bullet.robot.silhouette import Placed, Silhouette, distance
from soma_bullet.task.workcell import Workcell

FETCHING = 3.3  # [s] of a fetch that is not hidden
CHANGE = 0.6  # [s] for one arm to leave the stand before another comes
ROOM = 0.03  # [m] between arms that are to move at the same time


@dataclass(frozen=True, eq=False)
class Option:
    """One way to do a step.

    Attributes:
        fetcher, inserter: the arms that fetch and insert the piece.
        grip: by which it is inserted.
        cost: of itself [s], whatever comes before it.
        fetching: joints (n, 6) of the fetcher at what it fetches; inserting: joints (m, 6) of the inserter at
            the goal.
    """

    fetcher: int
    inserter: int
    grip: Grip
    cost: float
    fetching: Array
    inserting: Array


@dataclass(eq=False)
class ArmAssignment:
    """Options of the steps, and in which order to try them."""

    workcell: Workcell
    options: Mapping[int, Sequence[Option]]
    _following: dict[Option, float] = field(default_factory=dict)  # least cost [s] of the steps after it
    _placed: dict[tuple[Option, bool], list[Placed]] = field(default_factory=dict)
    _clear: dict[tuple[Option, Option], bool] = field(default_factory=dict)

    def ranked(self, k: int, previous: Option | None) -> list[Option]:
        """The options of a step that comes after another has been done in one way, cheapest first."""
        return sorted(self.options.get(k, ()), key=lambda option: self._total(k, previous, option))

    def _total(self, k: int, previous: Option | None, option: Option) -> float:
        if option not in self._following:
            self._following[option] = min(
                (self._total(k + 1, option, o) for o in self.options.get(k + 1, ())), default=0.0
            )
        return round(self.unhidden(previous, option) + option.cost + self._following[option], 9)

    def unhidden(self, previous: Option | None, option: Option) -> float:
        """What comes between two insertions [s]: the fetch, as far as it is not done during the first."""
        if previous is None or option.fetcher == previous.inserter:
            return FETCHING
        return CHANGE + FETCHING * (not self._apart(previous, option))

    def _apart(self, previous: Option, option: Option) -> bool:
        """Whether the arm of one insertion keeps clear of the arm that fetches meanwhile."""
        pair = previous, option
        if pair not in self._clear:
            fetching, inserting = self._shapes(option, True), self._shapes(previous, False)
            self._clear[pair] = all(distance(f, i, ROOM) >= ROOM for f in fetching for i in inserting)
        return self._clear[pair]

    def _shapes(self, option: Option, fetching: bool) -> list[Placed]:
        known = option, fetching
        if known not in self._placed:
            arm, joints = (
                (option.fetcher, option.fetching) if fetching else (option.inserter, option.inserting)
            )
            track = Silhouette(self.workcell.collision, arm, option.grip.width).along(joints)
            self._placed[known] = [track.at(k) for k in range(len(joints))]
        return self._placed[known]
