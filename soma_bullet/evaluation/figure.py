"""The figure of an evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from soma_bullet.evaluation.style import BAD, GOOD, INK, saved, say_nothing
from soma_bullet.evaluation.table import title

KINDS = ((True, GOOD, "of successes"), (False, BAD, "of failures"))
BINS = 12  # in a decade of the errors


def draw(
    summary: dict[str, Any], lines: list[dict[str, Any]], assembly: str, tolerance: float, path: Path
) -> None:
    """One figure: what became of the episodes, the errors of their pieces against the tolerance [mm], how
    long they took."""
    with saved(path, title(summary, assembly), (12, 3.6), (1.1, 1.2, 1.0)) as axes:
        _draw_outcomes(axes[0], summary)
        _draw_errors(axes[1], lines, tolerance)
        _draw_makespans(axes[2], lines)


def _draw_outcomes(axes: Any, summary: dict[str, Any]) -> None:
    rows = [
        ("success", summary["successes"], GOOD),
        *((cause, count, BAD) for cause, count in summary["causes"].items()),
    ]
    names, counts, colors = zip(*rows, strict=True)
    bars = axes.barh(range(len(rows)), counts, color=colors, height=0.62)
    axes.bar_label(bars, padding=4)
    axes.set(
        title="what became of the episodes",
        xlim=(0, max(counts) * 1.15),
        ylim=(max(len(rows), 4) - 0.5, -0.6),
    )
    axes.set_yticks(range(len(rows)), names)
    axes.tick_params(left=False, bottom=False, labelbottom=False)
    axes.spines[["bottom"]].set_visible(False)


def _draw_errors(axes: Any, lines: list[dict[str, Any]], tolerance: float) -> None:
    axes.set(
        title="error of a piece at the end", xlabel="displacement of the centre of mass [mm]", ylabel="pieces"
    )
    errors = {
        ok: [p["error_mm"] for line in lines if line["success"] is ok for p in line.get("pieces", ())]
        for ok in (True, False)
    }
    everything = [*errors[True], *errors[False]]
    if not everything:
        return say_nothing(axes, "nothing was executed")
    # edges at even steps of the logarithm, one of them at the tolerance
    low, high = np.log10(np.clip([min(everything), max(*everything, tolerance)], 1e-3, 1e4) / tolerance)
    bins = tolerance * 10 ** (np.arange(np.floor(BINS * low) - 1, np.ceil(BINS * high) + 2) / BINS)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    kinds = [(good, color, label) for good, color, label in KINDS if errors[good]]
    clipped = [np.clip(errors[good], bins[0], bins[-1]) for good, _, _ in kinds]
    axes.hist(
        clipped,
        bins,
        stacked=True,
        color=[color for _, color, _ in kinds],
        label=[label for _, _, label in kinds],
    )
    axes.axvline(
        tolerance, color=INK, linewidth=1.2, linestyle=(0, (4, 2)), label=f"tolerance, {tolerance:g} mm"
    )
    axes.yaxis.get_major_locator().set_params(integer=True)
    axes.margins(y=0.25)
    axes.legend(frameon=False, fontsize=8, loc="upper left", borderaxespad=0.0)


def _draw_makespans(axes: Any, lines: list[dict[str, Any]]) -> None:
    axes.set(title="makespan", xlabel="simulated time [s]", ylabel="episodes")
    times = {
        ok: [line["makespan_s"] for line in lines if line["success"] is ok and "makespan_s" in line]
        for ok in (True, False)
    }
    everything = [*times[True], *times[False]]
    if not everything:
        return say_nothing(axes, "nothing was executed")
    low, high = min(everything), max(everything)
    bins = np.linspace(low - 0.5, high + 0.5, 3 + min(20, len(everything)))
    axes.hist([times[True], times[False]], bins, stacked=True, color=(GOOD, BAD))
    middle = float(np.median(everything))
    axes.axvline(middle, color=INK, linewidth=1.2, linestyle=(0, (1, 1.5)))
    axes.text(
        middle, 1.0, f" median {middle:.1f} s", transform=axes.get_xaxis_transform(), va="top", fontsize=8
    )
    axes.yaxis.get_major_locator().set_params(integer=True)
    axes.margins(y=0.2)
