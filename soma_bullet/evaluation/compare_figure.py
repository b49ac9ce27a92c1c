"""The figure of the comparison of two evaluations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from soma_bullet.evaluation.compare import Comparison, Insertions
from soma_bullet.evaluation.compare_table import title
from soma_bullet.evaluation.style import BAD, GOOD, INK, PALE, QUIET, saved, say_nothing

COLOR_A, COLOR_B = "#c8743c", "#2f6f9f"
KINDS = ("both", "only A", "only B", "neither")
COLORS = dict(zip(KINDS, (GOOD, COLOR_A, COLOR_B, BAD), strict=True))
SMALLEST_MM = 0.01  # on axes of the figure; what is smaller is drawn there


def draw(comparison: Comparison, path: Path) -> None:
    """One figure: the rates with their intervals, the worst pieces pair by pair, forces and neighbours of the
    insertions."""
    with saved(path, _heading(comparison), (15, 4.2), (1.25, 1.1, 1.0, 1.0)) as axes:
        _draw_rates(axes[0], comparison)
        _draw_worst(axes[1], comparison)
        force, motion = "change of the wrist's force [N]", "of any vertex [mm]"
        found = comparison.insertions
        _draw_share(axes[2], found, "peak_n", "peak force of an insertion", force)
        _draw_share(axes[3], found, "neighbours_mm", "motion of what is in place", motion)


def _heading(comparison: Comparison) -> str:
    told = "; ".join(f"{d.name.lstrip('-')}: A {d.a}, B {d.b}" for d in comparison.differences[:3])
    return f"{title(comparison)}. {told or 'same options'}"


def _draw_rates(axes: Any, comparison: Comparison) -> None:
    """A dot and its interval for each run, over a bar of how the pairs fall out."""
    levels = [("episodes", comparison.pairs, comparison.rate_a, comparison.rate_b)]
    found = comparison.insertions
    if found is not None and found.pairs.count:
        levels.append(("insertions", found.pairs, found.rate_a, found.rate_b))
    axes.set(title="what goes well", xlim=(-0.02, 1.02), ylim=(len(levels) - 0.25, -0.55))
    for y, (name, pairs, *rates) in enumerate(levels):
        left = 0.0
        counts = (pairs.both, pairs.only_a, pairs.only_b, pairs.neither)
        for kind, count in zip(KINDS, counts, strict=True):
            share = count / pairs.count
            axes.barh(
                y + 0.3,
                share,
                left=left,
                height=0.22,
                color=COLORS[kind],
                label=kind if not y else None,
                alpha=0.85,
            )
            if share > 0.05:
                axes.text(
                    left + share / 2, y + 0.3, str(count), ha="center", va="center", color="white", fontsize=8
                )
            left += share
        for run, rate, color, at in (("A", rates[0], COLOR_A, y - 0.12), ("B", rates[1], COLOR_B, y + 0.06)):
            share = rate.good / rate.count
            axes.plot((rate.low, rate.high), (at, at), color=color, linewidth=2.2, solid_capstyle="round")
            axes.plot(share, at, "o", color=color, markersize=7, markeredgecolor="white")
            inside = rate.low > 0.25
            axes.text(
                rate.low - 0.02 if inside else rate.high + 0.02, at, f"{run}  {share:.0%}",
                va="center", ha="right" if inside else "left", color=color, fontweight="bold",
            )  # fmt: skip
        p = f"p = {pairs.p:.3f}" if pairs.p >= 0.001 else f"p = {pairs.p:.0e}"
        axes.text(0.0, y - 0.32, f"{pairs.count} {name}, McNemar {p}", va="center", color=INK, fontsize=8.5)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:.0%}")
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    axes.legend(
        frameon=False, fontsize=8, ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.09), handlelength=1.0
    )


def _draw_worst(axes: Any, comparison: Comparison) -> None:
    axes.set(title="error of the worst piece [mm]", xlabel="A", ylabel="B")
    kinds: dict[str, list[tuple[float, float]]] = {kind: [] for kind in KINDS}
    for e in comparison.episodes:
        if np.isfinite([e.worst_a, e.worst_b]).all():
            kind = (
                KINDS[3 - 2 * e.success_b - e.success_a]
                if e.success_a is e.success_b
                else KINDS[1 if e.success_a else 2]
            )
            kinds[kind].append((max(e.worst_a, SMALLEST_MM), max(e.worst_b, SMALLEST_MM)))
    everything = [value for pairs in kinds.values() for pair in pairs for value in pair]
    if not everything:
        return say_nothing(axes, "nothing to compare")
    ends = min(everything) / 1.6, max(everything) * 1.6
    axes.fill_between(ends, ends, (ends[0], ends[0]), color=PALE, alpha=0.6, linewidth=0)
    axes.plot(ends, ends, color=QUIET, linewidth=1)
    for kind, pairs in kinds.items():
        if pairs:
            x, y = zip(*pairs, strict=True)
            axes.scatter(
                x, y, s=24, color=COLORS[kind], alpha=0.8, linewidths=0.5, edgecolors="white", zorder=3
            )
    axes.set(xscale="log", yscale="log", xlim=ends, ylim=ends)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.text(0.97, 0.05, "B is nearer", transform=axes.transAxes, ha="right", color=QUIET, fontsize=8)


def _draw_share(axes: Any, found: Insertions | None, key: str, title: str, label: str) -> None:
    """What share of the insertions stays below a value."""
    axes.set(title=title, xlabel=label, ylim=(0.0, 1.02))
    if found is None or not found.compared:
        return say_nothing(axes, "nothing to compare")
    largest = 0.0
    for run, color in (("a", COLOR_A), ("b", COLOR_B)):
        values = np.sort([getattr(getattr(pair, run), key) for pair in found.compared])
        largest = max(largest, float(values[-1]))
        share = np.arange(1, len(values) + 1) / len(values)
        axes.step([0.0, *values], [0.0, *share], where="post", color=color, linewidth=2, label=run.upper())
        axes.plot(values[-1], 1.0, "o", color=color, markersize=5, clip_on=False)
        axes.annotate(
            f"{values[-1]:.3g}",
            (values[-1], 1.0),
            (0, 6),
            textcoords="offset points",
            ha="center",
            color=color,
            fontsize=8,
        )
    axes.set_xlim(0.0, max(largest * 1.08, 1e-3))
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:.0%}")
    axes.legend(frameon=False, loc="lower right", title=f"{len(found.compared)} paired", title_fontsize=8)
