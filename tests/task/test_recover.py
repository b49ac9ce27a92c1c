"""Programs that go on from a state as found: from any moment of another program, also with arms and pieces elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soma_bullet.errors import NoSolutionError
from soma_bullet.frames import make_transform, rotation_about, translate
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.records import read_npz, write_npz
from soma_bullet.robot.model import Cell
from soma_bullet.task.assignments import Carried, PutDown, Square, Start
from soma_bullet.task.program import recover_program
from soma_bullet.task.segments import MOTIONS, Context, Program, contexts
from soma_bullet.task.workcell import Workcell


def found(context: Context) -> Start:
    """The state after a segment, as an executive would report it."""
    carried = sorted(context.carried.items())
    carrying = Carried(carried[0][1][0], carried[0][0], carried[0][1][1]) if carried else None
    held = {arm: piece for arm, piece in context.hands.gripped.items() if piece in context.placed}
    return Start(len(context.placed), dict(context.poses), replace(context.hands, gripped=held), carrying)


def after(workcell: Workcell, program: Program, kind: str, piece: str) -> Start:
    return next(found(c) for _, s, c in contexts(workcell, program) if (s.kind, s.piece) == (kind, piece))


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
def test_goes_on_from_anywhere(kind: str, piece: str, workcell: Workcell, plan: AssemblyPlan, program: Program) -> None:
    start = after(workcell, program, kind, piece)
    assert_goes_on(workcell, recover_program(workcell, plan, start, 5), start)


@pytest.mark.parametrize("square", [True, False])
def test_pieces_are_squared_as_before(square: bool, workcell: Workcell, plan: AssemblyPlan, program: Program) -> None:
    """What lies where an inexact camera saw it is squared, unless the episode goes without."""
    start = after(workcell, program, "transit", "smallL")
    made = recover_program(workcell, plan, start, 0, noise=(0.5, 0.5), square=square)
    squared = [r for a in made.schedule.assignments for r in a.regrasps if isinstance(r, Square)]
    assert bool(squared) == square


def test_a_piece_in_the_hand_goes_straight_in(workcell: Workcell, plan: AssemblyPlan, program: Program) -> None:
    made = recover_program(workcell, plan, after(workcell, program, "transfer", "BigL"), 0)
    assert [s.kind for s in made.segments if s.piece == "BigL"][:4] == ["transfer", "insert", "place", "settle"]
    assert made.schedule.assignments[0].in_hand


def test_a_piece_that_sits_wrong_in_the_hand_is_gripped_anew(workcell: Workcell, plan: AssemblyPlan, program: Program) -> None:
    start = after(workcell, program, "transfer", "Z")
    assert start.carrying is not None
    turned = make_transform(rotation_about((1, 0, 0), np.deg2rad(20.0))) @ start.carrying.T_tcp_piece
    pose = workcell.robot.tcp(start.carrying.arm, start.hands.qs[start.carrying.arm]) @ turned
    start = replace(start, carrying=replace(start.carrying, T_tcp_piece=turned), poses={**start.poses, "Z": pose})
    made = recover_program(workcell, plan, start, 0)
    assert_goes_on(workcell, made, start)
    assert made.schedule.assignments[0].regrasps


def test_a_piece_whose_turn_is_later_is_put_down(workcell: Workcell, plan: AssemblyPlan, program: Program) -> None:
    start = after(workcell, program, "transfer", "Z")
    assert start.carrying is not None
    last = plan.order[-1]
    carrying = Carried(last, start.carrying.arm, start.carrying.T_tcp_piece)
    poses = {**start.poses, last: start.poses["Z"], "Z": program.feed.pose("Z")}
    graph_poses = next(t for t in plan.grasps if t.piece == last)
    from soma_bullet.frames import from_quat_xyzw, inverse

    grasp = from_quat_xyzw(graph_poses.poses[0][:3], graph_poses.poses[0][3:])
    carrying = replace(carrying, T_tcp_piece=inverse(grasp))
    poses[last] = workcell.robot.tcp(carrying.arm, start.hands.qs[carrying.arm]) @ carrying.T_tcp_piece
    start = replace(start, carrying=carrying, poses=poses)
    made = recover_program(workcell, plan, start, 0)
    first = made.schedule.assignments[0].regrasps[0]
    assert isinstance(first, PutDown) and first.piece == last and first.pick is None
    assert_goes_on(workcell, made, start)


def test_a_hold_that_was_lost_is_taken_up_again(workcell: Workcell, plan: AssemblyPlan, program: Program) -> None:
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


def test_pieces_as_found_are_obstacles_and_are_picked_there(workcell: Workcell, plan: AssemblyPlan, program: Program) -> None:
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


def test_a_piece_off_the_table_is_out_of_reach(workcell: Workcell, plan: AssemblyPlan, program: Program, cell: Cell) -> None:
    start = after(workcell, program, "place", "Z")
    start = replace(start, poses={**start.poses, "BigL": translate(start.poses["BigL"], (0.0, 2.0, 0.0))})
    with pytest.raises(NoSolutionError, match="BigL cannot be picked where it is"):
        recover_program(workcell, plan, start, 0)
