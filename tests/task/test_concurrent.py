"""What may run beside a segment, and how near the arms come: judged by the program's order and by the
collision scene."""

from __future__ import annotations

from itertools import islice

import numpy as np

from soma_bullet.robot.collision import HAND_MARGIN, MARGIN, Situation
from soma_bullet.task.program.overlap.concurrent import Concurrent, alongside, leaves
from soma_bullet.task.program.overlap.sweeps import CLEARANCE
from soma_bullet.task.program.program import Program, moments
from soma_bullet.task.workcell import Workcell

MORE = MARGIN - HAND_MARGIN  # [m] that links keep more than hands


def placings(program: Program) -> list[int]:
    return [k for k, segment in enumerate(program.segments) if segment.kind.name == "place"]


def test_one_at_a_time_nothing_runs_beside_anything(program: Program) -> None:
    assert not any(alongside(program, k) for k in range(len(program.segments)))


def test_what_runs_beside_runs_beside_each_other(loosened: Program) -> None:
    beside = [alongside(loosened, k) for k in range(len(loosened.segments))]
    assert any(beside)
    assert all(k in beside[i] for k in range(len(beside)) for i in beside[k])
    assert all(
        loosened.segments[i].arm != loosened.segments[k].arm for k in range(len(beside)) for i in beside[k]
    )
    assert not any(i in beside[k] for k, needed in enumerate(loosened.after) for i in needed)


def test_planned_paths_leave_the_arms_apart(workcell: Workcell, loosened: Program) -> None:
    for k in placings(loosened):
        segment = loosened.segments[k]
        qs = np.array(workcell.robot.home)
        qs[segment.arm] = segment.path[0]
        assert Concurrent(workcell, loosened, k, qs, ()).gap(segment.path, CLEARANCE) > 0.0


def test_arms_touch_where_the_scene_says_so(workcell: Workcell, program: Program) -> None:
    """The other arm leans over somewhere; the scene knows nothing of how the gap is found."""
    k = placings(program)[0]
    segment, rng = program.segments[k], np.random.default_rng(3)
    arm, path = segment.arm, segment.path[[0, len(segment.path) // 2, -1]]
    openings = next(islice(moments(workcell, program), k, None))[0].openings
    scene = workcell.collision.scene(Situation({}, frozenset({0, 1})))
    seen, hands = {True: 0, False: 0}, workcell.collision.hand_links
    near = next(s.path[-1] for s in program.segments if (s.kind.name, s.arm) == ("insert", 1 - arm))
    for _ in range(80):
        qs = np.array(workcell.robot.home)
        qs[arm] = path[0]
        qs[1 - arm] = near + rng.normal(0.0, 0.5, 6)
        gap = Concurrent(workcell, program, k, qs, ()).gap(path, CLEARANCE)
        touching = False
        for q in path:
            both = qs.copy()
            both[arm] = q
            met = scene.colliding(workcell.robot.configuration(both, openings))
            pairs = [
                (a, b)
                for a, b, d in met
                if d <= (0.0 if {a, b} <= hands else MORE) and not {a, b} & {"table", "stand"}
            ]
            touching |= any(a.startswith("left") != b.startswith("left") for a, b in pairs)
        seen[touching] += 1
        assert (gap <= 0.0) == touching
    assert min(seen.values()) >= 5


def test_a_hand_that_holds_stays_while_others_move(
    workcell: Workcell, program: Program, loosened: Program
) -> None:
    """From the placing until the hand withdraws, the holds of the plan last through another arm's
    insertion."""
    for plan in (program, loosened):
        holds = [k for k in placings(plan) if alongside(plan, k, leaves(plan, k)) > alongside(plan, k)]
        assert holds
        for k in holds:
            segment = plan.segments[leaves(plan, k)]
            assert (segment.kind.name, segment.arm) == ("retreat", plan.segments[k].arm)
        assert any(
            plan.segments[i].kind.name == "insert" for k in holds for i in alongside(plan, k, leaves(plan, k))
        )


def test_where_a_placing_ends_is_kept_clear_of_what_moves_later(workcell: Workcell, program: Program) -> None:
    """One at a time nothing runs beside the placing; its hand then stands where the other arm comes by with
    the next piece."""
    k = next(k for k in placings(program) if alongside(program, k, leaves(program, k)))
    segment, qs = program.segments[k], np.array(workcell.robot.home)
    qs[segment.arm] = segment.path[0]
    beside = Concurrent(workcell, program, k, qs, ())
    assert beside.gap(segment.path, CLEARANCE) > 0.0
    transfer = next(
        i
        for i in sorted(alongside(program, k, leaves(program, k)))
        if program.segments[i].kind.name == "transfer"
    )
    other = program.segments[transfer]
    in_the_way = workcell.robot.inverse(
        segment.arm, workcell.robot.tcp(other.arm, other.path[len(other.path) // 2]), segment.path[-1]
    )
    assert len(in_the_way)
    assert beside.gap(np.array([segment.path[0], in_the_way[0]]), CLEARANCE) <= 0.0
    assert (
        beside.gap(np.array([in_the_way[0], segment.path[0]]), CLEARANCE) > 0.0
    )  # gone before the other comes
