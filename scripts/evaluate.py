"""Run many seeded episodes and say how often they succeed, with the 95 % interval and the causes of
failure."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from soma_bullet.cli.common import run_command
from soma_bullet.cli.episode import VideoArguments

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from soma_bullet.evaluation.options import EvaluationOptions

WIDTH = 110  # [characters] of what is printed where there is no terminal
INK, QUIET, GOOD, BAD = "#1f2933", "#8a94a3", "#2f7d5b", "#b5473c"  # of the figure
KINDS = ((True, GOOD, "of successes"), (False, BAD, "of failures"))
BINS = 12  # in a decade of the errors


@dataclass(frozen=True)
class SpreadArguments:
    """By how much what varies does."""

    friction: float = 0.2
    """Largest relative deviation of an episode's factor on all friction coefficients."""
    mass: float = 0.2
    """The same of its factor on all masses."""
    mm: float = 0.5
    """One sigma of the error of the perceived places in x and in y [mm]; of uniform errors their largest
    length."""
    deg: float = 0.5
    """One sigma of the error of the perceived yaws [deg]; of uniform errors the largest."""
    errors: Literal["normal", "uniform"] = "normal"
    """How the errors of perception are spread: normal, or uniform over a disc and an interval."""
    square: bool = True
    """Whether inexactly perceived pieces are squared before they are picked; --spread.no-square: they are
    picked as seen."""


@dataclass(frozen=True)
class Arguments:
    """Runs episodes in worker processes; an interrupted run goes on with the same command.

    Writes episodes.jsonl (a line an episode, with all that is needed to run it again), summary.json and
    summary.png. Exit status: 0 the evaluation is complete, whatever its rate; 1 a replay came out otherwise;
    2 bad input; 130 interrupted."""

    assembly: tyro.conf.Positional[str]
    """An assembly file, or the name of one that comes with the package."""
    episodes: int = 20
    """How many."""
    jobs: int = os.cpu_count() or 1
    """Worker processes; the result does not depend on it."""
    seed: int = 0
    """Of the first episode; the others follow on."""
    out: Path = Path("runs/evaluation")
    """Where lines, summary and figure are written."""
    vary: str = "feed"
    """What differs between episodes beside the places of the pieces: any of friction, mass, perception, feed,
    separated by commas, or none. feed: every steady resting pose; without it pieces lie in the one from which
    they are easiest to grasp."""
    spread: SpreadArguments = field(default_factory=SpreadArguments)
    cell: str = "ur5e_pair"
    """A folder or cell.toml, or the name of one under robots/."""
    hand: str | None = None
    """A hand.toml that replaces the hands of the cell, or the name of a cell whose hand it is."""
    stability: Literal["equilibrium", "paper"] = "equilibrium"
    """Which stability measure chooses the order."""
    tolerance_mm: float = 2.0
    """A piece is in place when its centre of mass is this near to its goal [mm] ..."""
    tolerance_deg: float = 2.0
    """... and it is turned by no more than this [deg]."""
    ablate: Literal["none", "hold"] = "none"
    """hold: open the assisting hand where it should hold, all else equal."""
    together: bool = True
    """Whether the arms move at the same time where it is safe."""
    compliant: bool = True
    """Whether the wrist's force guides insertions."""
    recover: bool = True
    """Whether what goes wrong is tried again."""
    backend: Literal["processes", "ray"] = "processes"
    """Who runs the episodes: processes of this machine, or tasks of ray (the cluster that RAY_ADDRESS names,
    else here)."""
    replay: int | None = None
    """Run the episode of this seed of OUT/episodes.jsonl again as it was (the other options do not count),
    film it into OUT/replay_SEED, and say whether it came out the same to the last bit."""
    video: bool = True
    """--no-video: a replay is not filmed."""
    film: VideoArguments = field(default_factory=VideoArguments)


def main(arguments: list[str] | None = None) -> int:
    """Run an evaluation, or one of its episodes again. Returns the exit status."""
    return run_command(_run, tyro.cli(Arguments, args=arguments))


def _run(arguments: Arguments) -> int:
    from rich.console import Console

    _check(arguments)
    out, errors = Console(), Console(stderr=True)
    for console in (out, errors):
        console.width = max(console.width, WIDTH)
    return _evaluate(arguments, out, errors) if arguments.replay is None else _replay(arguments, errors)


def _check(arguments: Arguments) -> None:
    """Refuse what no evaluation could use, all at once."""
    import math

    from soma_bullet.errors import InputError

    faults = []
    for name, count in (("episodes", arguments.episodes), ("jobs", arguments.jobs)):
        if count < 1:
            faults.append(f"--{name} {count}: must be at least 1")
    if not 0 <= arguments.seed <= 2**31 - max(arguments.episodes, 1):
        faults.append(f"--seed {arguments.seed}: must not be negative, and the last seed at most 2147483647")
    words = _words(arguments.vary)
    strange = [word for word in words if word not in ("friction", "mass", "perception", "feed")]
    if strange:
        faults.append(
            f"--vary {arguments.vary}: {', '.join(map(repr, strange))} is none of friction, mass, "
            f"perception, feed"
        )
    for name, share in (("friction", arguments.spread.friction), ("mass", arguments.spread.mass)):
        if not 0 <= share < 1:
            faults.append(f"--spread.{name} {share:g}: must be at least 0 and below 1")
    for name, sigma in (("mm", arguments.spread.mm), ("deg", arguments.spread.deg)):
        if not (math.isfinite(sigma) and sigma >= 0):
            faults.append(f"--spread.{name} {sigma:g}: must not be negative")
    for name, tolerance in (("mm", arguments.tolerance_mm), ("deg", arguments.tolerance_deg)):
        if not (math.isfinite(tolerance) and tolerance > 0):
            faults.append(f"--tolerance-{name} {tolerance:g}: must be positive")
    if faults:
        raise InputError("arguments", faults)


def _words(text: str) -> tuple[str, ...]:
    return tuple(word for word in (word.strip() for word in text.split(",")) if word and word != "none")


def _options(arguments: Arguments) -> EvaluationOptions:
    from soma_bullet.control.executive import ExecutionOptions
    from soma_bullet.evaluation.options import EvaluationOptions, Spread
    from soma_bullet.judge.judge import Tolerance

    spread = arguments.spread
    return EvaluationOptions(
        assembly=arguments.assembly,
        episodes=arguments.episodes,
        seed=arguments.seed,
        vary=_words(arguments.vary),
        spread=Spread(spread.friction, spread.mass, spread.mm, spread.deg, spread.errors, spread.square),
        cell=arguments.cell,
        hand=arguments.hand,
        stability=arguments.stability,
        tolerance=Tolerance(arguments.tolerance_mm, arguments.tolerance_deg),
        execution=ExecutionOptions(
            together=arguments.together, compliant=arguments.compliant, recover=arguments.recover
        ),
        ablate="" if arguments.ablate == "none" else arguments.ablate,
    )  # fmt: skip


def _evaluate(arguments: Arguments, out: Console, errors: Console) -> int:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from soma_bullet.evaluation.evaluate import Watch, evaluate
    from soma_bullet.evaluation.folder import SUMMARY
    from soma_bullet.evaluation.statistics import wilson

    finished: list[dict[str, Any]] = []
    columns = (
        TextColumn("episodes"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"),
        TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(),
    )  # fmt: skip
    bar = Progress(*columns, console=errors)

    def rate() -> str:
        good = sum(line["success"] for line in finished)
        low, high = wilson(good, len(finished)) if finished else (0.0, 1.0)
        return f"{good} succeeded ({low:.0%} to {high:.0%})"

    def found(lines: list[dict[str, Any]]) -> None:
        finished.extend(lines)
        bar.add_task(rate(), total=arguments.episodes, completed=len(lines))
        bar.start()

    def done(line: dict[str, Any]) -> None:
        finished.append(line)
        bar.update(bar.task_ids[0], advance=1, description=rate())
        if not line["success"]:
            bar.console.print(f"seed {line['seed']}: {line['cause']}: {line['causes'][0]}", markup=False)

    try:
        summary, lines = evaluate(
            _options(arguments), arguments.jobs, arguments.out, Watch(found, done), arguments.backend
        )
    except KeyboardInterrupt:
        bar.stop()
        errors.print(
            f"{len(finished)} of {arguments.episodes} episodes are done; the same command goes on",
            markup=False,
        )
        raise
    finally:
        bar.stop()
    picture = arguments.out / "summary.png"
    draw(summary, lines, arguments, picture)
    out.print(table(summary, arguments))
    errors.print(f"written to {arguments.out}/: episodes.jsonl, {SUMMARY}, {picture.name}", markup=False)
    return 0


def table(summary: dict[str, Any], arguments: Arguments) -> Table:
    """The summary as a person reads it."""
    from rich.markup import escape
    from rich.table import Table

    rows = Table(title=_title(summary, arguments), title_justify="left")
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


def _title(summary: dict[str, Any], arguments: Arguments) -> str:
    low, high = summary["interval_95"]
    count = f"{summary['successes']} of {summary['episodes']} succeeded"
    return (
        f"{arguments.assembly}: {count}, {summary['success_rate']:.0%} (95% interval {low:.0%} to {high:.0%})"
    )


def _cells(spread: dict[str, float]) -> list[str]:
    if not spread["count"]:
        return ["-", "-", "-", "-", "0"]
    return [*(f"{spread[key]:.3g}" for key in ("mean", "median", "p95", "max")), str(spread["count"])]


def draw(summary: dict[str, Any], lines: list[dict[str, Any]], arguments: Arguments, path: Path) -> None:
    """One figure: what became of the episodes, the errors of their pieces against the tolerance, how long
    they took."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    style = {
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
    with plt.rc_context(style):
        figure, axes = plt.subplots(
            1, 3, figsize=(12, 3.6), width_ratios=(1.1, 1.2, 1.0), layout="constrained"
        )
        figure.suptitle(_title(summary, arguments), x=0.01, ha="left", fontsize=12, fontweight="bold")
        _draw_outcomes(axes[0], summary)
        _draw_errors(axes[1], lines, arguments.tolerance_mm)
        _draw_makespans(axes[2], lines)
        scratch = path.with_name(f".{path.name}")
        figure.savefig(scratch, format="png")
        plt.close(figure)
        scratch.replace(path)


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
    import numpy as np

    axes.set(
        title="error of a piece at the end", xlabel="displacement of the centre of mass [mm]", ylabel="pieces"
    )
    errors = {
        ok: [p["error_mm"] for line in lines if line["success"] is ok for p in line.get("pieces", ())]
        for ok in (True, False)
    }
    everything = [*errors[True], *errors[False]]
    if not everything:
        return _say_nothing(axes)
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
    import numpy as np

    axes.set(title="makespan", xlabel="simulated time [s]", ylabel="episodes")
    times = {
        ok: [line["makespan_s"] for line in lines if line["success"] is ok and "makespan_s" in line]
        for ok in (True, False)
    }
    everything = [*times[True], *times[False]]
    if not everything:
        return _say_nothing(axes)
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


def _say_nothing(axes: Any) -> None:
    axes.text(0.5, 0.5, "nothing was executed", transform=axes.transAxes, ha="center", color=QUIET)
    axes.set(xticks=[], yticks=[])


def _replay(arguments: Arguments, errors: Console) -> int:
    from soma_bullet.evaluation.replay import replay
    from soma_bullet.pictures.film import FilmOptions

    film = arguments.film
    made = FilmOptions(
        size=film.size, fps=film.fps, speed=film.speed, camera=film.camera, renderer=film.renderer
    )
    assert arguments.replay is not None
    with errors.status(f"replaying seed {arguments.replay}"):
        again = replay(arguments.assembly, arguments.replay, arguments.out, made if arguments.video else None)
    for name, line in (("then", again.before), ("now", again.after)):
        verdict = "success" if line["success"] else f"{line['cause']}: {line['causes'][0]}"
        errors.print(
            f"{name:5}{verdict}; hash of all poses {line.get('log_sha256', 'none')[:16]}",
            markup=False,
            highlight=False,
        )
    errors.print(
        "the same to the last bit"
        if again.same
        else "[red]not the same[/]: other versions, another machine, or changed code"
    )
    for name, version in again.before.get("versions", {}).items():
        now = again.after.get("versions", {}).get(name, version)
        if now != version:
            errors.print(f"version of {name}: {version} then, {now} now", markup=False)
    errors.print(f"written to {again.folder}/", markup=False)
    return 0 if again.same else 1


if __name__ == "__main__":
    raise SystemExit(main())
