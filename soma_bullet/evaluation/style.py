"""What the figures of evaluations have in common."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

INK, QUIET, PALE = "#1f2933", "#8a94a3", "#e4e8ed"
GOOD, BAD = "#2f7d5b", "#b5473c"
STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.edgecolor": QUIET,
    "axes.labelcolor": INK,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "axes.titlepad": 9,
    "figure.dpi": 150,
}


@contextmanager
def saved(path: Path, heading: str, size: tuple[float, float], widths: tuple[float, ...]) -> Iterator[Any]:
    """Axes side by side under a heading, to draw into; the file appears when it is whole.

    Args:
        size: of the figure [inches].
        widths: of the axes, relative to each other.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    path.parent.mkdir(parents=True, exist_ok=True)
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(1, len(widths), figsize=size, width_ratios=widths, layout="constrained")
        figure.suptitle(heading, x=0.01, ha="left", fontsize=12, fontweight="bold")
        yield axes
        scratch = path.with_name(f".{path.name}")
        figure.savefig(scratch, format="png")
        plt.close(figure)
        scratch.replace(path)


def say_nothing(axes: Any, why: str) -> None:
    """Says why there is nothing to draw."""
    axes.text(0.5, 0.5, why, transform=axes.transAxes, ha="center", color=QUIET)
    axes.set(xticks=[], yticks=[])
