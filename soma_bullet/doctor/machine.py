"""Checks of the machine: cores, memory, folders."""

from __future__ import annotations

import os
import platform
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

from soma_bullet.doctor.finding import Finding

CORES, MEMORY = 2, 4.0  # [GB] below which it is slow, or may not do


def check_machine() -> Iterator[Finding]:
    """Cores and memory."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    says = f"{platform.system()} {platform.machine()}, {cores} core{'s' if cores > 1 else ''}"
    advice = "" if cores >= CORES else "works, but a film takes twice as long, and so do evaluations"
    yield Finding("cores", "good" if not advice else "warning", says, advice)
    memory = _memory()
    if memory is not None:
        advice = (
            ""
            if memory >= MEMORY
            else f"evaluate with --jobs 1; an episode takes about 1 GB, a film {MEMORY:.0f} GB"
        )
        yield Finding("memory", "good" if not advice else "warning", f"{memory:.1f} GB free", advice)


def _memory() -> float | None:
    """What is free [GB]; None where the system does not say."""
    file = Path("/proc/meminfo")
    found = re.search(r"MemAvailable:\s+(\d+) kB", file.read_text()) if file.is_file() else None
    return int(found.group(1)) * 1024 / 1e9 if found else None


def check_folders() -> Iterator[Finding]:
    """Where plans are kept between runs, and where scratch files go."""
    from soma_bullet.planner.store import store_folder

    for what, folder, state, advice in (
        (
            "folder of kept plans",
            store_folder(),
            "warning",
            "every run plans afresh; set XDG_CACHE_HOME to a folder of yours",
        ),
        ("scratch folder", Path(tempfile.gettempdir()), "bad", "set TMPDIR to a folder that can be written"),
    ):
        fault = _unwritable(folder)
        says = f"{folder} {fault or 'can be written'}"
        yield Finding(what, state if fault else "good", says, advice if fault else "")  # type: ignore[arg-type]


def _unwritable(folder: Path) -> str:
    """Why nothing can be written into a folder that may not be there yet; empty where something can."""
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    try:
        with tempfile.TemporaryFile(dir=there):
            return ""
    except OSError as error:
        return f"cannot be written: {error.strerror}"
