"""Pieces that are not quite where they seem to be are squared before they are picked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from soma_bullet.assembly.model import Assembly
from soma_bullet.assembly.resting import steady_poses
from soma_bullet.frames import make_transform, rotation_about
from soma_bullet.grasp.clearance import OPENING, sweep_hand
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.records import read_npz, write_npz
from soma_bullet.robot.model import Cell
from soma_bullet.sizes import Sizes
from soma_bullet.task.actions.square import ACROSS, Square, squeezing_grips
from soma_bullet.task.program.make import make_program
from soma_bullet.task.program.program import Program, moments
from soma_bullet.task.workcell import Workcell
from tests.feeds import APART, laid

NOISE = (0.5, 0.5)  # [mm], [deg]


@pytest.fixture(scope="module")
def noisy(workcell: Workcell, plan: AssemblyPlan) -> Program:
    return make_program(workcell, plan, laid(workcell, plan, APART, NOISE), 0)


def test_an_exact_feed_is_picked_at_once(program: Program) -> None:
    assert program.feed.noise == (0.0, 0.0)
    assert not any(isinstance(r, Square) for a in program.schedule.assignments for r in a.regrasps)


def test_every_piece_is_squared_across_its_grasp(noisy: Program, workcell: Workcell) -> None:
    assert noisy.feed.noise == NOISE
    for a in noisy.schedule.assignments:
        (square,) = a.regrasps
        assert isinstance(square, Square) and (square.piece, square.arm) == (a.piece, a.arm)
        first, second = (workcell.robot.tcp(a.arm, q)[:3, 0] for q in (square.q_grasp, a.pick.q_pick))
        assert abs(first @ second) < ACROSS and abs(first[2]) < ACROSS
        off = noisy.feed.off(workcell.assembly.pieces[workcell.assembly.index(a.piece)])
        assert off > 1.5e-3
        for width, opened in ((square.width, square.opened), (a.pick.width, a.pick.opened)):
            assert opened == pytest.approx(
                min(width + 2 * (OPENING + off), workcell.cell.arms[a.arm].hand.opening)
            )


def test_its_segments(noisy: Program, workcell: Workcell) -> None:
    for a in noisy.schedule.assignments:
        kinds = [
            s.kind.name for s in noisy.segments if s.step == a.step and s.piece == a.piece and s.arm == a.arm
        ]
        assert kinds[:9] == [
            "transit", "approach", "grasp", "release", "retreat", "transit", "approach", "grasp", "lift",
        ]  # fmt: skip
    for before, segment, after in moments(workcell, noisy):
        if segment.kind.name == "retreat" and segment.piece not in before.placed:
            assert segment.arm not in after.carried and segment.arm not in after.gripped


def test_it_is_the_same_again_and_is_read_back(
    noisy: Program, workcell: Workcell, plan: AssemblyPlan, tmp_path: Path
) -> None:
    again = make_program(workcell, plan, noisy.feed, 0)
    assert [s.path.tobytes() for s in again.segments] == [s.path.tobytes() for s in noisy.segments]
    write_npz(noisy, tmp_path / "program.npz")
    read = read_npz(Program, tmp_path / "program.npz")
    assert read.feed.noise == noisy.feed.noise
    assert all(isinstance(a.regrasps[0], Square) for a in read.schedule.assignments)


def test_squeezing_hands_touch_the_outermost_points(soma3: Assembly, cell: Cell) -> None:
    """Whatever the pose: the pads are as far apart as the piece is wide there, level, and above the table."""
    hand = cell.arms[0].hand
    for piece in soma3.pieces:
        for rest in steady_poses(piece):
            pose = make_transform(rotation_about((0, 0, 1), 0.4), (0.2, 0.3, 0.0)) @ rest
            for grip in squeezing_grips(piece, hand, pose, [np.array((1.0, 0.0, 0.0))], Sizes(1.0)):
                tcp = pose @ grip.T_piece_tcp
                assert abs(tcp[:3, 0] @ (1, 0, 0)) < 1e-9 and abs(tcp[2, 0]) < 1e-9
                across = (piece.vertices @ pose[:3, :3].T + pose[:3, 3] - tcp[:3, 3]) @ tcp[:3, 0]
                assert across.max() == pytest.approx(grip.width / 2) and across.min() == pytest.approx(
                    -grip.width / 2
                )
                assert (sweep_hand(hand, tcp[None], np.array([grip.width])).above(0.0) > 0).all() or abs(
                    tcp[2, 2]
                ) < 0.99
