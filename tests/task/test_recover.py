"""Programs that go on from a state as found: from any moment of another program, also with arms and pieces
elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soma_bullet.assembly.model import Assembly
from soma_bullet.errors import NoSolutionError
from soma_bullet.frames import Array, from_quat_xyzw, inverse, make_transform, rotation_about, translate
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.records import read_npz, write_npz
from soma_bullet.robot.model import Cell
from soma_bullet.task.assignments import Carried, PutDown, Square, Start
from soma_bullet.task.feed import Feed, draw_feed
from soma_bullet.task.feed_options import FeedOptions
from soma_bullet.task.overlap import overlapped
from soma_bullet.task.program import make_program, recover_program
from soma_bullet.task.schedule import Scheduler
from soma_bullet.task.segments import MOTIONS, Context, Program, contexts
from soma_bullet.task.workcell import Workcell


def found(context: Context) -> Start:
    """The state after a segment, as an executive would report it."""
    carried = sorted(context.carried.items())
    carrying = tuple(Carried(piece, arm, T_tcp_piece) for arm, (piece, T_tcp_piece) in carried)
    held = {arm: piece for arm, piece in context.hands.gripped.items() if piece in context.placed}
    return Start(len(context.placed), dict(context.poses), replace(context.hands, gripped=held), carrying)


def after(workcell: Workcell, program: Program, kind: str, piece: str) -> Start:
    return next(found(c) for _, s, c in contexts(workcell, program) if (s.kind, s.piece) == (kind, piece))


def _some_grasp(plan: AssemblyPlan, piece: str) -> Array:
    """T_piece_tcp (4, 4)."""
    pose = next(table for table in plan.grasps if table.piece == piece).poses[0]
    return from_quat_xyzw(pose[:3], pose[3:])


def assert_goes_on(workcell: Workcell, program: Program, start: Start) -> None:
    """Every path starts where the arm is; in the end all pieces are in place and both hands empty at home."""
    assert program.start is start
    np.testing.assert_array_equal(next(contexts(workcell, program))[0].hands.qs, start.hands.qs)
    for before, segment, _ in contexts(workcell, program):
        if segment.kind in MOTIONS:
            assert np.abs(segment.path[0] - before.hands.qs[segment.arm]).max() < 1e-6, segment.kind
    *_, (_, _, last) = contexts(workcell, program)
    for name in workcell.assembly.names:
        np.testing.assert_allclose(last.poses[name], workcell.settled[name], atol=1e-5)
    assert last.hands.gripped == {} and last.carried == {}
    np.testing.assert_allclose(last.hands.qs, workcell.robot.home, atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "piece"),
    [
        ("transit", "Z"),
        ("approach", "Z"),
        ("grasp", "Z"),
        ("lift", "Z"),
        ("insert", "Z"),
        ("place", "Z"),
        ("approach", "BigL"),
        ("transfer", "BigL"),
        ("insert", "BigL"),
        ("settle", "BigL"),
        ("transit", "smallL"),
        ("insert", "smallL"),
        ("place", "smallL"),
        ("retreat", "smallL"),
    ],
)
def test_goes_on_from_anywhere(
    kind: str, piece: str, workcell: Workcell, plan: AssemblyPlan, program: Program
) -> None:
    start = after(workcell, program, kind, piece)
    assert_goes_on(workcell, recover_program(workcell, plan, start, 5), start)


@pytest.mark.parametrize("square", [True, False])
def test_pieces_are_squared_as_before(
    square: bool, workcell: Workcell, plan: AssemblyPlan, program: Program
) -> None:
    """What lies where an inexact camera saw it is squared, unless the episode goes without."""
    start = after(workcell, program, "transit", "smallL")
    made = recover_program(workcell, plan, start, 0, noise=(0.5, 0.5), square=square)
    squared = [r for a in made.schedule.assignments for r in a.regrasps if isinstance(r, Square)]
    assert bool(squared) == square


def test_a_piece_in_the_hand_goes_straight_in(
    workcell: Workcell, plan: AssemblyPlan, program: Program
) -> None:
    made = recover_program(workcell, plan, after(workcell, program, "transfer", "BigL"), 0)
    assert [s.kind for s in made.segments if s.piece == "BigL"][:4] == [
        "transfer",
        "insert",
        "place",
        "settle",
    ]
    assert made.schedule.assignments[0].in_hand


def test_a_piece_that_sits_wrong_in_the_hand_is_gripped_anew(
    workcell: Workcell, plan: AssemblyPlan, program: Program
) -> None:
    start = after(workcell, program, "transfer", "Z")
    (carried,) = start.carrying
    turned = make_transform(rotation_about((1, 0, 0), np.deg2rad(20.0))) @ carried.T_tcp_piece
    pose = workcell.robot.tcp(carried.arm, start.hands.qs[carried.arm]) @ turned
    start = replace(start, carrying=(replace(carried, T_tcp_piece=turned),), poses={**start.poses, "Z": pose})
    made = recover_program(workcell, plan, start, 0)
    assert_goes_on(workcell, made, start)
    assert made.schedule.assignments[0].regrasps


def test_a_piece_whose_turn_is_later_is_put_down(
    workcell: Workcell, plan: AssemblyPlan, program: Program
) -> None:
    start = after(workcell, program, "transfer", "Z")
    (carried,) = start.carrying
    last = plan.order[-1]
    poses = {**start.poses, last: start.poses["Z"], "Z": program.feed.pose("Z")}
    carrying = Carried(last, carried.arm, inverse(_some_grasp(plan, last)))
    poses[last] = workcell.robot.tcp(carrying.arm, start.hands.qs[carrying.arm]) @ carrying.T_tcp_piece
    start = replace(start, carrying=(carrying,), poses=poses)
    made = recover_program(workcell, plan, start, 0)
    first = made.schedule.assignments[0].regrasps[0]
    assert isinstance(first, PutDown) and first.piece == last and first.pick is None
    assert_goes_on(workcell, made, start)


def test_a_hold_that_was_lost_is_taken_up_again(
    workcell: Workcell, plan: AssemblyPlan, program: Program
) -> None:
    """Z stands, nothing holds it, and the plan wants it held: a free hand takes it before the next step."""
    start = after(workcell, program, "place", "Z")
    idle = replace(workcell.idle(), gripped={})
    start = replace(start, hands=idle)
    made = recover_program(workcell, plan, start, 0)
    (take,) = made.schedule.takes
    assert take.piece == "Z" and take.certificate.margin >= 1
    assert [s.kind for s in made.segments[:3]] == ["transit", "approach", "grasp"]
    assert made.segments[2].width == take.width
    grip = [c for _, s, c in contexts(workcell, made) if s.kind == "grasp"][0]
    assert grip.hands.gripped == {take.arm: "Z"} and grip.carried == {}
    assert_goes_on(workcell, made, start)


def test_pieces_as_found_are_obstacles_and_are_picked_there(
    workcell: Workcell, plan: AssemblyPlan, program: Program
) -> None:
    start = after(workcell, program, "place", "Z")
    moved = translate(start.poses["BigL"], (0.02, -0.015, 0.0))
    shifted = translate(start.poses["Z"], (0.0005, 0.0, 0.0))  # within what counts as in place
    start = replace(start, poses={**start.poses, "BigL": moved, "Z": shifted})
    made = recover_program(workcell, plan, start, 0)
    np.testing.assert_allclose(made.feed.pose("BigL"), moved)
    assert_goes_on(workcell, made, start)


def test_the_same_start_makes_the_same_bytes(
    workcell: Workcell, plan: AssemblyPlan, program: Program, tmp_path: object
) -> None:
    from pathlib import Path

    folder, start = Path(str(tmp_path)), after(workcell, program, "lift", "BigL")
    for name in ("one", "two"):
        write_npz(recover_program(workcell, plan, start, 3), folder / f"{name}.npz")
    write_npz(read_npz(Program, folder / "one.npz"), folder / "three.npz")
    assert len({(folder / f"{name}.npz").read_bytes() for name in ("one", "two", "three")}) == 1


def test_a_piece_off_the_table_is_out_of_reach(
    workcell: Workcell, plan: AssemblyPlan, program: Program, cell: Cell
) -> None:
    start = after(workcell, program, "place", "Z")
    start = replace(start, poses={**start.poses, "BigL": translate(start.poses["BigL"], (0.0, 2.0, 0.0))})
    with pytest.raises(NoSolutionError, match="BigL cannot be picked where it is"):
        recover_program(workcell, plan, start, 0)


@pytest.mark.parametrize("seed", [8405, 8416])
def test_of_two_pieces_in_hands_the_later_is_put_down(
    seed: int, workcell: Workcell, soma3: Assembly, plan: AssemblyPlan, cell: Cell
) -> None:
    """While one piece is on its way to its place the other arm has fetched the next; then all is planned
    anew."""
    program = overlapped(
        workcell, make_program(workcell, plan, draw_feed(soma3, plan, cell, seed, FeedOptions()), 0)
    )
    starts = [found(context) for _, _, context in contexts(workcell, program)]
    both = [start for start in starts if len({carried.piece for carried in start.carrying}) == 2]
    assert both
    for start in both:
        made = recover_program(workcell, plan, start, 3)
        assert_goes_on(workcell, made, start)
        first, later = sorted((carried.piece for carried in start.carrying), key=plan.order.index)
        assignment = made.schedule.assignments[0]
        assert assignment.in_hand and assignment.piece == first
        (put,) = assignment.regrasps
        assert isinstance(put, PutDown) and put.pick is None and put.piece == later


def test_a_piece_that_cannot_be_put_down_where_planned_is_put_down_elsewhere(
    workcell: Workcell, plan: AssemblyPlan, program: Program
) -> None:
    """What the motions rule out is not proposed again."""
    start = after(workcell, program, "lift", plan.order[1])
    (carried,) = start.carrying
    hands = workcell.idle().with_arm(
        carried.arm, start.hands.qs[carried.arm], float(start.hands.openings[carried.arm])
    )
    start = replace(start, step=0, hands=hands, poses={**start.poses, "Z": program.feed.pose("Z")})
    names = workcell.assembly.names
    scheduler = Scheduler(
        workcell, plan, Feed(names, np.array([start.poses[name] for name in names]), 0, 0, 0), start
    )
    places = []
    for _ in range(3):
        assignment = scheduler.find().assignments[0]
        put = assignment.regrasps[0]
        assert isinstance(put, PutDown)
        places.append(put.pose_down.tobytes())
        scheduler.rule_out(assignment, put)
    assert len(set(places)) == 3
