"""The report of an episode: the judgement with all that is needed to run it again, as a file and as a
table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from soma_bullet.verdict.judge import Judgement, PieceVerdict
from soma_bullet.verdict.options import Tolerance
from soma_bullet.world.log import Event


@dataclass(frozen=True)
class EpisodeReport:
    """What an episode reports.

    Attributes:
        success, pieces: the verdict, and where each piece ended up.
        assembly, digest, cell, order, stability, seed: what was run.
        ablation: what was switched off on purpose, or empty.
        tolerance: of the verdict.
        judgement: every number of the judge.
        feed_rejected: draws of the feed that were rejected, by reason.
        rejections: what the schedule's search ruled out, and how often.
        certificates: held piece -> factor by which the load that its hold must resist could grow.
        makespan_s: simulated time until both hands had let go and left.
        planned_s: the same as planned, `together`; `one at a time`: what the arms would take one after the
            other, without ways home that can be spared; `as scheduled`: what they take when nothing moves at
            the same time (no_together).
        events: what the executive noticed and decided on the way.
        notes: what a reader of these numbers must know.
        wall_s: wall time of each stage.
        video: its file and renderer, or why there is none.
        versions: packages that the numbers depend on.
    """

    success: bool
    pieces: tuple[PieceVerdict, ...]
    assembly: str
    digest: str
    cell: str
    order: tuple[str, ...]
    stability: str
    seed: int
    ablation: str
    tolerance: Tolerance
    judgement: Judgement
    feed_rejected: dict[str, int]
    rejections: dict[str, int]
    certificates: dict[str, float]
    makespan_s: float
    planned_s: dict[str, float]
    events: tuple[Event, ...]
    notes: tuple[str, ...]
    wall_s: dict[str, float]
    video: dict[str, str]
    versions: dict[str, str]


def print_report(report: EpisodeReport, console: Console) -> None:
    """The table that a person reads at the end."""
    table = Table(
        title=f"{report.assembly}, seed {report.seed}: {' <- '.join(report.order)}", title_justify="left"
    )
    for heading, justify in (
        ("piece", "left"),
        ("error [mm]", "right"),
        ("worst vertex [mm]", "right"),
        ("error [deg]", "right"),
        ("in place", "left"),
    ):
        table.add_column(escape(heading), justify=justify)  # type: ignore[arg-type]
    for piece in report.pieces:
        mark = "[green]yes[/]" if piece.in_place else "[red]no[/]"
        table.add_row(
            piece.name, f"{piece.error_mm:.2f}", f"{piece.error_max_mm:.2f}", f"{piece.error_deg:.2f}", mark
        )
    console.print(table)
    judgement = report.judgement
    if judgement.slips:
        slip = max(judgement.slips, key=lambda s: s.slip_mm)
        console.print(
            f"largest slip in a grasp   {slip.slip_mm:.2f} mm, {slip.slip_deg:.2f} deg ({slip.piece}, "
            f"{slip.arm} hand)"
        )
    for hold in judgement.holds:
        margin = report.certificates.get(hold.piece)
        console.print(
            f"{hold.arm} held {hold.piece:<12} {hold.seconds:.1f} s, "
            f"drift {hold.drift_mm:.2f} mm, grip at least {hold.grip_n:.0f} N"
            + (f", certified for {margin:.1f} x its load" if margin is not None else "")
        )
    for insertion in judgement.insertions:
        console.print(
            f"placing {insertion.piece:<12} peak {insertion.peak_n:.1f} N at the {insertion.arm} wrist, "
            f"{insertion.outcome}"
        )
    stages = "   ".join(f"{name} {seconds:.1f} s" for name, seconds in report.wall_s.items())
    console.print(f"wall time   {stages}")
    console.print(f"makespan    {report.makespan_s:.1f} s simulated{_saved(report.planned_s)}")
    for event in report.events:
        if event.kind != "looked":
            console.print(f"{event.time:7.1f} s   {event.kind}: {event.piece} {event.text}", markup=False)
    for note in report.notes:
        console.print(f"[yellow]note[/]: {escape(note)}")
    if report.success:
        console.print(
            "[bold green]success[/]: every piece is in place, nothing was dropped, nothing forbidden was "
            "touched"
        )
    else:
        console.print("[bold red]failure[/]: " + "; ".join(report.judgement.causes))


def _saved(planned: dict[str, float]) -> str:
    """What the arms gain by moving at the same time, where that was planned."""
    together, alone, scheduled = (
        planned.get(name, np.nan) for name in ("together", "one at a time", "as scheduled")
    )
    if not np.isfinite(together) or not np.isfinite(alone):
        return ""
    return (
        f"; planned {together:.1f} s, {1.0 - together / scheduled:.0%} less than {scheduled:.1f} s as "
        f"scheduled, "
        f"{1.0 - together / alone:.0%} less than {alone:.1f} s with one arm at a time at its best"
    )
