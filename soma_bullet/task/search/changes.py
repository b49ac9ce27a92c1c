"""Which hands let go after a step, and which take hold of a piece in place, in an order that keeps the state
up."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from soma_bullet.planner.assembly_plan import Hold as PlannedHold
from soma_bullet.planner.holds import Holds
from soma_bullet.task.actions import hold, release
from soma_bullet.task.actions.action import Action
from soma_bullet.task.search.planning import Planning
from soma_bullet.task.state import CellState


class Changed(NamedTuple):
    """Holds as they are to be: by which actions, and the state afterwards, idle arms at home."""

    actions: tuple[Action, ...]
    state: CellState


class Changes:
    """What changes hands after a step.

    Args:
        judged: of the plan's assembly, hands and options: whether a state stands is up to its analyzer.
    """

    def __init__(self, planning: Planning, judged: Holds):
        self.planning, self.judged = planning, judged

    def settle(self, k: int, state: CellState) -> Changed | None:
        """From the state in which the piece of step k is in place and all hands are where they are, to that
        in which the plan's holds are held; None where there is no way."""
        step = self.planning.plan.steps[k]
        wanted = {planned.piece: planned for planned in step.holds}
        missing = [planned for name, planned in wanted.items() if state.holder(name) is None]
        # the inserter last, if it may
        go = sorted(release.candidates(state, wanted), key=lambda name: (name == step.piece, name))
        standing = False
        for order, after in _sequences(go, bool(missing)):
            taken = [planned.piece for planned in missing]
            if not self._stands_all_along(state.placed, set(state.held.values()), order, after, taken):
                continue
            standing = True
            found = self._carry_out(k, state, order, after, missing)
            if found is not None:
                return found
        if not standing:
            self.planning.lines.refuse(step.piece, "letting go would let the state fall in any order")
        return None

    def _stands_all_along(
        self, placed: frozenset[str], held: set[str], order: list[str], after: int, taken: list[str]
    ) -> bool:
        for k in range(len(order) + 1):
            if k == after:
                held = held | set(taken)
            if k < len(order):
                held = held - {order[k]}
                if not self.stands(placed, frozenset(held)):
                    return False
        return True

    def stands(self, placed: frozenset[str], held: frozenset[str]) -> bool:
        """Whether some pieces stand with some of them held."""
        index = self.planning.workcell.assembly.index
        indices = (frozenset(index(name) for name in names) for names in (placed, held))
        return self.judged.judge(*indices).stands

    def _carry_out(
        self, k: int, state: CellState, order: list[str], after: int, missing: list[PlannedHold]
    ) -> Changed | None:
        """The lines of one sequence of changes."""
        actions: list[Action] = []
        planning, cell = self.planning, self.planning.workcell
        home, piece = cell.robot.home, planning.plan.steps[k].piece
        for n in range(len(order) + 1):
            for planned in missing if n == after else ():
                state = state.empty_handed(home)
                taken = self._take(k, state, planned)
                if taken is None:
                    return None
                actions.append(taken)
                state = taken.effects(cell, state)
            if n == len(order):
                break
            released = release.check(planning, state, order[n], piece)
            if released is None:
                return None
            actions.append(released)
            state = released.effects(cell, state)
        return Changed(tuple(actions), state.empty_handed(home))

    def _take(self, k: int, state: CellState, planned: PlannedHold) -> hold.Hold | None:
        """How a free hand takes hold of a piece in place."""
        for arm, grip in hold.candidates(self.planning, k, state, planned):
            found = hold.check(self.planning, k, state, planned.piece, arm, grip)
            if found is not None:
                return found
        return None


def _sequences(go: list[str], taking: bool) -> Iterator[tuple[list[str], int]]:
    """Orders in which to let go, each with how many come before what is taken."""
    for after in range(len(go) + 1 if taking else 1):
        for order in (go, go[::-1])[: 1 if len(go) < 2 else 2]:
            yield order, after
