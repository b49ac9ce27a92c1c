"""Refusals: counted by what was refused, and told by what decided: how far it came, which pair, by how
much."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from soma_bullet.errors import NoSolutionError
from soma_bullet.frames import readonly
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.task.feed import Feed
from soma_bullet.task.limits import Effort
from soma_bullet.task.lines import Lines, Mover
from soma_bullet.task.refusal import MEASURED, TOLD, Refusal, Refusals
from soma_bullet.task.search.scheduler import Scheduler
from soma_bullet.task.workcell import Workcell

ORDER = ("one", "two", "three")
MET = Refusal("two", "insertion", "collision", ("left_palm", "one"))
FAR = Refusal("two", "", "left arm does not reach the goal")


def never() -> tuple[float, float]:
    raise AssertionError("measured though it does not matter")


@pytest.fixture
def refusals() -> Refusals:
    found = Refusals(order=ORDER)
    found.at(0)
    return found


# --- counting -----------------------------------------------------------------------------------------------


@given(st.lists(st.tuples(st.sampled_from(["a", "b", "c"]), st.integers(0, 5)), max_size=30))
def test_each_is_counted_as_often_as_it_was_met(met: list[tuple[str, int]]) -> None:
    refusals, expected = Refusals(order=ORDER), Counter[str]()
    refusals.at(0)
    for cause, count in met:
        refusals.add(Refusal("one", "", cause), count)
        expected[f"one: {cause}"] += count
    assert refusals.sentences() == +expected
    counts = [count for _, count in refusals.sentences().items()]
    assert counts == sorted(counts, reverse=True)
    assert {str(r): e.count for r, e in refusals.there.items()} == +expected


def test_a_refusal_reads_as_a_sentence() -> None:
    assert str(MET) == "two: insertion: left_palm meets one"
    assert str(FAR) == "two: left arm does not reach the goal"
    assert str(replace(MET, pair=None)) == "two: insertion: collision"


# --- what decided -------------------------------------------------------------------------------------------


def test_nothing_is_told_where_nothing_was_met(refusals: Refusals) -> None:
    assert Refusals().decided() == () and refusals.decided() == ()


def test_only_the_farthest_step_decides(refusals: Refusals) -> None:
    refusals.add(Refusal("one", "", "was near the beginning"), 100)
    refusals.at(1)
    refusals.add(MET, 2, "left", 7, lambda: (-0.0012, 0.0005))
    refusals.at(0)
    refusals.add(Refusal("one", "", "was near the beginning"), 100, distance=never)
    first, *rest = refusals.decided()
    assert first == "the search came to step 2 of one <- two <- three, two, and no further:"
    assert rest == [
        "  2 x two: insertion: left_palm meets one (overlapping by 1.2 mm, 0.5 mm wanted, left arm, grasp 7)"
    ]
    refusals.at(1)  # once more there: what was met is kept
    refusals.add(FAR)
    assert len(refusals.decided()) == 3
    refusals.at(2)
    assert refusals.decided() == ()


def test_another_order_counts_where_it_comes_farther(refusals: Refusals) -> None:
    refusals.at(1)
    refusals.add(MET)
    refusals.order = ("two", "one", "three")
    refusals.at(1)
    refusals.add(Refusal("one", "", "of another order"))
    assert "one <- two <- three" in refusals.decided()[0] and len(refusals.decided()) == 2
    refusals.at(2)
    refusals.add(Refusal("three", "", "of another order"))
    assert "step 3 of two <- one <- three, three" in refusals.decided()[0]


def test_the_most_frequent_are_told_and_no_more(refusals: Refusals) -> None:
    for n in range(TOLD + 3):
        refusals.add(Refusal("one", "", f"cause {n}"), 1 + n)
    told = refusals.decided()[1:]
    assert [line.strip().split(" x ")[0] for line in told] == [str(TOLD + 3 - n) for n in range(TOLD)]


def test_the_nearest_of_the_first_few_is_told(refusals: Refusals) -> None:
    refusals.at(1)
    asked = list[int]()

    def at(n: int) -> Callable[[], tuple[float, float]]:
        def measured() -> tuple[float, float]:
            asked.append(n)
            return (0.001 if n == 3 else -0.01 * (1 + n)), 0.002

        return measured

    for n in range(MEASURED + 5):
        refusals.add(MET, 1, f"arm{n}", n, at(n))
    assert asked == list(range(MEASURED))
    (line,) = refusals.decided()[1:]
    told = "(1.0 mm apart, 2.0 mm wanted, arm3 arm, grasp 3)"
    assert line == f"  {MEASURED + 5} x two: insertion: left_palm meets one {told}"


def test_what_is_of_the_piece_itself_is_told_first(refusals: Refusals) -> None:
    refusals.at(1)
    refusals.add(Refusal("one", "", "of another piece"), 50)
    assert len(refusals.decided()) == 2
    refusals.add(FAR, 1)
    assert refusals.decided()[1:] == (f"  1 x {FAR}",)


def test_the_error_says_all_of_it(refusals: Refusals) -> None:
    refusals.at(1)
    refusals.add(MET, 3, "left", 7, lambda: (0.0, 0.001))
    error = refusals.error("schedule", "none")
    assert isinstance(error, NoSolutionError) and error.stage == "schedule"
    assert error.decided == refusals.decided() and error.reasons == refusals.sentences()
    assert str(error).index("step 2 of") < str(error).index("3 x two: insertion: left_palm meets one")


# --- in a cell ----------------------------------------------------------------------------------------------


def test_a_line_that_meets_something_says_what_and_how_far(workcell: Workcell) -> None:
    """The hand goes straight down into the table."""
    lines = Lines(workcell, Refusals(order=ORDER), Effort())
    lines.refusals.at(0)
    state, robot = workcell.idle(), workcell.robot
    q = state.qs[0]
    T = robot.tcp(0, q)
    mover = Mover("one", 0, lines.scene(state, 0, "one"), state, 0.0)
    down = np.array((0.0, 0.0, -1.0))
    assert lines.line("descent", mover, q, T, down, float(T[2, 3])) is None
    (refusal,) = lines.refusals.counts
    assert refusal.cause in ("collision", "unreachable", "branch") and refusal.action == "descent"
    assert refusal.pair is not None and "table" in refusal.pair
    (evidence,) = lines.refusals.there.values()
    assert evidence.arm == workcell.cell.arms[0].name and evidence.distance is not None
    apart, wanted = evidence.distance
    assert apart < wanted and -0.02 < apart
    assert lines.made == lines.effort.lines == 1


def test_a_search_in_vain_tells_the_step_and_the_pair(
    workcell: Workcell, plan: AssemblyPlan, feed: Feed
) -> None:
    """The second piece lies where no arm reaches."""
    poses = np.array(feed.poses)
    second = plan.order[1]
    poses[feed.names.index(second), :3, 3] = (0.0, 2.0, 0.02)
    scheduler = Scheduler(workcell, plan, replace(feed, poses=readonly(poses)), effort=Effort(3000))
    with pytest.raises(NoSolutionError) as caught:
        scheduler.find()
    assert f"step 2 of {' <- '.join(plan.order)}, {second}, and no further" in caught.value.decided[0]
    assert all(f"x {second}: " in line for line in caught.value.decided[1:])
    assert caught.value.stage == "schedule" and second in str(caught.value)
