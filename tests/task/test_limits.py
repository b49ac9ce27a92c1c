"""Bounds of a search: what is kept, and how much is done, are counted, and end exactly where they should."""

from __future__ import annotations

from collections import OrderedDict

import pytest
from hypothesis import given
from hypothesis import strategies as st

from soma_bullet.errors import NoSolutionError
from soma_bullet.options import EpisodeOptions
from soma_bullet.pipeline import make_program
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.task.feed import Feed
from soma_bullet.task.limits import Effort, TooManyLines
from soma_bullet.task.memo import Memo
from soma_bullet.task.program.make import recover_program
from soma_bullet.task.search import placing
from soma_bullet.task.search.scheduler import Scheduler
from soma_bullet.task.search_options import SearchOptions
from soma_bullet.task.workcell import Workcell

# --- what is kept -------------------------------------------------------------------------------------------


@given(st.integers(1, 5), st.lists(st.integers(0, 8), max_size=60))
def test_a_memo_keeps_what_was_asked_for_last(most: int, keys: list[int]) -> None:
    memo, last, made = Memo[int, str](most), OrderedDict[int, None](), list[int]()

    def value(key: int) -> str:
        made.append(key)
        return f"value {key}"

    for key in keys:
        known, before = key in last, len(made)
        assert memo.get(key, lambda key=key: value(key)) == f"value {key}"  # type: ignore[misc]
        assert (len(made) == before) == known
        last[key] = None
        last.move_to_end(key)
        if len(last) > most:
            last.popitem(last=False)
        assert len(memo) == len(last) <= most


def test_a_memo_keeps_that_there_is_nothing() -> None:
    """None is a value: what cannot be done is not tried again."""
    memo, made = Memo[str, None](3), list[str]()
    for _ in range(2):
        assert memo.get("key", lambda: made.append("once")) is None
    assert made == ["once"]


def test_a_memo_forgets_everything_when_told() -> None:
    memo = Memo[int, int](3)
    memo.get(1, lambda: 1)
    memo.forget()
    assert len(memo) == 0 and memo.get(1, lambda: 2) == 2


def test_what_fails_is_not_kept() -> None:
    memo = Memo[int, int](3)
    with pytest.raises(ZeroDivisionError):
        memo.get(1, lambda: 1 // 0)
    assert len(memo) == 0 and memo.get(1, lambda: 5) == 5


# --- how much is done ---------------------------------------------------------------------------------------


def spent_until_it_ends(effort: Effort) -> int:
    count = 0
    while True:
        try:
            effort.spend()
        except TooManyLines:
            return count
        count += 1


@given(st.integers(0, 40), st.lists(st.integers(0, 30), min_size=1, max_size=5))
def test_a_search_ends_at_exactly_its_count(most: int, allowed: list[int]) -> None:
    effort, left = Effort(most), most
    for lines in allowed:
        effort.allow(lines)
        spent = spent_until_it_ends(effort)
        assert spent == min(lines, left) and effort.spent
        left -= spent
        assert effort.lines == most - left and effort.exhausted == (left == 0)


def test_what_is_not_spent_is_not_carried_over() -> None:
    effort = Effort(100)
    effort.allow(10)
    effort.spend()
    effort.allow(5)
    assert spent_until_it_ends(effort) == 5 and effort.lines == 6


@pytest.mark.parametrize("most", [40, 150])
def test_a_search_in_vain_ends_after_as_many_lines_each_time(
    most: int, workcell: Workcell, plan: AssemblyPlan, feed: Feed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(placing.Placer, "check", lambda *arguments, **options: None)
    ends = []
    for _ in range(2):
        scheduler = Scheduler(workcell, plan, feed, effort=Effort(most))
        with pytest.raises(NoSolutionError) as caught:
            scheduler.find()
        ends.append((scheduler.effort.lines, str(caught.value), dict(scheduler.refusals.counts)))
    assert ends[0] == ends[1] and ends[0][0] == most


def test_no_more_scenes_are_kept_than_may_be(workcell: Workcell, plan: AssemblyPlan, feed: Feed) -> None:
    effort = Effort(scenes=Memo(4))
    found = Scheduler(workcell, plan, feed, effort=effort).find()
    assert 0 < len(effort.scenes) <= 4
    assert [a.insert.identity for a in found.assignments] == [
        a.insert.identity for a in Scheduler(workcell, plan, feed).find().assignments
    ]


def test_the_options_of_a_search_bound_programs_and_recoveries(
    workcell: Workcell, plan: AssemblyPlan, feed: Feed
) -> None:
    few = SearchOptions(lines=3)
    with pytest.raises(NoSolutionError, match=r"within 3 lines of hands \(--search.lines\)"):
        make_program(workcell.assembly, workcell.cell, plan, EpisodeOptions(search=few))
    start = workcell.idle({name: feed.pose(name) for name in feed.names})
    with pytest.raises(NoSolutionError, match=r"within 3 lines of hands \(--search.lines\)"):
        recover_program(workcell, plan, start, 0, effort=Effort.of(few))


def test_a_scheduler_takes_its_limits_from_the_options(
    workcell: Workcell, plan: AssemblyPlan, feed: Feed
) -> None:
    effort = Effort.of(SearchOptions(lines=7, order_lines=5, scenes=3))
    effort.allow(effort.for_order)
    assert spent_until_it_ends(effort) == 5
    assert Scheduler(workcell, plan, feed, effort=effort).order_lines == 5
