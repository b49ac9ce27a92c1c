"""The schedule as a value: for each step of the plan what hands do, in order."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from soma_bullet.task.actions.action import Action
from soma_bullet.task.actions.hold import Hold
from soma_bullet.task.actions.insert import Insert
from soma_bullet.task.actions.pick import Pick
from soma_bullet.task.actions.release import Release


@dataclass(frozen=True, eq=False)
class Assignment:
    """One step of the plan, as hands do it.

    Attributes:
        step: index of the plan's step.
        bring: what brings the piece into the hand that inserts it: squares, picks, put-downs, hand-overs.
            Empty where the hand has it already. Those of other pieces, before the first step, come first.
        insert: how it goes in.
        changes: holds that are taken up and let go afterwards, in this order.
        holds: piece -> arm after the step.
    """

    step: int
    bring: tuple[Action, ...]
    insert: Insert
    changes: tuple[Action, ...]
    holds: dict[str, int]

    @property
    def actions(self) -> tuple[Action, ...]:
        """All of it, in order."""
        return *self.bring, self.insert, *self.changes

    @property
    def piece(self) -> str:
        """What is inserted."""
        return self.insert.piece

    @property
    def arm(self) -> int:
        """The arm that inserts it."""
        return self.insert.arm

    @property
    def regrasps(self) -> tuple[Action, ...]:
        """The actions before the insertion that leave a piece somewhere else, or in another hand."""
        return tuple(action for action in self.bring if action.regrasps)

    @property
    def pick(self) -> Pick | None:
        """The last pick, from which the piece goes straight in; None where it comes otherwise."""
        return self.bring[-1] if self.bring and isinstance(self.bring[-1], Pick) else None

    @property
    def takes(self) -> tuple[Hold, ...]:
        """The holds that are taken up."""
        return tuple(action for action in self.changes if isinstance(action, Hold))

    @property
    def releases(self) -> tuple[Release, ...]:
        """The pieces that are let go."""
        return tuple(action for action in self.changes if isinstance(action, Release))


@dataclass(frozen=True, eq=False)
class Schedule:
    """Who does what.

    Attributes:
        assignments: one for each step of the plan from the start on.
        rejections: how often each reason ruled out a grasp, an arm or a hold on the way.
        changes: of holds, before the first of them, where a state as found asks for it.
    """

    assignments: tuple[Assignment, ...]
    rejections: dict[str, int]
    changes: tuple[Action, ...] = ()

    def actions(self) -> Iterator[tuple[Assignment | None, Action]]:
        """All actions in order, each with the step that it belongs to."""
        yield from ((None, action) for action in self.changes)
        for assignment in self.assignments:
            yield from ((assignment, action) for action in assignment.actions)
