"""The film before it is drawn: its frames are where they should be in time, its camera never jumps, its arrow
is there when a piece goes in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soma_bullet.assembly.model import Assembly
from soma_bullet.pictures.camera import CAMERAS
from soma_bullet.pictures.crew import Shot
from soma_bullet.pictures.film import _interpolated, frame_times, storyboard
from soma_bullet.pictures.options import FilmOptions
from soma_bullet.pictures.views import HOLD, framed
from soma_bullet.robot.model import Cell
from soma_bullet.world.log import ExecutionLog


@pytest.mark.parametrize(("speed", "fps"), [(4.0, 30.0), (1.0, 24.0), (10.0, 12.5)])
def test_frame_times(log: ExecutionLog, speed: float, fps: float) -> None:
    times = frame_times(log, FilmOptions(speed=speed, fps=fps))
    np.testing.assert_allclose(np.diff(times), 1 / fps)
    assert times[0] == 0.0 and 0 <= log.times[-1] / speed + HOLD - times[-1] < 1 / fps


def test_between_samples_poses_are_interpolated(log: ExecutionLog) -> None:
    turned = log.poses.copy()
    turned[:, 0, 3:] = (0.0, 0.0, 0.0, 1.0)
    turned[100:, 0, 3:] = (0.0, 0.0, 1.0, 0.0)  # half a turn from one sample to the next
    changed = replace(log, poses=turned)
    clock = np.array([0.75 * log.times[99] + 0.25 * log.times[100], 0.0, 1e3])
    joints, poses = _interpolated(changed, clock)
    np.testing.assert_allclose(
        np.abs(poses[0, 0, 3:]), (0, 0, np.sin(np.pi / 8), np.cos(np.pi / 8)), atol=1e-9
    )
    np.testing.assert_allclose(
        poses[0, 2, :3], 0.75 * log.poses[99, 2, :3] + 0.25 * log.poses[100, 2, :3], atol=1e-12
    )
    np.testing.assert_allclose(poses[2, 1, :3], log.poses[-1, 1, :3])
    np.testing.assert_array_equal(joints[1], log.joints[0])


def test_the_camera_never_jumps(board: list[Shot]) -> None:
    cameras = [shot.camera for shot in board]
    eyes = np.array([camera.eye for camera in cameras])
    angles = np.array([(camera.yaw, camera.pitch) for camera in cameras])
    scales = np.log([camera.distance for camera in cameras])
    assert np.abs(np.diff(angles, axis=0)).max() < 2.5  # [deg] a frame at 30 frames a second
    assert np.abs(np.diff(scales)).max() < 0.07
    assert np.linalg.norm(np.diff(eyes, axis=0), axis=1).max() < 0.08  # [m]
    # nor does it jerk: the change from frame to frame changes slowly
    assert np.abs(np.diff(angles, 2, axis=0)).max() < 0.6
    assert np.abs(np.diff(scales, 2)).max() < 0.02


def test_the_picked_and_the_inserted_piece_are_in_the_picture(board: list[Shot], log: ExecutionLog) -> None:
    for segment in log.segments:
        if segment.kind not in ("grasp", "place"):
            continue
        frames = [k for k in range(len(board)) if segment.start <= k / 30 * 4 <= segment.end]
        assert frames
        for k in frames:
            position = board[k].poses[log.piece_names.index(segment.piece), :3]
            ((right, up),) = board[k].camera.project([position], 16 / 9)
            assert abs(right) < 0.95 and -0.75 < up < 0.95, (segment.kind, segment.piece)


def test_insertions_are_seen_from_nearer(board: list[Shot], log: ExecutionLog) -> None:
    def mean_distance(kind: str) -> float:
        spans = [(s.start, s.end) for s in log.segments if s.kind == kind]
        return float(
            np.mean(
                [b.camera.distance for k, b in enumerate(board) if any(s <= k / 7.5 <= e for s, e in spans)]
            )
        )

    assert mean_distance("place") < 0.85 * mean_distance("grasp")


def test_a_named_camera_stays(log: ExecutionLog, assembly: Assembly, cell: Cell) -> None:
    shots = storyboard(log, assembly, cell, FilmOptions(camera="front"))
    assert {shot.camera for shot in shots} == {CAMERAS["front"]}
    assert shots[-1].caption.text == "soma3: Z ← BigL ← smallL"


def test_the_arrow_is_there_from_the_transfer_to_the_settling(
    board: list[Shot], log: ExecutionLog, assembly: Assembly
) -> None:
    for k, shot in enumerate(board):
        inserting = [
            s for s in log.segments if s.kind in ("insert", "place", "settle") and s.start <= k / 7.5 <= s.end
        ]
        assert (shot.arrow is not None) == bool(inserting)
        if inserting:
            goal = (
                log.T_world_assembly
                @ np.array([*assembly.goal_centres[assembly.index(inserting[0].piece)], 1.0])
            )[:3]
            tip = np.asarray(shot.arrow.start) + shot.arrow.length * np.asarray(shot.arrow.direction)
            assert (tip - goal) @ shot.arrow.direction == pytest.approx(
                0.0, abs=1e-9
            )  # it ends level with the goal, beside it
            assert np.linalg.norm(tip - goal) < 0.05


@pytest.mark.parametrize("aspect", [16 / 9, 1.0])
def test_framing_is_tight(aspect: float) -> None:
    points = np.random.default_rng(3).uniform(-0.3, 0.3, (40, 3)) + (0.1, 0.2, 0.3)
    camera = framed(points, 25.0, -30.0, 0.1, aspect)
    seen = camera.project(points, aspect)
    assert np.abs(seen[:, 0]).max() < 0.801 and -0.661 < seen[:, 1].min() and seen[:, 1].max() < 0.821
    assert np.abs(seen[:, 0]).max() > 0.79 or np.ptp(seen[:, 1]) > 1.47
    far = framed(points, 25.0, -30.0, 3.0, aspect)
    assert far.distance >= 3.0 and np.abs(far.project(points, aspect)).max() < 0.8
