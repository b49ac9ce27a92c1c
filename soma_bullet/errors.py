"""Every error that soma_bullet raises on purpose, and the exit status that each stands for."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

MOST_SHOWN = 20  # faults in a message


class SomaBulletError(Exception):
    """Base of all errors of this package; `exit_status` is what a script returns for it."""

    exit_status = 1


class InputError(SomaBulletError):
    """A file or an argument is wrong. Carries every fault found, not just the first.

    Attributes:
        source: the file or the argument that is wrong.
        faults: one sentence each; names the piece and the value, and says what would be right.
    """

    exit_status = 2

    def __init__(self, source: str, faults: str | Iterable[str]):
        self.source = str(source)
        self.faults = (faults,) if isinstance(faults, str) else tuple(faults)
        lines = (
            [f"{self.source}: {self.faults[0]}"]
            if len(self.faults) == 1
            else [
                f"{self.source}: {len(self.faults)} faults",
                *(f"  - {fault}" for fault in self.faults[:MOST_SHOWN]),
                *([f"  and {len(self.faults) - MOST_SHOWN} more"] if len(self.faults) > MOST_SHOWN else []),
            ]
        )
        super().__init__("\n".join(lines))


class NoSolutionError(SomaBulletError):
    """The input is fine but no plan, schedule or motion was found.

    Attributes:
        stage: where the search ended (`plan`, `schedule`, `motion`).
        reasons: what blocked, with how often; printed most frequent first.
        decided: what ended the search, in lines; printed before the reasons.
    """

    exit_status = 3

    def __init__(
        self,
        stage: str,
        summary: str,
        reasons: Counter[str] | None = None,
        decided: Iterable[str] = (),
    ):
        self.stage = stage
        self.summary = summary
        self.reasons = Counter(reasons or {})
        self.decided = tuple(decided)
        lines = [f"{stage}: {summary}", *(f"  {line}" for line in self.decided)]
        lines += [f"  {count:6d} x {reason}" for reason, count in self.reasons.most_common(12)]
        super().__init__("\n".join(lines))
