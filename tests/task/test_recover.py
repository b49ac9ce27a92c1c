"""Programs that go on from a state as found: from any moment of another program, also with arms and pieces
elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soma_bullet.errors import NoSolutionError
from soma_bullet.frames import Array, from_quat_xyzw, inverse, make_transform, rotation_about, translate
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.records import read_npz, write_npz
from soma_bullet.robot.model import Cell
from soma_bullet.task.actions.hold import Hold
from soma_bullet.task.actions.put_down import PutDown
from soma_bullet.task.actions.square import Square
from soma_bullet.task.feed import Feed
from soma_bullet.task.program.make import recover_program
from soma_bullet.task.program.program import Program, moments
from soma_bullet.task.search.scheduler import Scheduler
from soma_bullet.task.state import CellState
from soma_bullet.task.workcell import Workcell


def after(workcell: Workcell, program: Program, kind: str, piece: str) -> CellState:
    """The state after a segment."""
    along = moments(workcell, program)
    return next(state for _, s, state in along if (s.kind.name, s.piece) == (kind, piece))


def _some_grasp(plan: AssemblyPlan, piece: str) -> Array:
    """T_piece_tcp (4, 4)."""
    pose = next(table for table in plan.grasps if table.piece == piece).poses[0]
    return from_quat_xyzw(pose[:3], pose[3:])


def assert_goes_on(workcell: Workcell, program: Program, start: CellState) -> None:
    """Every path starts where the arm is; in the end all pieces are in place and both hands empty at home."""
    assert program.start is start
    np.testing.assert_array_equal(next(moments(workcell, program))[0].qs, start.qs)
    for before, segment, _ in moments(workcell, program):
        if segment.kind.moves:
            assert np.abs(segment.path[0] - before.qs[segment.arm]).max() < 1e-6, segment.kind
    *_, (_, _, last) = moments(workcell, program)
    for name in workcell.assembly.names:
        np.testing.assert_allclose(last.poses[name], workcell.settled[name], atol=1e-5)
    assert last.gripped == {} and last.carried == {}
    np.testing.assert_allclose(last.qs, workcell.robot.home, atol=1e-6)


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
    assert [s.kind.name for s in made.segments if s.piece == "BigL"][:4] == [
        "transfer",
        "insert",
        "place",
        "settle",
    ]
    assert made.schedule.assignments[0].bring == ()


def test_a_piece_that_sits_wrong_in_the_hand_is_gripped_anew(
    workcell: Workcell, plan: AssemblyPlan, program: Program
) -> None:
    start = after(workcell, program, "transfer", "Z")
    ((arm, T_tcp_piece),) = start.carried.items()
    turned = make_transform(rotation_about((1, 0, 0), np.deg2rad(20.0))) @ T_tcp_piece
    pose = workcell.robot.tcp(arm, start.qs[arm]) @ turned
    start = replace(start, carried={arm: turned}, poses={**start.poses, "Z": pose})
    made = recover_program(workcell, plan, start, 0)
    assert_goes_on(workcell, made, start)
    assert made.schedule.assignments[0].regrasps


def test_a_piece_whose_turn_is_later_is_put_down(
    workcell: Workcell, plan: AssemblyPlan, program: Program
) -> None:
    start = after(workcell, program, "transfer", "Z")
    (arm,) = start.carried
    last, poses = plan.order[-1], {**start.poses, "Z": program.feed.pose("Z")}
    T_tcp_piece = inverse(_some_grasp(plan, last))
    poses[last] = workcell.robot.tcp(arm, start.qs[arm]) @ T_tcp_piece
    start = replace(start, gripped={arm: last}, carried={arm: T_tcp_piece}, poses=poses)
    made = recover_program(workcell, plan, start, 0)
    first = made.schedule.assignments[0].regrasps[0]
    assert isinstance(first, PutDown) and first.piece == last
    assert first is made.schedule.assignments[0].bring[0]
    assert_goes_on(workcell, made, start)


def test_a_hold_that_was_lost_is_taken_up_again(
    workcell: Workcell, plan: AssemblyPlan, program: Program
) -> None:
    """Z stands, nothing holds it, and the plan wants it held: a free hand takes it before the next step."""
    start = after(workcell, program, "place", "Z")
    idle = workcell.idle()
    start = replace(start, qs=idle.qs, openings=idle.openings, gripped={}, carried={})
    made = recover_program(workcell, plan, start, 0)
    (take,) = made.schedule.changes
    assert isinstance(take, Hold)
    assert take.piece == "Z" and take.certificate.margin >= 1
    assert [s.kind.name for s in made.segments[:3]] == ["transit", "approach", "grasp"]
    assert made.segments[2].width == take.width
    grip = [c for _, s, c in moments(workcell, made) if s.kind.name == "grasp"][0]
    assert grip.gripped == {take.arm: "Z"} and grip.carried == {}
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


def test_of_two_pieces_in_hands_the_later_is_put_down(
    workcell: Workcell, plan: AssemblyPlan, loosened: Program
) -> None:
    """While one piece is on its way to its place the other arm has fetched the next; then all is planned
    anew."""
    starts = [state for _, _, state in moments(workcell, loosened)]
    both = [start for start in starts if len({start.gripped[arm] for arm in start.carried}) == 2]
    assert len(both) >= 2
    for start in (both[0], both[-1]):
        made = recover_program(workcell, plan, start, 3)
        assert_goes_on(workcell, made, start)
        first, later = sorted((start.gripped[arm] for arm in start.carried), key=plan.order.index)
        assignment = made.schedule.assignments[0]
        assert assignment.pick is None and assignment.piece == first
        (put,) = assignment.bring
        assert isinstance(put, PutDown) and put.piece == later


def test_a_piece_that_cannot_be_put_down_where_planned_is_put_down_elsewhere(
    workcell: Workcell, plan: AssemblyPlan, program: Program
) -> None:
    """What the motions rule out is not proposed again."""
    start = after(workcell, program, "lift", plan.order[1])
    (arm,) = start.carried
    held = workcell.idle().with_arm(arm, start.qs[arm], float(start.openings[arm]))
    held = held.gripping(arm, start.gripped[arm]).carrying(arm, start.carried[arm])
    start = replace(held, poses={**start.poses, "Z": program.feed.pose("Z")})
    names = workcell.assembly.names
    scheduler = Scheduler(
        workcell, plan, Feed(names, np.array([start.poses[name] for name in names]), 0, 0, 0), start
    )
    places = []
    for _ in range(3):
        assignment = scheduler.find().assignments[0]
        put = assignment.regrasps[0]
        assert isinstance(put, PutDown)
        places.append(put.place)
        scheduler.rule_out(assignment, put)
    assert len(set(places)) == 3
