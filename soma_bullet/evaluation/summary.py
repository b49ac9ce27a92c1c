"""The numbers of an evaluation: the success rate with its interval, causes of failure, and how every measure
is spread."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from soma_bullet.evaluation.line import DIGITS, Line, rounded
from soma_bullet.evaluation.statistics import wilson

# name in the summary: list in a line, key of its members
MEASURED = {
    "error_mm": ("pieces", "error_mm"),
    "error_deg": ("pieces", "error_deg"),
    "slip_mm": ("slips", "slip_mm"),
    "slip_deg": ("slips", "slip_deg"),
    "drift_mm": ("holds", "drift_mm"),
    "grip_n": ("holds", "grip_n"),
    "peak_n": ("insertions", "peak_n"),
}
# name in the summary: planned makespan that working together is compared with; see EpisodeReport
SAVED = {"saved_percent": "one at a time", "saved_of_scheduled_percent": "as scheduled"}


def summarise(lines: Sequence[Line]) -> dict[str, Any]:
    """Success rate with its 95 % Wilson interval, causes of failure, and how every number is spread.

    Numbers are over all that was executed, and again over successes alone.
    """
    good = [line for line in lines if line["success"]]
    bad = [line for line in lines if not line["success"]]
    causes = Counter(line["cause"] for line in bad)
    events = Counter(event["kind"] for line in lines for event in line.get("events", ()))
    return {
        "episodes": len(lines),
        "successes": len(good),
        "success_rate": round(len(good) / len(lines), DIGITS),
        "interval_95": wilson(len(good), len(lines)),
        "causes": dict(sorted(causes.items(), key=lambda item: (-item[1], item[0]))),
        "failed_seeds": {
            cause: [line["seed"] for line in bad if line["cause"] == cause] for cause in sorted(causes)
        },
        "seeds": [line["seed"] for line in lines],
        "recoveries": sum(line.get("recoveries", 0) for line in lines),
        "retries": sum(line.get("retries", 0) for line in lines),
        "recovered_episodes": sum(line.get("recoveries", 0) + line.get("retries", 0) > 0 for line in good),
        "events": dict(sorted(events.items())),
        "forbidden_contacts_in_successes": sum(len(line["forbidden"]) for line in good),
        "executed": _numbers(lines),
        "successful": _numbers(good),
        "wall_s": _walls(lines),
    }


def _numbers(lines: Sequence[Line]) -> dict[str, Any]:
    spreads = {
        name: _spread([member[key] for line in lines for member in line.get(group, ())])
        for name, (group, key) in MEASURED.items()
    }
    planned = [line["planned_s"] for line in lines if "together" in line.get("planned_s", ())]
    saved = {
        name: _spread(
            [100.0 * (1.0 - times["together"] / times[against]) for times in planned if against in times]
        )
        for name, against in SAVED.items()
    }
    makespans = [line["makespan_s"] for line in lines if "makespan_s" in line]
    return {**spreads, "makespan_s": _spread(makespans), **saved}


def _walls(lines: Sequence[Line]) -> dict[str, Any]:
    walls = [line["wall_s"] for line in lines if "wall_s" in line]
    stages = dict.fromkeys(stage for wall in walls for stage in wall)
    return {stage: _spread([wall[stage] for wall in walls if stage in wall]) for stage in stages}


def _spread(values: Sequence[float]) -> dict[str, float]:
    if not values:
        return {"count": 0}
    median, p95 = np.percentile(values, [50, 95])
    mean, largest = float(np.mean(values)), float(max(values))
    return rounded(
        {"count": len(values), "mean": mean, "median": float(median), "p95": float(p95), "max": largest}
    )
