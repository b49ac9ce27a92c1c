"""The judge on logs made by hand: each number is what was put in, and only what must be reported is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import Array, apply, make_transform, rotation_about, to_quat_xyzw
from soma_bullet.robot.cell import load_cell
from soma_bullet.robot.model import Cell
from soma_bullet.verdict.judge import Judgement, judge
from soma_bullet.verdict.options import Tolerance
from soma_bullet.world.log import ExecutionLog, SegmentRecord

T_WORLD_ASSEMBLY = make_transform(translation=(0.0, 0.0, 0.1))
# kind, arm, piece; one second each. The right hand brings Z and holds it until the left one has brought BigL.
EPISODE = (
    *(
        (kind, "right", "Z")
        for kind in ("approach", "grasp", "lift", "transfer", "insert", "place", "settle")
    ),
    *(
        (kind, "left", "BigL")
        for kind in ("approach", "grasp", "lift", "transfer", "insert", "place", "settle")
    ),
    ("release", "right", "Z"),
    ("retreat", "right", "Z"),
    ("release", "left", "BigL"),
    ("retreat", "left", "BigL"),
    ("final", "", ""),
)


@pytest.fixture(scope="module")
def assembly() -> Assembly:
    return load_assembly("soma3")


@pytest.fixture(scope="module")
def cell() -> Cell:
    return load_cell("ur5e_pair")


@pytest.fixture(scope="module")
def good(assembly: Assembly, cell: Cell) -> ExecutionLog:
    """Pieces at their goals all along, a sample every half second."""
    none = np.zeros(3)
    segments = tuple(
        SegmentRecord(
            kind, 0 if piece == "Z" else 1, arm, piece, float(k), k + 1.0, "as planned", none, 0.0, 0.0
        )
        for k, (kind, arm, piece) in enumerate(EPISODE)
    )
    times = np.arange(0.0, len(EPISODE) + 0.1, 0.5)
    rows = [np.concatenate(to_quat_xyzw(T_WORLD_ASSEMBLY @ goal)) for goal in assembly.goals]
    names = (*cell.joint_names, *(finger for arm in cell.arms for finger in arm.finger_joints))
    links = tuple(
        link
        for arm in cell.arms
        for link in (arm.prefixed("forearm_link"), arm.prefixed("palm"), *arm.finger_links)
    )
    return ExecutionLog(
        cell=cell.name,
        assembly=assembly.name,
        digest=assembly.digest,
        seed=0,
        order=("Z", "BigL", "smallL"),
        stand=(0.03, 0.03),
        T_world_assembly=T_WORLD_ASSEMBLY,
        joint_names=names,
        target_names=cell.joint_names,
        arm_names=tuple(arm.name for arm in cell.arms),
        piece_names=assembly.names,
        times=times,
        joints=np.tile([*cell.q_home, 0.0, 0.0, 0.0, 0.0], (len(times), 1)),
        targets=np.zeros((len(times), 12)),
        poses=np.tile(rows, (len(times), 1, 1)),
        tcps=np.tile([0.0, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0], (len(times), 2, 1)),
        wrenches=np.zeros((len(times), 2, 6)),
        grips=np.full((len(times), 2), 20.0),
        contacts=np.zeros((0, 5)),
        bodies=(*links, "table", "stand", *assembly.names),
        segments=segments,
        events=(),
        constraints=(),
        ended="done",
    )


def moved(log: ExecutionLog, piece: str, T: Array, start: float = -1.0, end: float = np.inf) -> ExecutionLog:
    """A piece moved by T (4, 4), in the world, in the samples of a time span [s]."""
    poses, k = log.poses.copy(), log.piece_names.index(piece)
    for i in log.between(start, end):
        poses[i, k] = np.concatenate(to_quat_xyzw(T @ log.piece_pose(int(i), piece)))
    return replace(log, poses=poses)


def touched(log: ExecutionLog, a: str, b: str, time: float, force: float = 3.0) -> ExecutionLog:
    """With one more contact at a time [s]."""
    row = [int(np.argmin(np.abs(log.times - time))), log.bodies.index(a), log.bodies.index(b), force, -1e-5]
    return replace(log, contacts=np.vstack([log.contacts, row]))


def verdict(log: ExecutionLog, assembly: Assembly, cell: Cell) -> Judgement:
    return judge(log, assembly, cell, Tolerance())


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


# --- grasps and holds ---------------------------------------------------------------------------------------


def test_slip_in_a_grasp(good: ExecutionLog, assembly: Assembly, cell: Cell) -> None:
    slid = moved(good, "Z", make_transform(translation=(0.0, 0.0, -0.0007)), start=4.5)
    slips = {s.piece: s for s in verdict(slid, assembly, cell).slips}
    assert slips["Z"].slip_mm == pytest.approx(0.7)
    assert slips["BigL"].slip_mm == 0.0


def test_a_piece_that_moves_with_its_hand_does_not_slip(
    good: ExecutionLog, assembly: Assembly, cell: Cell
) -> None:
    motion = make_transform(rotation_about((0, 0, 1), 0.3), (0.1, -0.2, 0.05))
    tcps, k = good.tcps.copy(), good.arm_names.index("right")
    for i in good.between(3.0, 4.0):
        tcps[i, k] = np.concatenate(to_quat_xyzw(motion @ good.tcp_pose(int(i), "right")))
    slips = {
        s.piece: s
        for s in verdict(moved(replace(good, tcps=tcps), "Z", motion, 3.0, 4.0), assembly, cell).slips
    }
    assert slips["Z"].slip_mm == pytest.approx(0.0, abs=1e-9)
    assert slips["Z"].slip_deg == pytest.approx(0.0, abs=1e-5)


def test_drift_in_a_hold(good: ExecutionLog, assembly: Assembly, cell: Cell) -> None:
    grips = good.grips.copy()
    grips[good.between(9.0, 9.0), good.arm_names.index("right")] = 17.0
    drifted = moved(
        replace(good, grips=grips), "Z", make_transform(translation=(0.0004, 0.0, 0.0003)), start=10.0
    )
    holds = {(h.piece, h.arm): h for h in verdict(drifted, assembly, cell).holds}
    hold = holds["Z", "right"]
    assert hold.drift_mm == pytest.approx(0.5)
    assert (hold.seconds, hold.grip_n) == pytest.approx((7.0, 17.0))


def test_a_hand_that_lets_go_at_once_does_not_hold(
    good: ExecutionLog, assembly: Assembly, cell: Cell
) -> None:
    kept = tuple(s for s in good.segments if (s.arm, s.kind) != ("right", "release") or s.piece != "Z")
    early = replace(
        next(s for s in good.segments if (s.kind, s.piece) == ("release", "Z")), start=7.0, end=7.4
    )
    found = verdict(replace(good, segments=(*kept, early)), assembly, cell)
    assert "Z" not in {h.piece for h in found.holds}


def test_insertions_are_reported(good: ExecutionLog, assembly: Assembly, cell: Cell) -> None:
    segments = tuple(
        replace(s, outcome="stopped early", peak_force=1.5, remaining=0.0003)
        if (s.kind, s.piece) == ("place", "BigL")
        else s
        for s in good.segments
    )
    found = verdict(replace(good, segments=segments), assembly, cell).insertions
    assert [(i.piece, i.arm, i.peak_n, i.outcome) for i in found] == [
        ("Z", "right", 0.0, "as planned"), ("BigL", "left", 1.5, "stopped early"),
    ]  # fmt: skip
    assert found[1].remaining_mm == pytest.approx(0.3)


def test_how_an_insertion_ended_is_measured_on_the_piece(
    good: ExecutionLog, assembly: Assembly, cell: Cell
) -> None:
    """BigL comes down along -z and stops 1 mm short and 0.5 mm aside; Z, in place before, is pushed by 0.3 mm
    and back."""
    (place,) = (s for s in good.segments if (s.kind, s.piece) == ("place", "BigL"))
    segments = tuple(
        replace(s, offset=np.array((0.0, 0.0, -0.01))) if s is place else s for s in good.segments
    )
    log = moved(
        replace(good, segments=segments),
        "BigL",
        make_transform(translation=(5e-4, 0.0, 1e-3)),
        place.end,
        place.end,
    )
    log = moved(log, "Z", make_transform(translation=(0.0, 3e-4, 0.0)), place.start + 0.5, place.start + 0.5)
    z, big = verdict(log, assembly, cell).insertions
    assert (big.along_mm, big.across_mm) == pytest.approx((-1.0, 0.5))
    assert big.neighbours_mm == pytest.approx(0.3) and z.neighbours_mm == 0.0
    assert big.went_in and z.went_in
    jammed = tuple(
        replace(s, outcome="jammed") if (s.kind, s.piece) == ("place", "BigL") else s for s in log.segments
    )
    assert [i.went_in for i in verdict(replace(log, segments=jammed), assembly, cell).insertions] == [
        True,
        False,
    ]
    far = moved(log, "BigL", make_transform(translation=(0.0, 0.0, 2e-3)), place.end, place.end)
    assert [i.went_in for i in verdict(far, assembly, cell).insertions] == [True, False]


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
