"""Compare two evaluation runs seed by seed: which succeeds where, whether that may be chance, and how
insertions went."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from soma_bullet.cli.common import run_command

if TYPE_CHECKING:
    from rich.table import Table

    from soma_bullet.evaluation.compare import Comparison, Insertions
    from soma_bullet.evaluation.statistics import Contrast, Extremes, Pairs, Rate

WIDTH = 110  # [characters] of what is printed where there is no terminal
INK, QUIET, PALE = "#1f2933", "#8a94a3", "#e4e8ed"  # of the figure
COLOR_A, COLOR_B, BOTH, NEITHER = "#c8743c", "#2f6f9f", "#2f7d5b", "#b5473c"
KINDS = ("both", "only A", "only B", "neither")
COLORS = dict(zip(KINDS, (BOTH, COLOR_A, COLOR_B, NEITHER), strict=True))
SMALLEST_MM = 0.01  # on axes of the figure; what is smaller is drawn there


@dataclass(frozen=True)
class Arguments:
    """Pairs the episodes of two runs of scripts/evaluate.py by seed, and their insertions by seed and piece.

    Prints a table, and writes comparison.json and comparison.png. Exit status: 0 compared, whoever is better;
    2 bad input."""

    a: tyro.conf.Positional[Path]
    """The folder of one run (or its episodes.jsonl): the one to improve on."""
    b: tyro.conf.Positional[Path]
    """The folder of the other."""
    out: Path = Path("runs/comparison")
    """Where the comparison and its figure are written."""
    any_assembly: bool = False
    """Compare also where the assemblies differ, as long as their pieces have the same names."""


def main(arguments: list[str] | None = None) -> int:
    """Compare two runs. Returns the exit status."""
    return run_command(_run, tyro.cli(Arguments, args=arguments))


def _run(arguments: Arguments) -> int:
    from rich.console import Console

    from soma_bullet.errors import InputError
    from soma_bullet.evaluation.compare import COMPARISON, compare
    from soma_bullet.records import write_json

    out, errors = Console(), Console(stderr=True)
    for console in (out, errors):
        console.width = max(console.width, WIDTH)
    comparison = compare(arguments.a, arguments.b, arguments.any_assembly)
    picture = arguments.out / "comparison.png"
    try:
        write_json(comparison, arguments.out / COMPARISON)
        with errors.status("drawing"):
            draw(comparison, picture)
    except OSError as error:
        raise InputError("--out", f"{arguments.out} cannot be written: {error.strerror}") from None
    out.print(table(comparison))
    errors.print(f"written to {arguments.out}/: {COMPARISON}, {picture.name}", markup=False)
    return 0


# --- the table ----------------------------------------------------------------------------------------------


def table(comparison: Comparison) -> Table:
    """The comparison as a person reads it."""
    from rich.markup import escape
    from rich.table import Table

    rows = Table(title=escape(_title(comparison)), title_justify="left")
    for heading in ("", "A", "B", ""):
        rows.add_column(heading, justify="right" if heading else "left", overflow="fold")
    rows.add_row("folder", escape(comparison.a), escape(comparison.b), "")
    for difference in comparison.differences:
        rows.add_row(escape(difference.name), escape(difference.a), escape(difference.b), "[dim]differs[/]")
    if not comparison.differences:
        rows.add_row("options and versions", "", "", "[dim]the same[/]")
    rows.add_section()
    _add_pairs(rows, "episodes that succeed", comparison.pairs, comparison.rate_a, comparison.rate_b)
    _add_contrast(rows, "makespan where both succeed [s]", comparison.makespan_s)
    _add_contrast(rows, "error of the worst piece [mm]", comparison.worst_mm)
    if comparison.unpaired_a or comparison.unpaired_b:
        rows.add_row(
            "seeds without a partner", str(comparison.unpaired_a), str(comparison.unpaired_b), "left out"
        )
    rows.add_section()
    if comparison.insertions is None:
        rows.add_row("insertions", "-", "-", "the lines do not say how they went")
    else:
        _add_insertions(rows, comparison.insertions)
    return rows


def _title(comparison: Comparison) -> str:
    return f"{comparison.assembly}: {comparison.pairs.count} pairs of episodes"


def _add_pairs(rows: Table, what: str, pairs: Pairs, a: Rate, b: Rate) -> None:
    rows.add_row(what, _share(a), _share(b), f"McNemar p = {pairs.p:.2g}, of {pairs.count} pairs")
    counts = (
        f"both {pairs.both}, [b]only A {pairs.only_a}[/], [b]only B {pairs.only_b}[/], neither "
        f"{pairs.neither}"
    )
    rows.add_row("", "", "", counts)


def _add_contrast(rows: Table, what: str, found: Contrast) -> None:
    from rich.markup import escape

    if not found.count:
        rows.add_row(escape(what), "-", "-", "no pairs")
        return
    interval = f" (95%: {found.low:+.3g} to {found.high:+.3g})" if found.low > -float("inf") else ""
    change = f"median difference {found.difference:+.3g}{interval}, of {found.count}"
    rows.add_row(escape(what), f"{found.median_a:.3g}", f"{found.median_b:.3g}", change)


def _add_insertions(rows: Table, found: Insertions) -> None:
    _add_pairs(rows, "insertions that go in", found.pairs, found.rate_a, found.rate_b)
    rows.add_row(
        "those that fail in A go in in B",
        "",
        _share(found.rescued),
        f"{found.rescued.good} of {found.rescued.count}",
    )
    rows.add_row(
        "those that fail in B go in in A",
        _share(found.spoilt),
        "",
        f"{found.spoilt.good} of {found.spoilt.count}",
    )
    numbers = (
        ("peak force [N], p95 and largest", found.peak_a, found.peak_b, "paired"),
        ("", found.all_peak_a, found.all_peak_b, "all"),
        ("motion of neighbours [mm], p95 and largest", found.neighbours_a, found.neighbours_b, "paired"),
        ("", found.all_neighbours_a, found.all_neighbours_b, "all"),
    )
    for what, a, b, which in numbers:
        rows.add_row(
            what.replace("[", r"\["), _largest(a), _largest(b), f"{which}: {a.count} and {b.count} insertions"
        )
    rows.add_row("reached in one run alone", "", "", f"{found.unpaired}, left out")
    rows.add_row("after one that failed in either", "", "", f"{found.later}, left out")


def _share(rate: Rate) -> str:
    return f"{rate.good / rate.count:.0%} ({rate.low:.0%} to {rate.high:.0%})" if rate.count else "-"


def _largest(found: Extremes) -> str:
    return f"{found.p95:.3g}, {found.largest:.3g}" if found.count else "-"


# --- the figure ---------------------------------------------------------------------------------------------


def draw(comparison: Comparison, path: Path) -> None:
    """One figure: the rates with their intervals, the worst pieces pair by pair, forces and neighbours of the
    insertions."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    style: dict[Any, Any] = {
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
    path.parent.mkdir(parents=True, exist_ok=True)
    with plt.rc_context(style):
        figure, axes = plt.subplots(
            1, 4, figsize=(15, 4.2), width_ratios=(1.25, 1.1, 1.0, 1.0), layout="constrained"
        )
        figure.suptitle(_heading(comparison), x=0.01, ha="left", fontsize=12, fontweight="bold")
        _draw_rates(axes[0], comparison)
        _draw_worst(axes[1], comparison)
        _draw_share(
            axes[2],
            comparison.insertions,
            "peak_n",
            "peak force of an insertion",
            "change of the wrist's force [N]",
        )
        _draw_share(
            axes[3],
            comparison.insertions,
            "neighbours_mm",
            "motion of what is in place",
            "of any vertex [mm]",
        )
        scratch = path.with_name(f".{path.name}")
        figure.savefig(scratch, format="png")
        plt.close(figure)
        scratch.replace(path)


def _heading(comparison: Comparison) -> str:
    told = "; ".join(f"{d.name.lstrip('-')}: A {d.a}, B {d.b}" for d in comparison.differences[:3])
    return f"{_title(comparison)}. {told or 'same options'}"


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
    import numpy as np

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
        return _say_nothing(axes)
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
    import numpy as np

    axes.set(title=title, xlabel=label, ylim=(0.0, 1.02))
    if found is None or not found.compared:
        return _say_nothing(axes)
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


def _say_nothing(axes: Any) -> None:
    axes.text(0.5, 0.5, "nothing to compare", transform=axes.transAxes, ha="center", color=QUIET)
    axes.set(xticks=[], yticks=[])


if __name__ == "__main__":
    raise SystemExit(main())
