"""Arms that move at the same time: nothing may depend on when, and what is let happen together is free in
every combination."""

from __future__ import annotations

import numpy as np
import pytest

from soma_bullet.frames import Array
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.records import to_tree
from soma_bullet.robot.collision import Situation
from soma_bullet.robot.silhouette import distance
from soma_bullet.task.builder import scene_of
from soma_bullet.task.feed import draw_feed
from soma_bullet.task.feed_options import FeedOptions
from soma_bullet.task.overlap import overlapped
from soma_bullet.task.program import make_program
from soma_bullet.task.segments import AROUND, DT, SPEEDS, Context, Program, Segment, contexts
from soma_bullet.task.sweeps import CLEARANCE, Sweep, meet
from soma_bullet.task.workcell import Workcell

RANDOM = 10  # seed of random poses from which BigL had better be fetched before Z


@pytest.fixture(scope="module", params=["preferred poses", "random poses"])
def program(request: pytest.FixtureRequest, workcell: Workcell, plan: AssemblyPlan) -> Program:
    seed, options = (
        (0, FeedOptions(poses="preferred")) if request.param == "preferred poses" else (RANDOM, FeedOptions())
    )
    return make_program(
        workcell, plan, draw_feed(workcell.assembly, plan, workcell.cell, seed, options), seed
    )


@pytest.fixture(scope="module")
def loosened(workcell: Workcell, program: Program) -> Program:
    return overlapped(workcell, program)


@pytest.fixture(scope="module")
def moments(workcell: Workcell, loosened: Program) -> list[tuple[Context, Segment]]:
    return [(before, segment) for before, segment, _ in contexts(workcell, loosened)]


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
    mine = [s for s in program.segments if s.arm == arm and s.kind != "home"]
    about = [(s.kind, s.step, s.piece) for s in mine]
    return [s for k, s in enumerate(mine) if about[k : k + 2] != 2 * [about[k]]]


def test_each_arm_does_the_same(program: Program, loosened: Program) -> None:
    for arm in (0, 1):
        for one, other in zip(whole(program, arm), whole(loosened, arm), strict=True):
            assert (one.kind, one.step, one.piece, one.duration) == (
                other.kind,
                other.step,
                other.piece,
                other.duration,
            )
            assert np.array_equal(one.opening, other.opening, equal_nan=True)
            if len(one.path):
                np.testing.assert_array_equal(one.path[-1], other.path[-1])
        np.testing.assert_array_equal(
            *([s for s in p.segments if s.arm == arm][-1].path[-1] for p in (program, loosened))
        )


def test_paths_go_on_where_the_one_before_ended(
    workcell: Workcell, moments: list[tuple[Context, Segment]]
) -> None:
    """Also where a path is divided, or where an arm does not go home: there are no jumps, at the limits of
    the joints."""
    for before, segment in moments:
        if len(segment.path) > 1:
            limits = workcell.robot.arm(segment.arm)
            np.testing.assert_allclose(segment.path[0], before.hands.qs[segment.arm], atol=1e-9)
            speeds = np.diff(segment.path, axis=0) / DT
            assert (np.abs(speeds) <= 1.05 * limits.velocity).all()
            at_ends = np.abs(speeds[[0, -1]])
            assert (at_ends <= 2 * DT * limits.acceleration + 1e-6).all(), segment.kind


def test_every_path_is_free_when_its_turn_comes(
    workcell: Workcell, moments: list[tuple[Context, Segment]]
) -> None:
    """Segments that run one at a time, in their order, meet nothing, wherever the other arm waits
    meanwhile."""
    for before, segment in moments:
        if segment.kind in AROUND:
            first = float(before.hands.openings[segment.arm])
            last = first if np.isnan(segment.opening) else segment.opening
            scene = scene_of(workcell, before, segment.arm)
            for width in (first, last):
                for q in segment.path[::12]:
                    configuration = workcell.configuration(before.hands, segment.arm, q, width)
                    assert not scene.collides(configuration), (segment.kind, segment.piece)


def test_straight_lines_are_free_wherever_the_other_arm_waits(
    workcell: Workcell, moments: list[tuple[Context, Segment]]
) -> None:
    for before, segment in moments:
        if segment.kind in SPEEDS:
            scene = scene_of(workcell, before, segment.arm)
            for q in segment.path[::24]:
                assert not scene.collides(workcell.configuration(before.hands, segment.arm, q)), (
                    segment.kind,
                    segment.piece,
                )


def test_fetches_come_first_where_that_is_quicker(
    workcell: Workcell, program: Program, loosened: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("soma_bullet.task.overlap.prefetched", lambda encounters, patient: patient)
    as_scheduled = overlapped(workcell, program)
    assert loosened.makespan <= as_scheduled.makespan
    fetches = [[s.piece for s in p.segments if s.kind == "lift"] for p in (as_scheduled, loosened)]
    assert (fetches[0] != fetches[1]) == (program.seed == RANDOM)
    if program.seed == RANDOM:
        assert loosened.makespan < as_scheduled.makespan - 2.0
        assert loosened.alone == as_scheduled.alone


def test_an_arm_does_one_thing_at_a_time(loosened: Program) -> None:
    before = ancestors(loosened)
    for j, segment in enumerate(loosened.segments):
        assert all(i < j for i in loosened.after[j])
        assert {i for i in range(j) if loosened.segments[i].arm == segment.arm} <= before[j]


def test_the_assembly_is_changed_in_order(moments: list[tuple[Context, Segment]], loosened: Program) -> None:
    before = ancestors(loosened)
    changes = [j for j, (_, s) in enumerate(moments) if s.kind == "place"]
    changes += [
        j for j, (c, s) in enumerate(moments) if s.kind in ("settle", "release") and s.piece in c.placed
    ]
    for j in changes:
        assert {i for i in changes if i < j} <= before[j]


def test_what_may_overlap_is_free_in_every_combination(
    workcell: Workcell, moments: list[tuple[Context, Segment]], loosened: Program
) -> None:
    """Judged by the collision scene of both arms, which knows nothing of bounds and bisection."""
    before, rng, checked = ancestors(loosened), np.random.default_rng(1), 0
    for j, (context_j, late) in enumerate(moments):
        for i, (context_i, early) in enumerate(moments[:j]):
            if early.arm == late.arm or i in before[j]:
                continue
            carried = {}
            for context, segment in ((context_i, early), (context_j, late)):
                if segment.arm in context.carried:
                    piece, T_tcp_piece = context.carried[segment.arm]
                    carried[piece] = (segment.arm, T_tcp_piece)
            gripped = {piece: arm for piece, (arm, _) in carried.items()}
            scene = workcell.collision.scene(Situation({}, frozenset({0, 1}), carried, gripped))
            for _ in range(12):
                qs: Array = np.array(workcell.robot.home)
                openings = np.zeros(2)
                for context, segment in ((context_i, early), (context_j, late)):
                    path = segment.path if len(segment.path) else context.hands.qs[segment.arm][None]
                    qs[segment.arm] = path[rng.integers(len(path))]
                    openings[segment.arm] = context.hands.openings[segment.arm]
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


def test_bisection_agrees_with_sampling(workcell: Workcell, moments: list[tuple[Context, Segment]]) -> None:
    sweeps = [Sweep.of(workcell, context, segment) for context, segment in moments]
    rng = np.random.default_rng(0)
    seen = {True: 0, False: 0}
    for _ in range(60):
        i, j = rng.integers(len(sweeps), size=2)
        if moments[i][1].arm == moments[j][1].arm:
            continue
        said = meet(sweeps[i], sweeps[j])
        seen[said] += 1
        if not said:
            for _ in range(20):
                a, b = rng.integers(len(sweeps[i].path)), rng.integers(len(sweeps[j].path))
                assert distance(sweeps[i].at(int(a)), sweeps[j].at(int(b)), 1.0) > CLEARANCE
    assert min(seen.values()) >= 3


def test_it_is_reproducible(workcell: Workcell, program: Program, loosened: Program) -> None:
    assert to_tree(overlapped(workcell, program)) == to_tree(loosened)
