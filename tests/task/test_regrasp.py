"""Regrasps: put-downs end at rest, hands that meet keep apart, and the program of it all joins up and is
clear."""

from __future__ import annotations

import hashlib
import itertools
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.assembly.resting import steady_poses
from soma_bullet.frames import apply, inverse
from soma_bullet.grasp.graph import GraspGraph
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.store import kept_plan
from soma_bullet.planner.tables import grasp_poses, grasp_table, table_poses
from soma_bullet.records import read_npz, write_npz
from soma_bullet.robot.collision import Situation
from soma_bullet.robot.model import Cell
from soma_bullet.task.actions.hand_over import HandOver
from soma_bullet.task.actions.put_down import PutDown
from soma_bullet.task.program.make import make_program
from soma_bullet.task.program.motions import scene_for
from soma_bullet.task.program.program import Program, moments
from soma_bullet.task.workcell import Workcell
from tests.feeds import UNSERVED, UNSERVED_FIRST, laid

PUT_DOWN, HANDED_OVER = "soma3", "soma4"
NEEDS = {PUT_DOWN: UNSERVED, HANDED_OVER: UNSERVED_FIRST}  # feeds with which something is regrasped


def made(name: str, cell: Cell) -> tuple[Workcell, AssemblyPlan, Program]:
    assembly = load_assembly(name)
    plan, workcell = kept_plan(assembly, cell.hands), Workcell(assembly, cell)
    return workcell, plan, make_program(workcell, plan, laid(workcell, plan, NEEDS[name]), 0)


@pytest.fixture(scope="module")
def put_down(cell: Cell) -> tuple[Workcell, AssemblyPlan, Program]:
    return made(PUT_DOWN, cell)


@pytest.fixture(scope="module")
def handed_over(cell: Cell) -> tuple[Workcell, AssemblyPlan, Program]:
    return made(HANDED_OVER, cell)


@pytest.fixture(params=["put_down", "handed_over"])
def case(request: pytest.FixtureRequest) -> tuple[Workcell, AssemblyPlan, Program]:
    found: tuple[Workcell, AssemblyPlan, Program] = request.getfixturevalue(request.param)
    return found


# --- the graph ----------------------------------------------------------------------------------------------


def graph_of(assembly: Assembly, plan: AssemblyPlan, cell: Cell) -> GraspGraph:
    table = grasp_table(plan, assembly.names[0])
    poses = table_poses(table)
    return GraspGraph(assembly.pieces[0], cell.hands, poses, table.widths, table.contact, table.kinds)


def test_hands_together_is_mutual_and_never_with_oneself(
    soma3: Assembly, plan: AssemblyPlan, cell: Cell
) -> None:
    graph = graph_of(soma3, plan, cell)
    picked = range(0, len(graph.widths), 61)
    for a, b in itertools.product(picked, picked):
        assert graph.together(a)[b] == graph.together(b)[a]
    assert not any(graph.together(a)[a] for a in picked)


@given(st.floats(-np.pi, np.pi), st.integers(0, 5))
@settings(max_examples=20, deadline=None)
def test_what_serves_does_so_at_any_yaw(yaw: float, rest: int) -> None:
    from soma_bullet.frames import make_transform, rotation_about
    from soma_bullet.robot.cell import load_cell

    cell, assembly = load_cell("ur5e_pair"), load_assembly("soma3")
    plan = kept_plan(assembly, cell.hands)
    graph = graph_of(assembly, plan, cell)
    rest = rest % len(graph.resting)
    turned = make_transform(rotation_about((0, 0, 1), yaw), (0.1, 0.2, 0.0)) @ graph.resting[rest]
    assert (graph.above_table(turned) == graph.serving[rest]).mean() > 0.99  # up to rounding at the margin


def test_the_nearest_grasp_is_itself(soma3: Assembly, plan: AssemblyPlan, cell: Cell) -> None:
    graph = graph_of(soma3, plan, cell)
    for k in range(0, len(graph.widths), 37):
        found, off, turned = graph.nearest(graph.poses[k], np.ones(len(graph), bool))
        assert np.allclose(graph.poses[found][:3, 3], graph.poses[k][:3, 3]) and off < 1e-9 and turned < 1e-6


# --- schedules and programs with regrasps -------------------------------------------------------------------


def test_both_kinds_occur(
    put_down: tuple[Workcell, AssemblyPlan, Program], handed_over: tuple[Workcell, AssemblyPlan, Program]
) -> None:
    kinds = [
        [type(r) for a in c[2].schedule.assignments for r in a.regrasps] for c in (put_down, handed_over)
    ]
    assert PutDown in kinds[0] and HandOver in kinds[1]


def test_a_put_down_ends_at_rest(put_down: tuple[Workcell, AssemblyPlan, Program]) -> None:
    workcell, _, program = put_down
    ends = [(after, s) for _, s, after in moments(workcell, program) if s.kind.name == "set_down"]
    assert ends
    for after, segment in ends:
        piece = workcell.assembly.pieces[workcell.assembly.index(segment.piece)]
        pose = after.poses[segment.piece]
        assert min(np.abs(pose[2, :3] - rest[2, :3]).max() for rest in steady_poses(piece)) < 1e-5
        assert apply(pose, piece.vertices)[:, 2].min() == pytest.approx(-piece.clearance, abs=1e-5)
        assert segment.guard > 0 and segment.compliance.shape == (6, 6)
        areas = workcell.cell.feed_areas
        place = apply(pose, piece.center_of_mass)[:2]
        assert any(((place > area[:, 0] - 0.03) & (place < area[:, 1] + 0.03)).all() for area in areas)


def test_a_regrasp_leads_to_the_grasp_that_goes_in(case: tuple[Workcell, AssemblyPlan, Program]) -> None:
    """At every place the piece is where the hand's grasp says."""
    workcell, plan, program = case
    for a in program.schedule.assignments:
        grasp = grasp_poses(plan, a.piece)[0][a.insert.grasp]
        own = [r for r in a.regrasps if r.piece == a.piece]
        last = own[-1] if own else None
        moved = [b.regrasps for b in program.schedule.assignments]
        prepared = [r for chain in moved for r in chain if r.piece == a.piece and isinstance(r, PutDown)]
        expected = program.feed.pose(a.piece) if not prepared else prepared[-1].pose_down
        if isinstance(last, HandOver):
            expected = last.pose_met
            np.testing.assert_allclose(
                workcell.robot.tcp(last.receiver, last.q_take) @ inverse(grasp), expected, atol=2e-6
            )
        if a.pick is not None:
            picked = workcell.robot.tcp(a.arm, a.pick.q_pick) @ inverse(grasp)
            np.testing.assert_allclose(picked, expected, atol=2e-6)


def test_hands_that_meet_keep_apart(handed_over: tuple[Workcell, AssemblyPlan, Program]) -> None:
    workcell, _, program = handed_over
    count = 0
    for before, segment, after in moments(workcell, program):
        if segment.kind.name == "grasp" and len(after.carried) == 2:
            poses = {name: pose for name, pose in before.poses.items() if name != segment.piece}
            scene = workcell.collision.scene(Situation(poses, frozenset({0, 1})))
            q = workcell.robot.configuration(after.qs, after.openings)
            assert not scene.collides(q)
            places = [workcell.robot.tcp(arm, after.qs[arm]) @ T for arm, T in sorted(after.carried.items())]
            np.testing.assert_allclose(places[0], places[1], atol=1e-5)
            count += 1
    assert count == sum(isinstance(r, HandOver) for a in program.schedule.assignments for r in a.regrasps)


def test_nothing_moves_while_both_hands_hold(handed_over: tuple[Workcell, AssemblyPlan, Program]) -> None:
    workcell, _, program = handed_over
    for before, segment, _ in moments(workcell, program):
        if len({before.gripped[arm] for arm in before.carried}) < len(before.carried):
            assert segment.kind.name == "release"


def test_segments_join(case: tuple[Workcell, AssemblyPlan, Program]) -> None:
    workcell, _, program = case
    for before, segment, _ in moments(workcell, program):
        if segment.kind.moves:
            assert np.abs(segment.path[0] - before.qs[segment.arm]).max() < 1e-6, segment.kind
        assert (segment.width is None) == (segment.kind.name != "grasp")


def test_timed_paths_are_free(case: tuple[Workcell, AssemblyPlan, Program]) -> None:
    """Every 50 ms, in the context that follows from the segments alone."""
    workcell, _, program = case
    for before, segment, _ in moments(workcell, program):
        if len(segment.path):
            scene = scene_for(workcell, before, segment)
            for q in segment.path[::24]:
                assert not scene.collides(workcell.configuration(before, segment.arm, q)), segment.kind


def test_everything_ends_in_place(case: tuple[Workcell, AssemblyPlan, Program]) -> None:
    workcell, _, program = case
    *_, (_, _, after) = moments(workcell, program)
    for name in workcell.assembly.names:
        np.testing.assert_allclose(after.poses[name], workcell.settled[name], atol=1e-5)
    assert after.gripped == {} and after.carried == {}


def test_a_program_with_regrasps_is_read_back(
    case: tuple[Workcell, AssemblyPlan, Program], tmp_path: Path
) -> None:
    write_npz(case[2], tmp_path / "one.npz")
    write_npz(read_npz(Program, tmp_path / "one.npz"), tmp_path / "two.npz")
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()


FRESH = """
import sys
from dataclasses import replace
from pathlib import Path
from soma_bullet.records import write_npz
from soma_bullet.robot.cell import load_cell
from tests.task.test_regrasp import made
write_npz(made(sys.argv[1], load_cell("ur5e_pair"))[2], Path(sys.argv[2]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("which", [PUT_DOWN, HANDED_OVER])
def test_a_fresh_process_makes_the_same_bytes(which: str, tmp_path: Path) -> None:
    digests = set()
    for k in range(2):
        file = tmp_path / f"{k}.npz"
        arguments = [sys.executable, "-c", FRESH, which, str(file)]
        subprocess.run(
            arguments, check=True, env={"PYTHONHASHSEED": str(k + 1), "PYTHONPATH": ".", "PATH": ""}
        )
        digests.add(hashlib.sha256(file.read_bytes()).hexdigest())
    assert len(digests) == 1
