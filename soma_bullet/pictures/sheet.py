"""A drawing sheet in inches, y downwards from the top left corner, that saves to PNG, SVG or PDF, the same
bytes every time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyBboxPatch
from PIL import Image

from soma_bullet.errors import InputError
from soma_bullet.pictures.raster import Color, Pixels

DPI = 200  # [pixels per inch] of a PNG, and of the stills in the other formats
INK: Color = (0.13, 0.14, 0.17)
QUIET: Color = (0.45, 0.47, 0.52)
# no dates, no random ids; text stays text, with its font inside a PDF
SETTINGS: dict[Any, Any] = {
    "font.family": ["DejaVu Sans", "sans-serif"],
    "svg.fonttype": "none",
    "svg.hashsalt": "soma_bullet",
    "pdf.fonttype": 42,
    "image.composite_image": False,
}
METADATA: dict[str, Any] = {
    ".png": {},
    ".svg": {"Date": None},
    ".pdf": {"CreationDate": None},
}


def format_of(path: Path | str) -> str:
    """The ending of a picture's path, lower case.

    Raises:
        InputError: an ending other than .png, .svg and .pdf.
    """
    ending = Path(path).suffix.lower()
    if ending not in METADATA:
        raise InputError(
            str(path), f"cannot draw a {ending or 'file without an ending'}; there are {', '.join(METADATA)}"
        )
    return ending


class Sheet:
    """A white sheet of width x height inches; lengths in inches, line widths and font sizes in points."""

    def __init__(self, width: float, height: float):
        self.width, self.height = round(width * DPI) / DPI, round(height * DPI) / DPI
        with rc_context(SETTINGS):
            self._figure = Figure(figsize=(self.width, self.height), dpi=DPI, facecolor="white")
            FigureCanvasAgg(self._figure)
            self._axes = self._figure.add_axes((0.0, 0.0, 1.0, 1.0))
        self._axes.set_axis_off()
        self._axes.set_xlim(0, self.width)
        self._axes.set_ylim(self.height, 0)
        self._axes.set_autoscale_on(False)

    def image(self, pixels: Pixels, x: float, y: float, name: str = "") -> None:
        """Pixels (h, w, 4) at their natural size, on whole pixels, so that nothing is resampled."""
        left, top = round(x * DPI) / DPI, round(y * DPI) / DPI
        right, bottom = left + pixels.shape[1] / DPI, top + pixels.shape[0] / DPI
        drawn = self._axes.imshow(
            pixels,
            extent=(left, right, bottom, top),
            aspect="auto",
            interpolation="none",
            origin="upper",
            zorder=2,
        )
        drawn.set_gid(name or None)

    def text(
        self,
        x: float,
        y: float,
        text: str,
        size: float = 8.0,
        color: Color = INK,
        bold: bool = False,
        align: str = "left",
    ) -> None:
        """One line of text; x is its left, center or right, y its middle."""
        with rc_context(SETTINGS):
            self._axes.text(
                x, y, text, size=size, color=color, weight="bold" if bold else "normal",
                ha=align, va="center_baseline", zorder=5,
            )  # fmt: skip

    def box(
        self,
        x: float,
        y: float,
        width: float,
        height: float,
        edge: Color | None = None,
        fill: Color | None = None,
        line: float = 1.0,
        radius: float = 0.04,
        name: str = "",
        above: bool = False,
    ) -> None:
        """A rectangle with rounded corners; a filled one lies behind the images, unless it is to be above."""
        patch = FancyBboxPatch(
            (x + radius, y + radius), width - 2 * radius, height - 2 * radius,
            boxstyle=f"round,pad={radius}", linewidth=line if edge else 0.0,
            edgecolor=edge or "none", facecolor=fill or "none", zorder=1 if fill and not above else 4,
        )  # fmt: skip
        patch.set_gid(name or None)
        self._axes.add_patch(patch)

    def line(self, points: list[tuple[float, float]], color: Color = QUIET, width: float = 0.6) -> None:
        """A line through points."""
        xs, ys = zip(*points, strict=True)
        self._axes.add_line(Line2D(xs, ys, color=color, linewidth=width, zorder=3))

    def dot(self, x: float, y: float, color: Color, size: float = 3.0) -> None:
        """A round dot, `size` points across."""
        self._axes.add_line(
            Line2D([x], [y], color=color, marker="o", markersize=size, markeredgewidth=0, zorder=3)
        )

    def pixels(self) -> Pixels:
        """The sheet as a picture (h, w, 4)."""
        canvas = self._figure.canvas
        assert isinstance(canvas, FigureCanvasAgg)
        with rc_context(SETTINGS):
            canvas.draw()
        return np.array(canvas.buffer_rgba())

    def save(self, path: Path | str, colors: int | None = None) -> Path:
        """Write the sheet in the format that the ending says.

        Args:
            colors: a PNG gets a palette of so many, at a third of the size; good for a sheet of few hues.

        Raises:
            InputError: an ending other than .png, .svg and .pdf.
        """
        path, ending = Path(path), format_of(path)
        if ending == ".png":
            picture = Image.fromarray(self.pixels()).convert("RGB")
            (picture.quantize(colors, dither=Image.Dither.NONE) if colors else picture).save(
                path, optimize=True
            )
            return path
        with rc_context(SETTINGS):
            self._figure.savefig(path, format=ending[1:], dpi=DPI, metadata=METADATA[ending])
        return path
