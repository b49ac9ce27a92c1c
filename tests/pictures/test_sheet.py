"""The sheet: the same bytes in every format, text as text, pictures untouched."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from soma_bullet.errors import InputError
from soma_bullet.pictures.sheet import DPI, Sheet


def drawn() -> Sheet:
    sheet = Sheet(1.5, 1.0)
    pixels = np.zeros((40, 60, 4), np.uint8)
    pixels[..., 0], pixels[..., 3] = np.arange(60) * 4, 255
    sheet.image(pixels, 0.2, 0.3, "picture")
    sheet.box(0.6, 0.1, 0.5, 0.3, edge=(1.0, 0.0, 0.0), fill=(1.0, 1.0, 0.0), name="frame")
    sheet.text(0.7, 0.6, "∞ × 2", bold=True)
    sheet.line([(0.1, 0.9), (1.4, 0.9)])
    sheet.dot(0.1, 0.9, (0.0, 0.0, 0.0))
    return sheet


@pytest.mark.parametrize(("ending", "start"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_every_format_comes_out_the_same_twice(ending: str, start: bytes, tmp_path: Path) -> None:
    first, second = (drawn().save(tmp_path / f"{k}.{ending}").read_bytes() for k in "ab")
    assert first.startswith(start)
    assert first == second
    assert b"dc:date" not in first and b"CreationDate" not in first


def test_text_stays_text_and_frames_have_names(tmp_path: Path) -> None:
    content = drawn().save(tmp_path / "sheet.svg").read_text(encoding="utf-8")
    assert ">∞ × 2</text>" in content
    assert 'id="frame"' in content
    assert 'id="picture"' in content


def test_fonts_lie_inside_a_pdf(tmp_path: Path) -> None:
    content = drawn().save(tmp_path / "sheet.pdf").read_bytes()
    assert b"DejaVuSans" in content
    assert b"/FontFile2" in content


def test_a_picture_is_not_resampled(tmp_path: Path) -> None:
    with Image.open(drawn().save(tmp_path / "sheet.png")) as picture:
        assert picture.size == (1.5 * DPI, 1.0 * DPI)
        content = np.array(picture.convert("RGB"))
    assert (content[0, 0] == 255).all()
    assert np.array_equal(content[60:100, 40:100, 0], np.tile(np.arange(60) * 4, (40, 1)))


def test_a_palette_keeps_white_white(tmp_path: Path) -> None:
    with Image.open(drawn().save(tmp_path / "sheet.png", colors=16)) as picture:
        assert picture.mode == "P"
        assert picture.convert("RGB").getpixel((0, 0)) == (255, 255, 255)


@pytest.mark.parametrize("name", ["sheet.gif", "sheet"])
def test_other_formats_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.png, \.svg, \.pdf"):
        drawn().save(tmp_path / name)
