"""The command line of an evaluation: `soma-evaluate`, scripts/evaluate.py."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from soma_bullet.cli.common import WIDTH, run_command
from soma_bullet.cli.flags import parse
from soma_bullet.evaluation.options import EvaluationOptions
from soma_bullet.option import SEED, Options, Range, changed
from soma_bullet.options import EpisodeOptions
from soma_bullet.pictures.options import FilmOptions

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class EvaluateArguments(Options):
    """Runs many seeded episodes, and says how often they succeed, with the 95 % interval and the causes of
    failure. An interrupted run goes on with the same command.

    Writes episodes.jsonl (a line an episode, with all that is needed to run it again), summary.json and
    summary.png. Exit status: 0 the evaluation is complete, whatever its rate; 1 a replay came out otherwise;
    2 bad input; 130 interrupted.
    """

    names: ClassVar[Mapping[str, str]] = {"evaluation": ""}

    evaluation: EvaluationOptions
    """What is evaluated."""
    jobs: Annotated[int, Range(1)] = os.cpu_count() or 1
    """Worker processes; the result does not depend on it."""
    out: Path = Path("runs/evaluation")
    """Where lines, summary and figure are written."""
    backend: Literal["processes", "ray"] = "processes"
    """Who runs the episodes: processes of this machine, or tasks of ray (the cluster that RAY_ADDRESS names,
    else here)."""
    replay: Annotated[int | None, SEED] = None
    """Run the episode of this seed of OUT/episodes.jsonl again as it was, film it into OUT/replay_SEED, and
    say whether it came out the same to the last bit. Its line has all options: only those of the film go with
    it."""
    video: bool = True
    """--no-video: a replay is not filmed."""

    @property
    def film(self) -> FilmOptions | None:
        """Of a replay."""
        return self.evaluation.episode.film if self.video else None

    def faults(self, prefix: str = "--") -> list[str]:
        """As of all options; a replay has no other options than those of its film, and nothing else has
        those."""
        faults = super().faults(prefix)
        usual = replace(
            EvaluationOptions(self.evaluation.assembly), episode=EpisodeOptions(film=FilmOptions())
        )
        given = changed(self, EvaluateArguments(usual))
        of_film = {name: text for name, text in given.items() if name.startswith(("--film.", "--video"))}
        if self.replay is None:
            faults += [f"{text}: only a replay is filmed, see --replay" for text in of_film.values()]
        else:
            others = given.keys() - of_film.keys() - {"--out", "--replay"}
            faults += [f"{given[name]}: a replay is run as its line says" for name in sorted(others)]
            if not self.video:
                films = [text for name, text in of_film.items() if name != "--video"]
                faults += [f"{text}: there is no film with --no-video" for text in films]
        return faults


def evaluate(arguments: list[str] | None = None) -> int:
    """Entry point of `soma-evaluate` and of scripts/evaluate.py. Returns the exit status."""
    return run_command(_run, parse(EvaluateArguments, arguments, "soma-evaluate"))


def _run(options: EvaluateArguments) -> int:
    options.check()
    from rich.console import Console

    out, errors = Console(), Console(stderr=True)
    for console in (out, errors):
        console.width = max(console.width, WIDTH)
    return _evaluate(options, out, errors) if options.replay is None else _replay(options, errors)


def _evaluate(options: EvaluateArguments, out: Console, errors: Console) -> int:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from soma_bullet.evaluation import evaluate as evaluating
    from soma_bullet.evaluation.figure import draw
    from soma_bullet.evaluation.folder import SUMMARY
    from soma_bullet.evaluation.statistics import wilson
    from soma_bullet.evaluation.table import table

    evaluation = options.evaluation
    evaluation = replace(evaluation, episode=replace(evaluation.episode, film=None))
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
        bar.add_task(rate(), total=evaluation.episodes, completed=len(lines))
        bar.start()

    def done(line: dict[str, Any]) -> None:
        finished.append(line)
        bar.update(bar.task_ids[0], advance=1, description=rate())
        if not line["success"]:
            bar.console.print(f"seed {line['seed']}: {line['cause']}: {line['causes'][0]}", markup=False)

    watch = evaluating.Watch(found, done)
    try:
        summary, lines = evaluating.evaluate(evaluation, options.jobs, options.out, watch, options.backend)
    except KeyboardInterrupt:
        bar.stop()
        errors.print(
            f"{len(finished)} of {evaluation.episodes} episodes are done; the same command goes on",
            markup=False,
        )
        raise
    finally:
        bar.stop()
    picture = options.out / "summary.png"
    draw(summary, lines, evaluation.assembly, evaluation.episode.tolerance.mm, picture)
    out.print(table(summary, evaluation.assembly))
    errors.print(f"written to {options.out}/: episodes.jsonl, {SUMMARY}, {picture.name}", markup=False)
    return 0


def _replay(options: EvaluateArguments, errors: Console) -> int:
    from soma_bullet.evaluation.replay import replay

    assert options.replay is not None
    with errors.status(f"replaying seed {options.replay}"):
        again = replay(options.evaluation.assembly, options.replay, options.out, options.film)
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
