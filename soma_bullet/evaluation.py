"""How often: seeded episodes in worker processes, one line each, and a summary with its interval.

A run can be interrupted and resumed; its lines and its summary do not depend on the number of workers.
"""

from __future__ import annotations

import json
import multiprocessing
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from soma_bullet.episode import EpisodeOptions, run_episode
from soma_bullet.errors import InputError, NoSolutionError


@dataclass(frozen=True)
class EvaluationOptions:
    """What is evaluated.

    Attributes:
        assembly: file or name.
        episodes: how many; their seeds follow on from `seed`.
        seed: of the first episode.
        ablate: see EpisodeOptions.
        stability: of the planner.
    """

    assembly: str
    episodes: int = 20
    seed: int = 0
    ablate: str = ""
    stability: str = "equilibrium"


def evaluate(options: EvaluationOptions, jobs: int, out: Path, done: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """Run what is missing in `out`/episodes.jsonl, write it in the order of seeds, and write and return the summary.

    Args:
        done: is told every line, those of an earlier run first.

    Raises:
        InputError: `out` holds another evaluation.
    """
    from dataclasses import replace

    from soma_bullet.assembly.file import load_assembly

    load_assembly(options.assembly)  # refuse bad input before any worker starts
    out.mkdir(parents=True, exist_ok=True)
    file = out / "episodes.jsonl"
    lines = {line["seed"]: line for line in _read(file, options)}
    seeds = range(options.seed, options.seed + options.episodes)
    for seed in seeds:
        if seed in lines:
            done(lines[seed])
    missing = [(seed, options) for seed in seeds if seed not in lines]
    with multiprocessing.get_context("spawn").Pool(max(1, min(jobs, len(missing) or 1))) as pool:
        for line in pool.imap_unordered(_episode, missing):
            lines[line["seed"]] = line
            with file.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(line) + "\n")
            done(line)
    chosen = [lines[seed] for seed in seeds]
    kept = [lines[seed] for seed in sorted(lines)]
    file.write_text("".join(json.dumps(line) + "\n" for line in kept), encoding="utf-8")
    summary = {"what": {**vars(replace(options))}, **summarise(chosen)}
    (out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    return summary


def summarise(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """Success rate with its 95 % Wilson interval, causes of failure, and medians."""
    successes = sum(line["success"] for line in lines)
    interval = binomtest(successes, len(lines)).proportion_ci(0.95, method="wilson")
    causes = Counter(line["cause"] for line in lines if not line["success"])
    pieces = [piece for line in lines for piece in line["pieces"]]
    summary: dict[str, Any] = {
        "episodes": len(lines),
        "successes": successes,
        "success_rate": successes / len(lines),
        "interval_95": [round(interval.low, 4), round(interval.high, 4)],
        "causes": dict(causes.most_common()),
    }
    for key in ("error_mm", "error_deg"):
        values = [piece[key] for piece in pieces]
        summary[key] = {"median": float(np.median(values)), "max": float(np.max(values))} if values else {}
    for key in ("slip_mm", "drift_mm", "peak_n", "makespan_s", "forbidden_contacts"):
        values = [line[key] for line in lines if key in line]
        summary[key] = {"median": float(np.median(values)), "max": float(np.max(values))} if values else {}
    walls = [line["wall_s"] for line in lines if line["wall_s"]]
    summary["wall_s"] = {stage: float(np.median([w.get(stage, 0.0) for w in walls])) for stage in (walls[0] if walls else {})}
    return summary


def _read(file: Path, options: EvaluationOptions) -> Iterator[dict[str, Any]]:
    if not file.is_file():
        return
    for text in file.read_text(encoding="utf-8").splitlines():
        try:
            line = json.loads(text)
        except json.JSONDecodeError:
            continue  # the line that an interruption cut off
        wanted = (options.assembly, options.ablate, options.stability)
        found = tuple(line.get(key) for key in ("assembly", "ablate", "stability"))
        if found != wanted:
            raise InputError(str(file), f"holds episodes of {found}, not of {wanted}; choose another --out")
        yield line


def _episode(task: tuple[int, EvaluationOptions]) -> dict[str, Any]:
    """One line: what an episode of one seed came to."""
    from soma_bullet.planner.qualities import PlannerOptions

    seed, options = task
    line: dict[str, Any] = {
        "seed": seed, "assembly": options.assembly, "ablate": options.ablate, "stability": options.stability,
        "success": False, "cause": "", "pieces": [], "wall_s": {},
    }  # fmt: skip
    planner = PlannerOptions(stability=options.stability)  # type: ignore[arg-type]
    try:
        report = run_episode(options.assembly, EpisodeOptions(seed=seed, ablate=options.ablate, planner=planner))
    except NoSolutionError as error:
        return {**line, "cause": f"{error.stage}: {error.summary}"}
    assert report is not None
    judgement = report.judgement
    return {
        **line,
        "success": report.success,
        "cause": judgement.causes[0] if judgement.causes else "",
        "pieces": [
            {"name": p.name, "error_mm": round(p.error_mm, 4), "error_deg": round(p.error_deg, 4)} for p in report.pieces
        ],
        "slip_mm": round(max((s.slip_mm for s in judgement.slips), default=0.0), 4),
        "drift_mm": round(max((h.drift_mm for h in judgement.holds), default=0.0), 4),
        "peak_n": round(max((i.peak_n for i in judgement.insertions), default=0.0), 3),
        "forbidden_contacts": len(judgement.forbidden),
        "makespan_s": report.makespan_s,
        "feed_rejected": report.feed_rejected,
        "wall_s": report.wall_s,
    }
