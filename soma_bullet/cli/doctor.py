"""The command line that checks installation and machine: `soma-doctor`, scripts/doctor.py.

Uses nothing but the standard library until a check needs more, so that it can say what is missing.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator

from soma_bullet.doctor.finding import Check, Finding, said, table
from soma_bullet.doctor.installation import check_packages, check_python
from soma_bullet.doctor.machine import check_folders, check_machine
from soma_bullet.doctor.pictures import check_pictures
from soma_bullet.doctor.robot import check_physics, check_robot

CHECKS: dict[str, Check] = {
    "python": check_python,
    "packages": check_packages,
    "machine": check_machine,
    "folders": check_folders,
    "robot": check_robot,
    "physics": check_physics,
    "pictures": check_pictures,
}


def doctor(arguments: list[str] | None = None) -> int:
    """Entry point of `soma-doctor` and of scripts/doctor.py. Prints a table; returns 0 if all that is needed
    works, else 1."""
    parser = argparse.ArgumentParser(
        prog="soma-doctor",
        description="Checks the installation and the machine, and says what is wrong and what to do about "
        "it. Exit status: 0 if everything that is needed works (a warning is no fault), else 1.",
    )
    parser.parse_args(arguments)
    start = time.perf_counter()
    findings = list(examine())
    sys.stdout.write(table(findings))
    bad = [finding for finding in findings if finding.state == "bad"]
    warned = sum(finding.state == "warning" for finding in findings)
    verdict = f"{len(bad)} of {len(findings)} checks failed" if bad else "everything that is needed works"
    more = f", {warned} warning{'s' if warned > 1 else ''}" if warned else ""
    sys.stdout.write(f"\n{verdict}{more} ({time.perf_counter() - start:.0f} s)\n")
    return 1 if bad else 0


def examine() -> Iterator[Finding]:
    """All findings. A check that fails in a way that nobody thought of is a finding too."""
    for name, check in CHECKS.items():
        try:
            yield from check()
        except Exception as error:
            yield Finding(
                name,
                "bad",
                said(error),
                "if a line above explains it, mend that first; if none does, this is a fault of the "
                "package: report it",
            )
