"""The summary of an evaluation as a table."""

from __future__ import annotations

from typing import Any

from rich.markup import escape
from rich.table import Table


def table(summary: dict[str, Any], assembly: str) -> Table:
    """The summary of an evaluation as a person reads it."""
    rows = Table(title=title(summary, assembly), title_justify="left")
    for heading in ("", "mean", "median", "p95", "largest", "of"):
        rows.add_column(heading, justify="left" if not heading else "right")
    names = {
        "error_mm": "error of a piece [mm]",
        "error_deg": "error of a piece [deg]",
        "slip_mm": "slip in a grasp [mm]",
        "slip_deg": "slip in a grasp [deg]",
        "drift_mm": "drift while held [mm]",
        "peak_n": "peak force of a placing [N]",
        "makespan_s": "makespan [s, simulated]",
        "saved_percent": "saved of one arm at a time at its best [%]",
        "saved_of_scheduled_percent": "saved of one arm at a time as scheduled [%]",
    }
    for key, name in names.items():
        rows.add_row(escape(name), *_cells(summary["executed"][key]))
    for stage, spread in summary["wall_s"].items():
        rows.add_row(escape(f"wall time, {stage} [s]"), *_cells(spread))
    rows.add_section()
    for cause, count in summary["causes"].items():
        seeds = summary["failed_seeds"][cause]
        listed = ", ".join(map(str, seeds[:8])) + (", ..." if len(seeds) > 8 else "")
        rows.add_row(f"[red]{cause}[/]", f"seeds {listed}", "", "", "", str(count))
    rows.add_row("planned anew", "", "", "", "", str(summary["recoveries"]))
    rows.add_row("insertions tried again", "", "", "", "", str(summary["retries"]))
    rows.add_row(
        "forbidden contacts in successes", "", "", "", "", str(summary["forbidden_contacts_in_successes"])
    )
    return rows


def title(summary: dict[str, Any], assembly: str) -> str:
    """The rate and its interval, in one line."""
    low, high = summary["interval_95"]
    count = f"{summary['successes']} of {summary['episodes']} succeeded"
    return f"{assembly}: {count}, {summary['success_rate']:.0%} (95% interval {low:.0%} to {high:.0%})"


def _cells(spread: dict[str, float]) -> list[str]:
    if not spread["count"]:
        return ["-", "-", "-", "-", "0"]
    return [*(f"{spread[key]:.3g}" for key in ("mean", "median", "p95", "max")), str(spread["count"])]
