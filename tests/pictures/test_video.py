"""Videos: all their frames, at their rate, in either format, or no file at all."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from soma_bullet.errors import InputError
from soma_bullet.pictures.camera import Frame
from soma_bullet.pictures.video import write_video

COUNT = 12


def shades() -> Iterator[Frame]:
    """Grey, ever lighter."""
    return (np.full((90, 160, 3), 10 * i, np.uint8) for i in range(COUNT))


def test_a_video_has_all_frames(tmp_path: Path) -> None:
    import av

    path = write_video(tmp_path / "new" / "film.mp4", shades(), fps=12.5)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt) == ("h264", "yuv420p")
        assert float(stream.average_rate) == 12.5
        seen = [frame.to_ndarray(format="rgb24").mean() for frame in container.decode(video=0)]
    np.testing.assert_allclose(seen, np.arange(COUNT) * 10, atol=4)
    assert list(tmp_path.iterdir()) == [path.parent] and list(path.parent.iterdir()) == [path]


def test_so_has_a_picture_that_moves(tmp_path: Path) -> None:
    path = write_video(tmp_path / "film.webp", shades(), fps=12.5)
    with Image.open(path) as image:
        assert image.size == (160, 90) and image.n_frames == COUNT and image.info["loop"] == 0
        seen = []
        for k in range(COUNT):
            image.seek(k)
            image.load()
            assert image.info["duration"] == 80  # [ms]
            seen.append(np.asarray(image.convert("RGB")).mean())
    np.testing.assert_allclose(seen, np.arange(COUNT) * 10, atol=4)
    assert path.read_bytes() == write_video(tmp_path / "again.webp", shades(), fps=12.5).read_bytes()


def test_better_quality_is_larger(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (5, 90, 160, 3), np.uint8)
    for end in (".mp4", ".webp"):
        fine, coarse = (
            write_video(tmp_path / f"{q}{end}", iter(noise), quality=q).stat().st_size for q in (5, 45)
        )
        assert coarse < 0.7 * fine


@pytest.mark.parametrize("name", ("none.mp4", "none.webp"))
def test_nothing_is_left_where_there_are_no_frames(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="no frames"):
        write_video(tmp_path / name, iter(()))
    assert not list(tmp_path.iterdir())


def test_other_formats_are_refused_before_anything_is_drawn(tmp_path: Path) -> None:
    frames = shades()
    with pytest.raises(InputError, match=r"film\.avi: a video must end in \.mp4 or \.webp"):
        write_video(tmp_path / "film.avi", frames)
    assert next(frames).max() == 0 and not list(tmp_path.iterdir())
