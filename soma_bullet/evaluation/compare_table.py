"""The comparison of two evaluations as a table."""

from __future__ import annotations

from rich.markup import escape
from rich.table import Table

from soma_bullet.evaluation.compare import Comparison, Insertions
from soma_bullet.evaluation.statistics import Contrast, Extremes, Pairs, Rate


def table(comparison: Comparison) -> Table:
    """The comparison as a person reads it."""
    rows = Table(title=escape(title(comparison)), title_justify="left")
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


def title(comparison: Comparison) -> str:
    """What was compared, in one line."""
    return f"{comparison.assembly}: {comparison.pairs.count} pairs of episodes"


def _add_pairs(rows: Table, what: str, pairs: Pairs, a: Rate, b: Rate) -> None:
    rows.add_row(what, _share(a), _share(b), f"McNemar p = {pairs.p:.2g}, of {pairs.count} pairs")
    counts = (
        f"both {pairs.both}, [b]only A {pairs.only_a}[/], [b]only B {pairs.only_b}[/], neither "
        f"{pairs.neither}"
    )
    rows.add_row("", "", "", counts)


def _add_contrast(rows: Table, what: str, found: Contrast) -> None:
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
