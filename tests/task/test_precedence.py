"""What waits for what, against all pairs looked at one by one."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.task.kinds import GRASP, HOME, INSERT, KINDS, LIFT, PLACE, RELEASE, TRANSFER, TRANSIT, Kind
from soma_bullet.task.program.overlap.precedence import assembles, awaited
from soma_bullet.task.program.program import Program, moments
from soma_bullet.task.segment import Segment
from soma_bullet.task.state import CellState
from soma_bullet.task.workcell import Workcell

ARMS = 3
some = [TRANSIT, GRASP, LIFT, TRANSFER, INSERT, PLACE, RELEASE, HOME]
segments = st.lists(
    st.tuples(st.sampled_from(some), st.integers(0, ARMS - 1), st.sampled_from("abc"), st.booleans()),
    min_size=1,
    max_size=12,
)


def all_before(direct: list[set[int]]) -> list[set[int]]:
    """For each all that have ended before it, given those that it waits for itself."""
    found: list[set[int]] = []
    for needed in direct:
        found.append(needed.union(*(found[i] for i in needed)))
    return found


@given(segments, st.sets(st.tuples(st.integers(0, 11), st.integers(0, 11))))
def test_what_is_awaited_is_what_may_not_overlap(
    drawn: list[tuple[Kind, int, str, bool]], near: set[tuple[int, int]]
) -> None:
    made = [Segment(kind, 0, arm, piece) for kind, arm, piece, _ in drawn]
    assembling = [flag for *_, flag in drawn]

    def ordered(i: int, j: int) -> bool:
        laden = not (made[i].kind.unladen or made[j].kind.unladen)
        return made[i].piece == made[j].piece and laden or assembling[i] and assembling[j]

    def meets(i: int, j: int) -> bool:
        return (i, j) in near

    direct = [
        {i for i in range(j) if made[i].arm == made[j].arm or ordered(i, j) or meets(i, j)}
        for j in range(len(made))
    ]
    expected = all_before(direct)
    known: list[dict[int, int]] = []
    for j in range(len(made)):
        ended, avoidable = awaited(j, made, assembling, known, ARMS, meets)
        known.append(ended)
        for arm in range(ARMS):
            assert ended[arm] == max((i for i in expected[j] if made[i].arm == arm), default=-1)
        if not any(meets(i, j) for i in range(j)):
            assert not avoidable
        others = {i for i in direct[j] if made[i].arm != made[j].arm}
        if others and not any(ordered(i, j) for i in others):
            own = all_before([*direct[:j], {i for i in direct[j] if made[i].arm == made[j].arm}])[j]
            assert avoidable == bool(others - own)


def test_what_changes_the_assembly_keeps_its_order(
    workcell: Workcell, plan: AssemblyPlan, program: Program
) -> None:
    """Insertions, and whatever touches a piece that stands."""
    found = [
        (segment.kind.name, segment.piece)
        for before, segment, _ in moments(workcell, program)
        if assembles(before, segment)
    ]
    for piece in plan.order:
        kinds = [kind for kind, name in found if name == piece and kind != "follow"]
        assert kinds == ["insert", "place", "settle", "release"]
    assert [name for kind, name in found if kind == "place"] == list(plan.order)


def test_a_grasp_changes_the_assembly_only_where_the_piece_stands() -> None:
    lying = CellState({"a": np.eye(4)}, (np.zeros(6),), np.zeros(1))
    standing = lying.placing("a")
    for kind in KINDS.values():
        segment = Segment(kind, 0, 0, "a")
        assert assembles(lying, segment) == kind.assembles
        assert assembles(standing, segment) == (kind.assembles or kind.at_piece)


def test_every_pair_that_may_overlap_is_neither_ordered_nor_near(
    workcell: Workcell, loosened: Program
) -> None:
    """Of the program of both arms: what is not before the other is about another piece, or the hand is away
    from it."""
    ended = all_before([set(needed) for needed in loosened.after])
    for i, j in combinations(range(len(loosened.segments)), 2):
        one, two = loosened.segments[i], loosened.segments[j]
        if i not in ended[j]:
            assert one.arm != two.arm
            assert one.piece != two.piece or one.kind.unladen or two.kind.unladen
