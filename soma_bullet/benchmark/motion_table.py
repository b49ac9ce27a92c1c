"""The times of motions as tables."""

from __future__ import annotations

import statistics
from typing import Literal

import numpy as np

from soma_bullet.benchmark.query import AROUND, PARTS, Timed
from soma_bullet.benchmark.stopwatch import met

CHAIN_MEDIAN, CHAIN_P95, FASTER = 0.025, 0.080, 15.0  # [s], [s], times


def _ratio(rows: list[Timed], clock: Literal["cpu", "wall"]) -> float:
    """Of the medians: birrt over ours."""
    medians = [statistics.median(getattr(row, name) for row in rows) for name in (f"birrt_{clock}", clock)]
    return medians[0] / medians[1]


def motion_table(figures: list[Timed]) -> str:
    """Times against targets, by kind of motion and by part, as Markdown."""

    def spread(values: list[float]) -> str:
        if not values:
            return "- | -"
        return f"{np.median(values) * 1e3:.1f} ms | {np.percentile(values, 95) * 1e3:.1f} ms"

    lines = ["| motions | solved | CPU, median | CPU, p95 | wall, median | wall, p95 |", "|-|-|-|-|-|-|"]
    groups = {kind: [row for row in figures if row.kind == kind] for kind in AROUND} | {"all": figures}
    for name, rows in groups.items():
        solved = f"{sum(row.solved for row in rows)} of {len(rows)}"
        lines.append(
            f"| {name} | {solved} | {spread([row.cpu for row in rows])} | "
            f"{spread([row.wall for row in rows])} |"
        )
    total = sum(row.cpu for row in figures)
    lines += ["", "| part of the chain | CPU, median | CPU, p95 | share |", "|-|-|-|-|"]
    for part in PARTS:
        values = [row.parts[part] for row in figures]
        lines.append(f"| {part} | {spread(values)} | {sum(values) / total:.0%} |")
    cpu, wall = [row.cpu for row in figures], [row.wall for row in figures]
    lines += ["", "| job | target | wall | CPU | met |", "|-|-|-|-|-|"]
    for job, target, values in (
        ("chain, median", CHAIN_MEDIAN, [float(np.median(wall)), float(np.median(cpu))]),
        ("chain, p95", CHAIN_P95, [float(np.percentile(wall, 95)), float(np.percentile(cpu, 95))]),
    ):
        shown = " | ".join(f"{value * 1e3:.1f} ms" for value in values)
        lines.append(f"| {job} | < {target * 1e3:.0f} ms | {shown} | {met(values[0], values[1], target)} |")
    compared = [row for row in figures if row.birrt_solved is not None]
    both = [row for row in compared if row.solved and row.birrt_solved]
    if both:
        times = [_ratio(both, "wall"), _ratio(both, "cpu")]
        good = "yes" if min(times) >= FASTER else "no"
        lines.append(
            f"| birrt's median over ours | > {FASTER:.0f} | {times[0]:.1f} | {times[1]:.1f} | {good} |"
        )
    if compared:
        lines += [
            "",
            "| the same queries | ours solved | birrt solved | ours, median | birrt, median | birrt, p95 | "
            "ratio |",
        ]
        lines.append("|-|-|-|-|-|-|-|")
    for name in (*AROUND, "all") if compared else ():
        rows = [row for row in compared if name in (row.kind, "all")]
        done = [row for row in both if name in (row.kind, "all")]
        counts = (
            f"{sum(row.solved for row in rows)} of {len(rows)} | {sum(bool(r.birrt_solved) for r in rows)} "
            f"of {len(rows)}"
        )
        if done:
            ours = f"{np.median([row.cpu for row in done]) * 1e3:.1f} ms"
            theirs = spread([row.birrt_cpu for row in done])
            lines.append(f"| {name} | {counts} | {ours} | {theirs} | {_ratio(done, 'cpu'):.1f} |")
    hits = sum(bool(row.birrt_note) for row in compared)
    if hits:
        lines += [
            "",
            f"birrt was not begun in {hits} cases: its world has the start or the goal in collision.",
        ]
    return "\n".join(lines) + "\n"
