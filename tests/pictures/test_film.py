"""The film: wrong options are refused, and all its frames are drawn, by any number of processes."""

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
from soma_bullet.pictures.camera import CAMERAS
from soma_bullet.pictures.crew import Crew, Shot
from soma_bullet.pictures.film import _stage, film, frame_times, still
from soma_bullet.pictures.options import FilmOptions
from soma_bullet.pictures.studio import Studio
from soma_bullet.records import write_npz
from soma_bullet.robot.model import Cell
from soma_bullet.world.log import ExecutionLog

ROOT = Path(__file__).resolve().parents[2]
TINY = FilmOptions((160, 90), fps=10.0, supersampling=1, jobs=1)

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
