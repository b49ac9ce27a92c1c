"""Arms that move at the same time: nothing may depend on when, and what is let happen together is free in
every combination."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import pytest

from soma_bullet.frames import Array
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.records import to_tree
from soma_bullet.robot.collision import Situation
from soma_bullet.robot.silhouette import distance
from soma_bullet.task.program.make import make_program
from soma_bullet.task.program.motions import scene_for
from soma_bullet.task.program.overlap.loosen import overlapped
from soma_bullet.task.program.overlap.precedence import assembles
from soma_bullet.task.program.overlap.prefetch import prefetched
from soma_bullet.task.program.overlap.sweeps import CLEARANCE, Encounters, Sweep, meet
from soma_bullet.task.program.program import Program, moments
from soma_bullet.task.segment import DT, Segment
from soma_bullet.task.state import CellState
from soma_bullet.task.workcell import Workcell
from tests import soma3
from tests.feeds import ASKEW, laid
from tests.soma3 import planned


@pytest.fixture(scope="module", params=["apart", "askew"])
def programs(
    request: pytest.FixtureRequest, workcell: Workcell, plan: AssemblyPlan
) -> tuple[Program, Program]:
    """One arm at a time, and both at once."""
    if request.param == "apart":
        return planned()[2], soma3.loosened()
    program = make_program(workcell, plan, laid(workcell, plan, ASKEW), 0)
    return program, overlapped(workcell, program)


@pytest.fixture(scope="module")
def program(programs: tuple[Program, Program]) -> Program:
    return programs[0]


@pytest.fixture(scope="module")
def loosened(programs: tuple[Program, Program]) -> Program:
    return programs[1]


@pytest.fixture(scope="module")
def along(workcell: Workcell, loosened: Program) -> list[tuple[CellState, Segment]]:
    return [(before, segment) for before, segment, _ in moments(workcell, loosened)]


def ancestors(program: Program) -> list[set[int]]:
    """For every segment all that have ended before it starts."""
    found: list[set[int]] = []
    for needed in program.after:
        found.append(set(needed).union(*(found[i] for i in needed)))
    return found


def test_it_takes_less_time(program: Program, loosened: Program) -> None:
    assert program.makespan == pytest.approx(sum(segment.seconds for segment in program.segments))
    assert loosened.makespan < 0.9 * program.makespan
    assert loosened.makespan < loosened.alone <= loosened.in_turn == program.makespan
    busiest = max(sum(s.seconds for s in loosened.segments if s.arm == arm) for arm in (0, 1))
    assert loosened.makespan >= busiest - 1e-9


def whole(program: Program, arm: int) -> list[Segment]:
    """What an arm does without its ways home; of a divided path the last part."""
    mine = [s for s in program.segments if s.arm == arm and s.kind.name != "home"]
    about = [(s.kind, s.step, s.piece) for s in mine]
    return [s for k, s in enumerate(mine) if about[k : k + 2] != 2 * [about[k]]]


def test_each_arm_does_the_same(program: Program, loosened: Program) -> None:
    """Ends are equal up to rounding: what is divided is timed anew."""
    for arm in (0, 1):
        for one, other in zip(whole(program, arm), whole(loosened, arm), strict=True):
            assert (one.kind, one.step, one.piece, one.duration) == (
                other.kind,
                other.step,
                other.piece,
                other.duration,
            )
            assert one.opening == other.opening
            if len(one.path):
                np.testing.assert_allclose(one.path[-1], other.path[-1], rtol=0.0, atol=1e-12)
        ends = ([s for s in p.segments if s.arm == arm][-1].path[-1] for p in (program, loosened))
        np.testing.assert_allclose(*ends, rtol=0.0, atol=1e-12)


def test_paths_go_on_where_the_one_before_ended(
    workcell: Workcell, along: list[tuple[CellState, Segment]]
) -> None:
    """Also where a path is divided, or where an arm does not go home: there are no jumps, at the limits of
    the joints."""
    for before, segment in along:
        if len(segment.path) > 1:
            limits = workcell.robot.arm(segment.arm)
            np.testing.assert_allclose(segment.path[0], before.qs[segment.arm], atol=1e-9)
            speeds = np.diff(segment.path, axis=0) / DT
            assert (np.abs(speeds) <= 1.05 * limits.velocity).all()
            at_ends = np.abs(speeds[[0, -1]])
            assert (at_ends <= 2 * DT * limits.acceleration + 1e-6).all(), segment.kind


def test_every_path_is_free_when_its_turn_comes(
    workcell: Workcell, along: list[tuple[CellState, Segment]]
) -> None:
    """Segments that run one at a time, in their order, meet nothing, wherever the other arm waits
    meanwhile."""
    for before, segment in along:
        if segment.kind.around:
            first = float(before.openings[segment.arm])
            last = first if segment.opening is None else segment.opening
            scene = scene_for(workcell, before, segment)
            for width in (first, last):
                for q in segment.path[::12]:
                    configuration = workcell.configuration(before, segment.arm, q, width)
                    assert not scene.collides(configuration), (segment.kind, segment.piece)


def test_straight_lines_are_free_wherever_the_other_arm_waits(
    workcell: Workcell, along: list[tuple[CellState, Segment]]
) -> None:
    for before, segment in along:
        if segment.kind.way == "line":
            scene = scene_for(workcell, before, segment)
            for q in segment.path[::24]:
                assert not scene.collides(workcell.configuration(before, segment.arm, q)), (
                    segment.kind,
                    segment.piece,
                )


def test_fetches_come_first_where_that_is_quicker(
    workcell: Workcell, program: Program, loosened: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "soma_bullet.task.program.overlap.loosen.prefetched", lambda encounters, patient: patient
    )
    as_scheduled = overlapped(workcell, program)
    assert loosened.makespan <= as_scheduled.makespan
    assert loosened.alone == as_scheduled.alone


class InTheWay(Encounters):
    """As if one arm could not fetch the second piece while the other brings the first and holds it."""

    def __init__(self, workcell: Workcell, fetching: Collection[Segment], building: Collection[Segment]):
        super().__init__(workcell)
        self.fetching, self.building = fetching, building

    def meet(self, first: Sweep, second: Sweep) -> bool:
        ways = [{s for s, sweep in self._sweeps.items() if sweep is way} for way in (first, second)]
        return any(one & self.fetching and two & self.building for one, two in (ways, ways[::-1]))


def test_a_fetch_that_would_wait_for_a_hold_comes_before_it(workcell: Workcell) -> None:
    """It must not wait until the first piece is let go of, which it would be only after it has come."""
    program = planned()[2]
    first, second = program.order[:2]
    names = ("transit", "approach", "grasp", "lift"), ("transfer", "insert", "place", "settle")
    fetching, building = (
        {s for s in program.segments if (s.step, s.piece) == (k, piece) and s.kind.name in names[k - 1]}
        for k, piece in ((1, second), (0, first))
    )
    changed = prefetched(InTheWay(workcell, fetching, building), program)

    def order(p: Program) -> list[str]:
        wanted = (("lift", second), ("transfer", first))
        return [s.piece for s in p.segments if (s.kind.name, s.piece) in wanted]

    assert order(program) == [first, second] and order(changed) == [second, first]
    for arm in (0, 1):
        about = [[(s.kind, s.piece) for s in p.segments if s.arm == arm] for p in (program, changed)]
        assert about[0] == about[1]
    assembling = [
        [(s.kind, s.piece) for b, s, _ in moments(workcell, p) if assembles(b, s)] for p in (program, changed)
    ]
    assert assembling[0] == assembling[1]
    for before, segment, _ in moments(workcell, changed):
        if len(segment.path):
            scene = scene_for(workcell, before, segment)
            for q in segment.path[::24]:
                assert not scene.collides(workcell.configuration(before, segment.arm, q)), segment.kind


def test_an_arm_does_one_thing_at_a_time(loosened: Program) -> None:
    before = ancestors(loosened)
    for j, segment in enumerate(loosened.segments):
        assert all(i < j for i in loosened.after[j])
        assert {i for i in range(j) if loosened.segments[i].arm == segment.arm} <= before[j]


def test_the_assembly_is_changed_in_order(along: list[tuple[CellState, Segment]], loosened: Program) -> None:
    before = ancestors(loosened)
    changes = [j for j, (_, s) in enumerate(along) if s.kind.name == "place"]
    changes += [
        j for j, (c, s) in enumerate(along) if s.kind.name in ("settle", "release") and s.piece in c.placed
    ]
    for j in changes:
        assert {i for i in changes if i < j} <= before[j]


def test_what_may_overlap_is_free_in_every_combination(
    workcell: Workcell, along: list[tuple[CellState, Segment]], loosened: Program
) -> None:
    """Judged by the collision scene of both arms, which knows nothing of bounds and bisection."""
    before, rng, checked = ancestors(loosened), np.random.default_rng(1), 0
    for j, (context_j, late) in enumerate(along):
        for i, (context_i, early) in enumerate(along[:j]):
            if early.arm == late.arm or i in before[j]:
                continue
            carried = {}
            for context, segment in ((context_i, early), (context_j, late)):
                if segment.arm in context.carried:
                    for piece, T_tcp_piece in workcell.carried(context, segment.arm).items():
                        carried[piece] = (segment.arm, T_tcp_piece)
            gripped = {piece: arm for piece, (arm, _) in carried.items()}
            scene = workcell.collision.scene(Situation({}, frozenset({0, 1}), carried, gripped))
            for _ in range(12):
                qs: Array = np.array(workcell.robot.home)
                openings = np.zeros(2)
                for context, segment in ((context_i, early), (context_j, late)):
                    path = segment.path if len(segment.path) else context.qs[segment.arm][None]
                    qs[segment.arm] = path[rng.integers(len(path))]
                    openings[segment.arm] = context.openings[segment.arm]
                near = scene.colliding(workcell.robot.configuration(qs, openings))
                between = [n for n in near if n[0].startswith("left") != n[1].startswith("left")]
                assert not [n for n in between if not {n[0], n[1]} & {"table", "stand"}], (
                    i,
                    j,
                    early.kind,
                    late.kind,
                    near,
                )
                checked += 1
    assert checked > 200


def test_bisection_agrees_with_sampling(workcell: Workcell, along: list[tuple[CellState, Segment]]) -> None:
    sweeps = [Sweep.of(workcell, context, segment) for context, segment in along]
    rng = np.random.default_rng(0)
    seen = {True: 0, False: 0}
    for _ in range(60):
        i, j = rng.integers(len(sweeps), size=2)
        if along[i][1].arm == along[j][1].arm:
            continue
        said = meet(sweeps[i], sweeps[j])
        seen[said] += 1
        if not said:
            for _ in range(20):
                a, b = rng.integers(len(sweeps[i].path)), rng.integers(len(sweeps[j].path))
                assert distance(sweeps[i].at(int(a)), sweeps[j].at(int(b)), 1.0) > CLEARANCE
    assert min(seen.values()) >= 3


def test_a_hand_that_opens_meanwhile_needs_more_room(workcell: Workcell) -> None:
    """Two arms at rest, so near that there is room as long as neither hand moves its fingers."""
    state, rng, seen = workcell.idle(), np.random.default_rng(0), 0
    goals = {a.arm: a.insert.q_goal for a in planned()[2].schedule.assignments}
    for _ in range(100):
        for arm, q in goals.items():
            state = state.with_arm(arm, q + rng.normal(0.0, 0.2, len(q)), 0.02)
        one, two = (Sweep.at_rest(workcell, state, arm) for arm in (0, 1))
        gap = distance(one.at(0), two.at(0), 1.0)
        if CLEARANCE < gap < 3 * CLEARANCE:
            more = gap - CLEARANCE
            little = replace(one, change=0.4 * more), replace(two, change=0.4 * more)
            assert not meet(one, two) and not meet(*little)
            assert meet(replace(one, change=1.1 * more), two) and meet(one, replace(two, change=1.1 * more))
            assert meet(replace(one, change=0.6 * more), replace(two, change=0.6 * more))
            seen += 1
    assert seen >= 5


def test_it_is_reproducible(workcell: Workcell, program: Program, loosened: Program) -> None:
    assert to_tree(overlapped(workcell, program)) == to_tree(loosened)
