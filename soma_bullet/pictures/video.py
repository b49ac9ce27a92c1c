"""Frames into a file: H.264 for players, animated WebP for web pages."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path

import numpy as np

from soma_bullet.errors import InputError
from soma_bullet.pictures.camera import Frame

FORMATS = (".mp4", ".webp")
WORST = 51  # of x264's constant rate factors


def check_format(path: Path) -> None:
    """Refuse a file that is of no format that can be written. Raises InputError."""
    if path.suffix.lower() not in FORMATS:
        raise InputError(str(path), f"a video must end in {' or '.join(FORMATS)}")


def write_video(path: Path, frames: Iterable[Frame], fps: float = 25.0, quality: int = 20) -> Path:
    """Writes frames (h, w, 3), of even size: H.264 that every player takes, or a WebP that plays for ever, by
    the file's name.

    The file appears when it is whole. The same frames give the same bytes.

    Args:
        quality: x264's crf, lower is better; of a WebP the same share of its own scale.

    Raises:
        InputError: there is no frame, or the file is of neither format.
    """
    check_format(path)
    remaining = iter(frames)
    first = next(remaining, None)
    if first is None:
        raise InputError(str(path), "no frames to write")
    write = _write_webp if path.suffix.lower() == ".webp" else _write_h264
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, partial = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}.", suffix=path.suffix.lower())
    os.close(handle)
    try:
        write(partial, first, remaining, fps, quality)
        os.chmod(partial, 0o644)
        os.replace(partial, path)
    except BaseException:
        os.unlink(partial)
        raise
    return path


def _write_h264(path: str, first: Frame, others: Iterator[Frame], fps: float, quality: int) -> None:
    import av

    with av.open(path, "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000))
        stream.height, stream.width = first.shape[:2]
        stream.pix_fmt = "yuv420p"
        # the bytes depend on the threads, and x264's B frames on memory that it never wrote
        stream.options = {"crf": str(quality), "preset": "medium", "threads": "2", "bf": "0"}
        for picture in chain((first,), others):
            container.mux(
                stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24"))
            )
        container.mux(stream.encode())


def _write_webp(path: str, first: Frame, others: Iterator[Frame], fps: float, quality: int) -> None:
    from PIL import Image

    pictures = (Image.fromarray(np.ascontiguousarray(frame)) for frame in chain((first,), others))
    share = round(100 * (1 - quality / WORST))
    next(pictures).save(
        path,
        save_all=True,
        append_images=pictures,
        duration=round(1000 / fps),
        loop=0,
        quality=share,
        method=4,
    )
