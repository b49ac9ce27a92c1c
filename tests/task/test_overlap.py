"""Arms that move at the same time: nothing may depend on when, and what is let happen together is free in every combination."""

from __future__ import annotations

import numpy as np
import pytest

from soma_bullet.frames import Array
from soma_bullet.records import to_tree
from soma_bullet.robot.collision import Situation
from soma_bullet.robot.silhouette import distance
from soma_bullet.task.overlap import CLEARANCE, Sweep, meet, overlapped
from soma_bullet.task.segments import Context, Program, Segment, contexts
from soma_bullet.task.workcell import Workcell


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
    assert loosened.alone == program.makespan
    busiest = max(sum(s.seconds for s in loosened.segments if s.arm == arm) for arm in (0, 1))
    assert loosened.makespan >= busiest - 1e-9


def test_each_arm_does_the_same(program: Program, loosened: Program) -> None:
    for arm in (0, 1):
        ours, theirs = ([s for s in p.segments if s.arm == arm] for p in (program, loosened))
        for one, other in zip(ours, theirs, strict=True):
            assert (one.kind, one.step, one.piece, one.duration) == (other.kind, other.step, other.piece, other.duration)
            if len(one.path):
                np.testing.assert_array_equal(one.path[[0, -1]], other.path[[0, -1]])


def test_an_arm_does_one_thing_at_a_time(loosened: Program) -> None:
    before = ancestors(loosened)
    for j, segment in enumerate(loosened.segments):
        assert all(i < j for i in loosened.after[j])
        assert {i for i in range(j) if loosened.segments[i].arm == segment.arm} <= before[j]


def test_the_assembly_is_changed_in_order(moments: list[tuple[Context, Segment]], loosened: Program) -> None:
    before = ancestors(loosened)
    changes = [j for j, (_, s) in enumerate(moments) if s.kind == "place"]
    changes += [j for j, (c, s) in enumerate(moments) if s.kind in ("settle", "release") and s.piece in c.placed]
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
                assert not [n for n in between if not {n[0], n[1]} & {"table", "stand"}], (i, j, early.kind, late.kind, near)
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
