"""The judge on logs made by hand: slip in a grasp, drift in a hold, and how insertions ended."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import make_transform, rotation_about, to_quat_xyzw
from soma_bullet.robot.model import Cell
from soma_bullet.world.log import ExecutionLog
from tests.verdict.logs import moved, verdict


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
