"""How often: seeded episodes in worker processes, one line each, and a summary with its interval.

A run can be interrupted and resumed; its lines and its summary do not depend on the number of workers, nor on
who runs them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from importlib import util
from pathlib import Path
from typing import Any, Literal

from soma_bullet.assembly.file import load_assembly
from soma_bullet.errors import InputError
from soma_bullet.evaluation.folder import (
    LINES,
    alone,
    append_line,
    check_lines,
    make_folder,
    read_lines,
    write_lines,
    write_summary,
)
from soma_bullet.evaluation.line import Line, run_line
from soma_bullet.evaluation.options import EvaluationOptions
from soma_bullet.evaluation.summary import summarise
from soma_bullet.evaluation.workers import Episode, in_processes, on_ray
from soma_bullet.pipeline import cell_of
from soma_bullet.planner.analyzers import check_analyzers


@dataclass(frozen=True)
class Watch:
    """Who is told how an evaluation goes on: `found` the lines of an earlier run, `done` every new one."""

    found: Callable[[list[Line]], object] = lambda lines: None
    done: Callable[[Line], object] = lambda line: None


def evaluate(
    options: EvaluationOptions,
    jobs: int,
    out: Path,
    watch: Watch | None = None,
    backend: Literal["processes", "ray"] = "processes",
    episode: Episode = run_line,
) -> tuple[dict[str, Any], list[Line]]:
    """Run what is missing in `out`/episodes.jsonl, write it in the order of seeds, and write and return
    summary and lines.

    Args:
        jobs: worker processes.
        watch: who is told of every line.
        backend: who runs the episodes: processes of this machine, or a cluster (or this machine) by ray,
            where the assembly's file must lie at the same place.
        episode: runs one; a function of a module.

    Raises:
        InputError: an option is wrong, or `out` holds another evaluation; nothing has been written then.
    """
    watch = watch or Watch()
    digest = _check(options, backend)
    file = out / LINES
    lines = {line["seed"]: line for line in read_lines(file)}
    check_lines(lines.values(), options, digest, out)
    make_folder(out)
    with alone(out):
        write_lines(file, lines)  # without what an interruption cut off
        watch.found([lines[seed] for seed in options.seeds if seed in lines])
        missing = [seed for seed in options.seeds if seed not in lines]
        running = (on_ray if backend == "ray" else in_processes)(missing, options, jobs, episode)
        with closing(running), file.open("a", encoding="utf-8") as stream:
            for line in running:
                lines[line["seed"]] = line
                append_line(stream, line)
                watch.done(line)
        write_lines(file, lines)
    chosen = [lines[seed] for seed in options.seeds]
    what = {
        "assembly": options.assembly,
        "digest": digest,
        "options": options.conditions(),
        "versions": chosen[0]["versions"],
    }
    summary = {**what, **summarise(chosen)}
    write_summary(out, summary)
    return summary, chosen


def _check(options: EvaluationOptions, backend: str) -> str:
    """Refuse bad input before any worker starts; returns the assembly's digest."""
    if backend == "ray" and util.find_spec("ray") is None:
        raise InputError(
            "--backend ray", "ray is not installed; `pip install 'soma_bullet[ray]'` installs it"
        )
    options.check()
    if options.episode.film is not None:
        raise InputError("film", "no episode of an evaluation is filmed; a replay of one is")
    check_analyzers(options.episode.planner)
    digest = load_assembly(options.assembly).digest
    cell_of(options.episode)
    return digest
