"""The judge on logs made by hand: where a piece is, what touched what, limits and the end. Each number is
what was put in, and only what must be reported is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import apply, make_transform, rotation_about
from soma_bullet.robot.model import Cell
from soma_bullet.world.log import ExecutionLog
from tests.verdict.logs import EPISODE, T_WORLD_ASSEMBLY, moved, touched, verdict


def test_a_good_episode_is_a_success(good: ExecutionLog, assembly: Assembly, cell: Cell) -> None:
    found = verdict(good, assembly, cell)
    assert found.success and found.causes == ()
    assert max(p.error_max_mm for p in found.pieces) < 1e-9
    assert max(p.error_deg for p in found.pieces) < 1e-5
    assert [(s.piece, s.arm, s.slip_mm) for s in found.slips] == [("Z", "right", 0.0), ("BigL", "left", 0.0)]
    assert found.makespan_s == len(EPISODE) - 1
    assert found.limits.speed == 0.0 and found.limits.joint_deg > 0.0


# --- where a piece is ---------------------------------------------------------------------------------------


def test_a_shifted_piece(good: ExecutionLog, assembly: Assembly, cell: Cell) -> None:
    found = verdict(moved(good, "BigL", make_transform(translation=(0.0018, 0.0, 0.0024))), assembly, cell)
    piece = found.pieces[assembly.index("BigL")]
    assert (piece.error_mm, piece.error_max_mm) == pytest.approx((3.0, 3.0))
    assert piece.error_deg == pytest.approx(0.0, abs=1e-5)
    assert not piece.in_place and not found.success
    assert found.causes == ("BigL is 3.00 mm and 0.00 deg from its goal",)
    assert all(p.in_place for p in found.pieces if p.name != "BigL")


def test_a_turn_about_the_centre_of_mass_moves_only_the_vertices(
    good: ExecutionLog, assembly: Assembly, cell: Cell
) -> None:
    k = assembly.index("Z")
    goal, piece = T_WORLD_ASSEMBLY @ assembly.goals[k], assembly.pieces[k]
    com = apply(goal, piece.center_of_mass)
    turn = make_transform(translation=com) @ make_transform(rotation_about((0, 0, 1), np.deg2rad(5.0)))
    found = verdict(moved(good, "Z", turn @ make_transform(translation=-com)), assembly, cell).pieces[k]
    across = np.linalg.norm((apply(goal, piece.vertices) - com)[:, :2], axis=1).max()
    assert found.error_mm == pytest.approx(0.0, abs=1e-9)
    assert found.error_deg == pytest.approx(5.0)
    assert found.error_max_mm == pytest.approx(2e3 * across * np.sin(np.deg2rad(2.5)))
    assert not found.in_place


def test_a_turn_about_a_far_axis_counts_as_displacement_too(
    good: ExecutionLog, assembly: Assembly, cell: Cell
) -> None:
    """The piece's own origin means nothing: the centre of mass and the vertices do."""
    k = assembly.index("smallL")
    goal = T_WORLD_ASSEMBLY @ assembly.goals[k]
    about = make_transform(rotation_about((1, 0, 0), np.deg2rad(1.0)))
    found = verdict(moved(good, "smallL", about), assembly, cell).pieces[k]
    com = apply(goal, assembly.pieces[k].center_of_mass)
    assert found.error_mm == pytest.approx(2e3 * np.hypot(com[1], com[2]) * np.sin(np.deg2rad(0.5)))
    assert found.error_deg == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("shift_mm", "turn_deg", "good_enough"),
    [(1.9, 0, True), (2.1, 0, False), (0, 1.9, True), (0, 2.1, False)],
)
def test_the_tolerance_is_sharp(
    good: ExecutionLog, assembly: Assembly, cell: Cell, shift_mm: float, turn_deg: float, good_enough: bool
) -> None:
    k = assembly.index("Z")
    com = apply(T_WORLD_ASSEMBLY @ assembly.goals[k], assembly.pieces[k].center_of_mass)
    turn = make_transform(rotation_about((0, 1, 0), np.deg2rad(turn_deg)))
    T = make_transform(translation=com + (0, 0, shift_mm * 1e-3)) @ turn @ make_transform(translation=-com)
    assert verdict(moved(good, "Z", T), assembly, cell).success == good_enough


def test_only_the_last_sample_decides(good: ExecutionLog, assembly: Assembly, cell: Cell) -> None:
    away = moved(good, "Z", make_transform(translation=(0.1, 0, 0)), end=good.times[-1] - 0.1)
    assert verdict(away, assembly, cell).pieces[assembly.index("Z")].in_place


# --- what touched what --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("a", "b", "time"),
    [
        ("Z", "table", 0.5),  # in the feed
        ("Z", "table", 2.5),  # while it is lifted
        ("smallL", "table", 15.0),  # never lifted
        ("Z", "stand", 6.0),
        ("Z", "BigL", 13.0),
        ("right_finger_left", "Z", 1.5),  # closes
        ("right_finger_right", "Z", 10.0),  # holds
        ("right_finger_right", "Z", 15.5),  # leaves
        ("left_finger_left", "BigL", 13.5),
    ],
)
def test_contacts_that_are_meant(
    good: ExecutionLog, assembly: Assembly, cell: Cell, a: str, b: str, time: float
) -> None:
    for log in (touched(good, a, b, time), touched(good, b, a, time)):
        found = verdict(log, assembly, cell)
        assert found.success and found.forbidden == ()


@pytest.mark.parametrize(
    ("a", "b", "time"),
    [
        ("left_finger_left", "Z", 13.5),  # the other hand on a piece that is held
        ("right_finger_left", "BigL", 13.5),
        ("right_finger_left", "Z", 0.0 + 16.5),  # after its retreat
        ("right_palm", "Z", 5.0),  # palms never touch
        ("left_forearm_link", "right_forearm_link", 4.0),
        ("left_finger_left", "right_finger_left", 13.0),
        ("left_palm", "table", 7.5),
        ("right_palm", "stand", 5.5),
        ("BigL", "stand", 13.0),  # no neighbours in the finished assembly
        ("left_finger_left", "table", 8.5),
    ],
)
def test_contacts_that_are_forbidden(
    good: ExecutionLog, assembly: Assembly, cell: Cell, a: str, b: str, time: float
) -> None:
    found = verdict(touched(touched(good, a, b, time, 3.0), b, a, time + 0.5, 7.0), assembly, cell)
    assert not found.success and found.dropped == ()
    (contact,) = found.forbidden
    assert (contact.body_a, contact.body_b) == tuple(sorted((a, b)))
    assert (contact.first_s, contact.samples, contact.force_n) == (time, 2, 7.0)
    assert found.causes == (f"{contact.body_a} touched {contact.body_b} at {time:.2f} s (7.0 N)",)


def test_a_piece_on_the_table_after_its_lift_was_dropped(
    good: ExecutionLog, assembly: Assembly, cell: Cell
) -> None:
    found = verdict(touched(good, "Z", "table", 4.5), assembly, cell)
    assert found.dropped == ("Z",)
    assert found.causes == ("Z was dropped",)


# --- limits and the end -------------------------------------------------------------------------------------


def test_a_joint_beyond_its_range(good: ExecutionLog, assembly: Assembly, cell: Cell) -> None:
    joints, arm = good.joints.copy(), cell.arms[1]
    joints[:, good.joint_names.index(arm.joint_names[2])] = arm.upper[2] + np.deg2rad(0.5)
    found = verdict(replace(good, joints=joints), assembly, cell)
    assert found.limits.joint_deg == pytest.approx(-0.5)
    assert found.causes == ("a joint left its range by 0.50 deg",)


@pytest.mark.parametrize(("fraction", "good_enough"), [(1.0, True), (1.2, False)])
def test_a_joint_that_is_too_fast(
    good: ExecutionLog, assembly: Assembly, cell: Cell, fraction: float, good_enough: bool
) -> None:
    joints, arm = good.joints.copy(), cell.arms[0]
    joints[20:, good.joint_names.index(arm.joint_names[5])] += fraction * arm.velocity[5] * 0.5
    found = verdict(replace(good, joints=joints), assembly, cell)
    assert found.limits.speed == pytest.approx(fraction)
    assert found.success == good_enough


def test_an_episode_that_ended_early_is_a_failure(good: ExecutionLog, assembly: Assembly, cell: Cell) -> None:
    found = verdict(replace(good, ended="BigL jammed in place (5.2 N, 3.1 mm left)"), assembly, cell)
    assert not found.success
    assert found.causes == ("BigL jammed in place (5.2 N, 3.1 mm left)",)
