"""Evaluations of episodes that were never run; workers import them from here."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np

from soma_bullet.evaluation.folder import LINES, write_lines
from soma_bullet.evaluation.line import (
    Line,
    blank_line,
)
from soma_bullet.evaluation.options import EvaluationOptions

SOMA3 = EvaluationOptions("soma3", 6)


def canned(seed: int, options: EvaluationOptions) -> Line:
    """Every third episode fails."""
    line = blank_line(seed, options)
    good = seed % 3 != 1
    numbers = np.random.default_rng(seed).random(4).round(4).tolist()
    return line | {
        "success": good,
        "cause": "" if good else "jammed",
        "causes": [] if good else ["A jammed in place"],
        "pieces": [{"name": "A", "error_mm": numbers[0], "error_deg": numbers[1]}],
        "slips": [{"slip_mm": numbers[2], "slip_deg": 0.1}],
        "holds": [],
        "insertions": [{"peak_n": numbers[3]}],
        "forbidden": [],
        "events": [{"time": 1.0, "kind": "jammed", "piece": "A", "text": ""}],
        "retries": 1,
        "recoveries": int(seed == 0),
        "makespan_s": 20.0 + seed,
        "planned_s": {"together": 15.0 + seed, "one at a time": 20.0 + seed, "as scheduled": 30.0 + seed},
        "log_sha256": f"{seed:064x}",
        "wall_s": {"execution": 1.0},
    }


def fragile(seed: int, options: EvaluationOptions) -> Line:
    """The second raises, the fourth takes its process with it."""
    if seed == 1:
        raise ValueError("no such luck")
    if seed == 3:
        os._exit(7)
    return canned(seed, options)


def slow(seed: int, options: EvaluationOptions) -> Line:
    """The later ones do not end."""
    if seed >= 3:
        time.sleep(60)
    return canned(seed, options)


def leave(options: EvaluationOptions, folder: Path) -> list[Line]:
    """What an evaluation leaves when it has run all its episodes, without workers."""
    folder.mkdir(exist_ok=True)
    lines = [canned(seed, options) for seed in options.seeds]
    write_lines(folder / LINES, dict(zip(options.seeds, lines, strict=True)))
    return lines


def threads(seed: int, options: EvaluationOptions) -> Line:
    """How many threads a worker is told to use."""
    return canned(seed, options) | {"threads": os.environ["OMP_NUM_THREADS"]}


def masked(seed: int, options: EvaluationOptions) -> Line:
    return {"seed": seed, "blocked": signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())}
