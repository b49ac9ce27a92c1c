"""Checks of who draws, and of videos."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from soma_bullet.doctor.finding import AGAIN, Finding
from soma_bullet.options import EpisodeOptions

CELL = EpisodeOptions.cell
RENDERER = "apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri"
PATIENCE = 60  # [s] for one picture


def check_pictures() -> Iterator[Finding]:
    """Who draws, and whether a video can be encoded."""
    import av
    import numpy as np

    yield _renderer()
    with tempfile.TemporaryDirectory() as folder:
        file = str(Path(folder) / "test.mp4")
        with av.open(file, "w") as container:
            stream = container.add_stream("libx264", rate=10)
            stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
            for k in range(3):
                picture = av.VideoFrame.from_ndarray(np.full((64, 64, 3), 80 * k, np.uint8), format="rgb24")
                container.mux(stream.encode(picture))
            container.mux(stream.encode())
        with av.open(file) as container:
            count = sum(1 for _ in container.decode(video=0))
    good = count == 3
    tool = shutil.which("ffmpeg")
    says = f"H.264 by av {av.__version__}" + (
        f"; ffmpeg at {tool}" if tool else "; no ffmpeg on the path, and none is needed"
    )
    yield Finding("video", "good" if good else "bad", says, "" if good else f"{AGAIN} av")


def _renderer() -> Finding:
    """In a process of its own: what draws is not of this package, and a faulty driver ends a process without
    a word."""
    code = f"from {__name__} import draw_home; draw_home()"
    try:
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE, check=False
        )
    except subprocess.TimeoutExpired:
        return Finding(
            "renderer", "bad", f"one picture took more than {PATIENCE} s", "film with --no-video; " + RENDERER
        )
    lines = done.stdout.splitlines()
    if done.returncode or not lines:
        last = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
        return Finding(
            "renderer", "bad", f"no picture: {last}", f"run episodes with --no-video, or: {RENDERER}"
        )
    renderer, contrast, reason = lines[-1].split("|", 2)
    if float(contrast) < 1.0:
        return Finding(
            "renderer",
            "bad",
            f"{renderer} draws an empty picture",
            f"use --film.renderer tiny, or: {RENDERER}",
        )
    if renderer == "egl":
        return Finding("renderer", "good", "EGL draws")
    return Finding("renderer", "warning", f"PyBullet's own draws, which is slow: {reason}", RENDERER)


def draw_home() -> None:
    """Prints who drew a picture of the cell at home, its contrast, and why it was not EGL if it was not."""
    from soma_bullet.pictures.camera import CAMERAS
    from soma_bullet.pictures.studio import Studio
    from soma_bullet.robot.cell import load_cell
    from soma_bullet.robot.compose import compose_urdf

    with tempfile.TemporaryDirectory() as folder:
        urdf = compose_urdf(load_cell(CELL), (0.1, 0.1), Path(folder) / "cell.urdf")
        with Studio(urdf, size=(160, 90)) as studio:
            picture = studio.frame({}, {}, CAMERAS["front"])
            sys.stdout.write(f"{studio.renderer}|{picture.std():.1f}|{studio.reason}\n")
