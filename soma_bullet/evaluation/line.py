"""One episode as a line of JSON: what it was, what came of it, and all that is needed to run it again."""

from __future__ import annotations

import hashlib
import tempfile
import traceback
from collections import Counter
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from cattrs import Converter
from cattrs.errors import BaseValidationError

from soma_bullet.assembly.file import load_assembly
from soma_bullet.control.options import ExecutionOptions
from soma_bullet.episode import run_episode
from soma_bullet.errors import InputError, NoSolutionError
from soma_bullet.evaluation.options import EvaluationOptions, draw, episode_options
from soma_bullet.options import EpisodeOptions
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.records import package_versions, read_npz, to_tree
from soma_bullet.report.report import EpisodeReport
from soma_bullet.task.feed_options import FeedOptions
from soma_bullet.task.search_options import SearchOptions
from soma_bullet.verdict.judge import Judgement
from soma_bullet.verdict.options import Tolerance
from soma_bullet.world.log import ExecutionLog
from soma_bullet.world.options import Physics

Line = dict[str, Any]  # what one episode came to
# reports of progress of one episode, after which it is stopped; an ordinary one makes some hundreds
PATIENCE = 20_000
FIXED_VERSIONS = ("soma_bullet", "pybullet")  # lines of different ones are not mixed
DIGITS = 4  # of the numbers in a line
EPISODE_PARTS = {
    "planner": PlannerOptions,
    "search": SearchOptions,
    "feed": FeedOptions,
    "execution": ExecutionOptions,
    "physics": Physics,
    "tolerance": Tolerance,
}
# which causes a text stands for, first match first
CAUSES = (
    (" jammed in ", "jammed"), (" lost in ", "lost"), (" fell", "fell"), ("cannot be made", "no motion"),
    ("no way back", "no motion"),
)  # fmt: skip


class EndlessError(Exception):
    """An episode went on and on."""


class _Patience:
    """Counts reports of progress, not seconds: what becomes of an episode must not depend on the load of the
    machine."""

    def __init__(self) -> None:
        self.reports = 0

    def __call__(self, what: str, fraction: float) -> None:
        self.reports += 1
        if self.reports > PATIENCE:
            raise EndlessError(f"stopped after {PATIENCE} segments and searches, last: {what}")


def run_line(seed: int, options: EvaluationOptions) -> Line:
    """Run the episode of one seed. Whatever happens, it is a line."""
    return blank_line(seed, options) | outcome(options.assembly, episode_options(seed, options), None)


def blank_line(seed: int, options: EvaluationOptions) -> Line:
    """What a line says before anything has come of its episode."""
    versions, episode = package_versions(), episode_options(seed, options)
    return {
        "seed": seed,
        "assembly": options.assembly,
        "digest": load_assembly(options.assembly).digest,
        "options": options.conditions(),
        "drawn": draw(seed, options),
        "versions": {name: versions[name] for name in FIXED_VERSIONS},
        "episode": {
            part.name: to_tree(getattr(episode, part.name)) for part in fields(episode) if part.name != "film"
        },
        "success": False,
        "cause": "",
        "causes": [],
    }


def crashed_line(seed: int, options: EvaluationOptions, why: str) -> Line:
    """The line of an episode that ended without one."""
    return {**blank_line(seed, options), "cause": "crash", "causes": [why]}


def outcome(assembly: str, episode: EpisodeOptions, out: Path | None) -> Line:
    """Run an episode, in a folder or without leaving anything; what came of it."""
    try:
        with tempfile.TemporaryDirectory() as scratch:
            folder = out or Path(scratch)
            report = run_episode(assembly, episode, folder, progress=_Patience())
            assert report is not None
            return _described(report, read_npz(ExecutionLog, folder / "log.npz"))
    except NoSolutionError as error:
        reasons = [f"{count} x {reason}" for reason, count in error.reasons.most_common(12)]
        return {"cause": f"no {error.stage}", "causes": [error.summary, *reasons]}
    except EndlessError as error:
        return {"cause": "endless", "causes": [str(error)]}
    except Exception as error:  # one episode must not end the others
        frame = traceback.extract_tb(error.__traceback__)[-1]
        last = "".join(traceback.format_exception_only(error)).strip().splitlines()[-1]
        return {"cause": "crash", "causes": [f"{last} ({Path(frame.filename).name}:{frame.lineno})"]}


def _described(report: EpisodeReport, log: ExecutionLog) -> Line:
    verdict = report.judgement
    kinds = Counter(event.kind for event in log.events)
    return rounded(
        {
            "success": report.success,
            "cause": "" if report.success else categorise(verdict, log.ended),
            "causes": verdict.causes,
            "order": report.order,
            "pieces": to_tree(verdict.pieces),
            "slips": to_tree(verdict.slips),
            "holds": to_tree(verdict.holds),
            "insertions": to_tree(verdict.insertions),
            "forbidden": to_tree(verdict.forbidden),
            "dropped": verdict.dropped,
            "limits": to_tree(verdict.limits),
            "events": [to_tree(event) for event in log.events],
            "retries": kinds["jammed"],
            "recoveries": kinds["planned anew"],
            "feed_rejected": report.feed_rejected,
            "makespan_s": report.makespan_s,
            "planned_s": report.planned_s,
            "log_sha256": hashlib.sha256(np.ascontiguousarray(log.poses, "<f8").tobytes()).hexdigest(),
            "wall_s": report.wall_s,
        }
    )


def rounded(node: Any) -> Any:
    """Plain JSON, its numbers rounded."""
    if isinstance(node, dict):
        return {key: rounded(child) for key, child in node.items()}
    if isinstance(node, list | tuple):
        return [rounded(child) for child in node]
    return round(node, DIGITS) if isinstance(node, float) else node


def categorise(verdict: Judgement, ended: str) -> str:
    """The cause of a failure in a word or two; how the executive ended comes before how the pieces lie."""
    if ended != "done":
        return next((cause for text, cause in CAUSES if text in ended), "stopped")
    if verdict.dropped:
        return "fell"
    if not all(piece.in_place for piece in verdict.pieces):
        return "not in place"
    return "forbidden contact" if verdict.forbidden else "limits"


def options_of(line: Line, source: str) -> EpisodeOptions:
    """The options of an episode from its line. Raises InputError."""
    converter, tree = Converter(forbid_extra_keys=True), dict(line.get("episode", {}))
    try:
        parts: dict[str, Any] = {
            name: converter.structure(tree.pop(name), kind) for name, kind in EPISODE_PARTS.items()
        }
        return EpisodeOptions(**tree, **parts)
    except (BaseValidationError, KeyError, TypeError, ValueError) as error:
        fault = f"the options of seed {line['seed']} are not of this version of the package: {error}"
        raise InputError(source, fault) from None
