"""The film: its words follow the log, its camera never jumps, its frames are where they should be in time."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.errors import InputError
from soma_bullet.frames import make_transform, to_quat_xyzw
from soma_bullet.pictures.camera import CAMERAS
from soma_bullet.pictures.caption import holds, narration, phases, says, vector
from soma_bullet.pictures.crew import Crew, Shot
from soma_bullet.pictures.film import _interpolated, _stage, film, frame_times, still, storyboard
from soma_bullet.pictures.options import FilmOptions
from soma_bullet.pictures.studio import Studio
from soma_bullet.pictures.views import HOLD, framed
from soma_bullet.records import write_npz
from soma_bullet.robot.cell import load_cell
from soma_bullet.robot.model import Cell
from soma_bullet.world.log import ExecutionLog, SegmentRecord

ROOT = Path(__file__).resolve().parents[2]
TINY = FilmOptions((160, 90), fps=10.0, supersampling=1, jobs=1)
DIAGONAL = (0.0, 0.05, -0.05)  # [m]
# kind, step, arm, piece, duration [s], outcome
EPISODE = (
    ("transit", 0, "right", "Z", 1.0, ""),
    ("approach", 0, "right", "Z", 0.5, ""),
    ("grasp", 0, "right", "Z", 0.5, ""),
    ("lift", 0, "right", "Z", 0.5, ""),
    ("transfer", 0, "right", "Z", 1.0, ""),
    ("insert", 0, "right", "Z", 1.0, ""),
    ("place", 0, "right", "Z", 1.0, ""),
    ("settle", 0, "right", "Z", 0.25, ""),
    ("transit", 1, "left", "BigL", 1.5, ""),
    ("grasp", 1, "left", "BigL", 0.5, ""),
    ("transfer", 1, "left", "BigL", 1.0, ""),
    ("insert", 1, "left", "BigL", 1.0, ""),
    ("place", 1, "left", "BigL", 1.25, "stopped early"),
    ("settle", 1, "left", "BigL", 0.25, ""),
    ("release", 1, "right", "Z", 0.5, ""),
    ("retreat", 1, "right", "Z", 0.5, ""),
    ("release", 1, "left", "BigL", 0.5, ""),
    ("retreat", 1, "left", "BigL", 0.5, ""),
    ("home", 1, "right", "Z", 1.25, ""),
    ("final", -1, "", "", 1.5, ""),
)


Row = tuple[str, int, str, str, float, str]


def made_log(cell: Cell, assembly: Assembly, episode: tuple[Row, ...] = EPISODE) -> ExecutionLog:
    """A log of arms at rest and of pieces that glide from the feed to their goals."""
    segments, clock = [], 0.0
    for kind, step, arm, piece, duration, outcome in episode:
        offset = np.array(DIAGONAL if kind in ("insert", "place") else (0.0, 0.0, 0.0))
        start, clock = clock, clock + duration
        segments.append(
            SegmentRecord(kind, step, arm, piece, start, clock, outcome or "as planned", offset, 0.0, 0.0)
        )
    times = np.arange(0.01, clock + 1e-9, 0.02)
    T_world_assembly = make_transform(translation=(0.0, 0.0, 0.1))
    poses = np.zeros((len(times), len(assembly.pieces), 7))
    for k, (piece, goal) in enumerate(zip(assembly.pieces, assembly.goals, strict=True)):
        position, quat_xyzw = to_quat_xyzw(T_world_assembly @ goal)
        grasped = next((s.start for s in segments if (s.kind, s.piece) == ("grasp", piece.name)), 0.0)
        placed = next((s.end for s in segments if (s.kind, s.piece) == ("settle", piece.name)), 1.0)
        s = np.clip((times - grasped) / (placed - grasped), 0, 1)[:, None]
        poses[:, k, :3] = position + (1 - s) * np.array((0.2 - 0.2 * k, -0.25, -0.1))
        poses[:, k, 3:] = quat_xyzw
    joints = {name: q for name, q in zip(cell.joint_names, cell.q_home, strict=True)}
    joints |= {finger: 0.02 for arm in cell.arms for finger in arm.finger_joints}
    tcp = np.array([[-0.3, 0.2, 0.3, 1, 0, 0, 0], [0.3, -0.2, 0.3, 1, 0, 0, 0]])
    arms, empty = len(cell.arms), np.zeros(0)
    return ExecutionLog(
        cell=cell.name, assembly=assembly.name, digest=assembly.digest, seed=7, order=("Z", "BigL", "smallL"),
        stand=(0.03, 0.03), T_world_assembly=T_world_assembly, joint_names=tuple(joints),
        target_names=cell.joint_names,
        arm_names=tuple(arm.name for arm in cell.arms), piece_names=assembly.names, times=times,
        joints=np.tile(list(joints.values()), (len(times), 1)), targets=empty, poses=poses,
        tcps=np.tile(tcp[:arms], (len(times), 1, 1)), wrenches=empty, grips=empty, contacts=empty, bodies=(),
        segments=tuple(segments), events=(), constraints=(), ended="done",
    )  # fmt: skip


@pytest.fixture(scope="module")
def assembly() -> Assembly:
    return load_assembly("soma3")


@pytest.fixture(scope="module")
def cell() -> Cell:
    return load_cell("ur5e_pair")


@pytest.fixture(scope="module")
def log(cell: Cell, assembly: Assembly) -> ExecutionLog:
    return made_log(cell, assembly)


@pytest.fixture(scope="module")
def board(log: ExecutionLog, assembly: Assembly, cell: Cell) -> list[Shot]:
    return storyboard(log, assembly, cell, FilmOptions(), "every piece is in place")


# --- words --------------------------------------------------------------------------------------------------


def test_phases_join_what_a_viewer_sees_as_one(log: ExecutionLog) -> None:
    found = [(p.kind, p.arm, p.piece) for p in phases(log)]
    assert found[:4] == [
        ("pick", "right", "Z"),
        ("bring", "right", "Z"),
        ("insert", "right", "Z"),
        ("pick", "left", "BigL"),
    ]
    assert found[-3:] == [("release", "left", "BigL"), ("home", "right", "Z"), ("final", "", "")]
    np.testing.assert_allclose(phases(log)[2].direction, np.array((0, 1, -1)) / np.sqrt(2))


def test_phases_of_two_arms_may_overlap(log: ExecutionLog) -> None:
    """Segments stand in the log in the order in which they end."""
    mixed = replace(log, segments=tuple(sorted(log.segments, key=lambda s: (s.arm, s.end))))
    assert phases(mixed) == phases(log)


def test_a_piece_that_is_put_down_is_not_held(cell: Cell, assembly: Assembly) -> None:
    down = (
        ("lower", 0, "right", "Z", 0.5, ""),
        ("set_down", 0, "right", "Z", 1.0, ""),
        ("settle", 0, "right", "Z", 0.2, ""),
    )
    log = made_log(cell, assembly, (*EPISODE[:5], *down, *EPISODE[-1:]))
    assert ("put down", "right", "Z") in [(p.kind, p.arm, p.piece) for p in phases(log)]
    assert all(holds(log, float(time)) == () for time in log.times)


def test_a_hold_lasts_from_settling_to_release(log: ExecutionLog) -> None:
    settle, release = (
        next(s for s in log.segments if (s.kind, s.piece) == (kind, "Z")) for kind in ("settle", "release")
    )
    assert holds(log, settle.start - 0.01) == ()
    assert holds(log, settle.start + 0.01) == (("right", "Z"),)
    assert holds(log, release.start - 0.01) == (("left", "BigL"), ("right", "Z"))
    assert holds(log, release.start + 0.01) == (("left", "BigL"),)


def test_words_of_an_episode(log: ExecutionLog) -> None:
    words = [line for _, line, _ in narration(log, 0.0)]
    assert words == [
        "right takes Z", "right brings Z", "right inserts Z along (0, 0.71, −0.71)",
        "left takes BigL", "left brings BigL", "left inserts BigL along (0, 0.71, −0.71)",
        "right lets go of Z", "left lets go of BigL", "right goes home", "settling",
    ]  # fmt: skip


def test_failures_and_ablations_are_said(cell: Cell, assembly: Assembly) -> None:
    episode = (
        *EPISODE[:6],
        ("place", 0, "right", "Z", 1.0, "jammed"),
        ("ablation", 0, "right", "Z", 0.5, ""),
        *EPISODE[8:],
    )
    words = [line for _, line, _ in narration(made_log(cell, assembly, episode), 1.0)]
    assert "right: Z jams" in words and "ablation: right lets go of Z" in words
    lost = made_log(cell, assembly, (*EPISODE[:2], ("grasp", 0, "right", "Z", 0.5, "lost"), *EPISODE[-1:]))
    assert "right: Z is not between the fingers" in [line for _, line, _ in narration(lost, 1.0)]


def test_words_stay_long_enough_to_be_read(log: ExecutionLog) -> None:
    starts = np.array([start for start, _, _ in narration(log, 2.0)])
    assert np.diff(starts).min() >= 1.0 - 1e-9
    true = {line: start for start, line, _ in narration(log, 0.0)}
    late = [start - true[line] for start, line, _ in narration(log, 2.0)]
    assert min(late) >= 0.0 and max(late) <= 2.0


@pytest.mark.parametrize("least", [1.0, 2.4, 3.6, 6.0])
def test_what_is_said_goes_on_when_it_is_said(log: ExecutionLog, least: float) -> None:
    spans = {says(phase): (phase.start, phase.end) for phase in phases(log)}
    lines = narration(log, least)
    assert all(spans[words][0] <= start < spans[words][1] for start, words, _ in lines)
    assert np.diff([start for start, _, _ in lines]).min() >= 0.5 * least - 1e-9


@pytest.mark.parametrize(("lasts", "said"), [(0.2, False), (0.6, True)])
def test_what_is_over_at_once_is_not_said(cell: Cell, assembly: Assembly, lasts: float, said: bool) -> None:
    episode = (*EPISODE[:15], ("follow", 1, "left", "BigL", lasts, ""), *EPISODE[15:])
    words = [line for _, line, _ in narration(made_log(cell, assembly, episode), 1.0)]
    assert ("left lets BigL down" in words) is said and "right lets go of Z" in words


def test_vectors_are_short() -> None:
    assert vector((0.0, -1e-9, -0.70711)) == "(0, 0, −0.71)" and vector((1.0, 0.5, 0.25)) == "(1, 0.5, 0.25)"


def test_captions_of_the_frames(board: list[Shot], log: ExecutionLog) -> None:
    captions = [shot.caption for shot in board]
    assert captions[-1].text == "every piece is in place"
    assert sum(c.text == "every piece is in place" for c in captions) == pytest.approx(HOLD * 30, abs=1)
    assert any("right holds Z" in c.subtitle and c.text.startswith("left inserts BigL") for c in captions)
    assert captions[0].note.split() == ["soma3", "seed", "7", "0.0", "s", "4×"]
    assert captions[0].rgb == load_assembly("soma3").pieces[2].color


# --- time, camera, arrow ------------------------------------------------------------------------------------


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


# --- options ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"size": (1281, 720)}, "even"),
        ({"size": (0, 720)}, "even"),
        ({"fps": 0.0}, "fps"),
        ({"speed": -1.0}, "speed"),
        ({"speed": float("nan")}, "speed"),
        ({"camera": "back"}, "auto, front, three_quarter, close, top, left, right"),
        ({"renderer": "vulkan"}, "auto, egl, tiny"),
        ({"supersampling": 0}, "supersampling"),
        ({"quality": 60}, "0 to 51"),
        ({"jobs": -1}, "jobs"),
    ],
)
def test_wrong_options(change: dict, says: str) -> None:
    with pytest.raises(InputError, match=says):
        FilmOptions(**change).check()


def test_all_faults_at_once() -> None:
    with pytest.raises(InputError) as caught:
        FilmOptions(size=(33, 20), speed=0.0, camera="x").check()  # type: ignore[arg-type]
    assert len(caught.value.faults) == 3


def test_a_log_of_another_assembly_is_refused(log: ExecutionLog, cell: Cell, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is not the assembly of this log"):
        film(log, load_assembly("soma4"), cell, tmp_path / "film.mp4", TINY)


# --- pictures -----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_small_film_has_all_its_frames(
    log: ExecutionLog, assembly: Assembly, cell: Cell, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    import av

    done: list[float] = []
    path = tmp_path / "film.mp4"
    report = film(log, assembly, cell, path, replace(TINY, jobs=2), done.append, "in place")
    expected = len(frame_times(log, TINY))
    with av.open(str(path)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == expected == report.frames and frames[0].shape == (90, 160, 3)
    assert done == sorted(done) and done[-1] == 1.0 and len(done) == expected
    assert report.renderer in ("egl", "tiny") and (report.renderer == "egl" or report.reason)
    assert capfd.readouterr() == ("", "")
    assert [file.name for file in tmp_path.iterdir()] == ["film.mp4"]


@pytest.mark.slow
def test_the_same_film_for_any_number_of_processes(
    log: ExecutionLog, assembly: Assembly, cell: Cell, tmp_path: Path
) -> None:
    """The same frames in the same order; the renderer itself may differ by a shade where a shadow's edge
    falls."""
    import av

    films = []
    for jobs in (1, 2, 3):
        film(log, assembly, cell, tmp_path / f"{jobs}.mp4", replace(TINY, jobs=jobs, fps=6.0))
        with av.open(str(tmp_path / f"{jobs}.mp4")) as container:
            films.append(
                np.array([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)], float)
            )
    for other in films[1:]:
        assert other.shape == films[0].shape
        difference = np.abs(other - films[0]).mean(axis=(1, 2, 3))
        moved = np.abs(np.diff(films[0], axis=0)).mean(axis=(1, 2, 3)).max()
        assert difference.max() < min(1.0, 0.2 * moved), (difference.max(), moved)


@pytest.mark.slow
def test_without_opengl_the_software_renderer_is_announced(
    log: ExecutionLog, assembly: Assembly, cell: Cell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Studio, "_start_renderer", lambda *_: ("tiny", "there is no eglRenderer"))
    report = still(log, assembly, cell, tmp_path / "still.png", replace(TINY, camera="close"))
    assert (report.renderer, report.reason) == ("tiny", "there is no eglRenderer")
    with pytest.raises(InputError, match="there is no eglRenderer"):
        still(log, assembly, cell, tmp_path / "still.png", replace(TINY, camera="close", renderer="egl"))


@pytest.mark.slow
def test_a_process_that_dies_is_replaced_by_the_software_renderer(
    log: ExecutionLog, assembly: Assembly, cell: Cell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from concurrent.futures.process import BrokenProcessPool

    shots = [Shot(log.joints[0], log.poses[0], CAMERAS["front"])] * 6
    crew, whole = Crew(_stage(log, assembly, cell, tmp_path, TINY), 2), Crew._shared

    def dies(self: Crew, asked):
        if self.stage.renderer == "tiny":
            yield from whole(self, asked)
            return
        yield np.zeros((90, 160, 3), np.uint8)
        raise BrokenProcessPool

    monkeypatch.setattr(Crew, "_shared", dies)
    assert len(list(crew.frames(shots))) == 6
    assert crew.renderer == "tiny" and "died" in crew.reason


@pytest.mark.slow
def test_the_script_renders_a_log(log: ExecutionLog, tmp_path: Path) -> None:
    write_npz(log, tmp_path / "log.npz")

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [
            sys.executable,
            str(ROOT / "scripts/render.py"),
            str(tmp_path / "log.npz"),
        ]
        environment = os.environ | {"PYTHONPATH": str(ROOT)}
        return subprocess.run(
            [*command, *arguments], capture_output=True, text=True, env=environment, check=False
        )

    done = run("--size", "160", "90", "--still")
    assert done.returncode == 0, done.stderr
    assert done.stdout == "" and (tmp_path / "still_auto.png").stat().st_size > 1000
    wrong = run("--camera", "x")
    assert wrong.returncode == 2 and "three_quarter" in wrong.stderr and "Traceback" not in wrong.stderr
