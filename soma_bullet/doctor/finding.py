"""What a check came to, and how it is told."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

State = Literal["good", "warning", "bad"]
WIDTH = 100  # [characters] of a line of the table
AGAIN = "install it again: pip install --force-reinstall"


@dataclass(frozen=True)
class Finding:
    """What one check came to.

    Attributes:
        what: what was looked at.
        state: `good`, `warning` (something is slower or plainer than it could be), or `bad`.
        says: what was found.
        advice: what to do about it; empty where all is well.
    """

    what: str
    state: State
    says: str
    advice: str = ""


Check = Callable[[], Iterator[Finding]]


def table(findings: list[Finding]) -> str:
    """The findings in columns, advice below what it is about."""
    marks = {"good": "ok", "warning": "warning", "bad": "FAILED"}
    width = max(len(finding.what) for finding in findings)
    indent = " " * (width + 11)
    lines = []
    for finding in findings:
        says = textwrap.wrap(finding.says, WIDTH - len(indent)) or [""]
        lines.append(f"{finding.what:<{width}}  {marks[finding.state]:<9}{says[0]}")
        lines += [indent + line for line in says[1:]]
        lines += textwrap.wrap(
            finding.advice, WIDTH, initial_indent=indent + "-> ", subsequent_indent=indent + "   "
        )
    return "\n".join(lines) + "\n"


def said(error: BaseException) -> str:
    """What an error says, in one line."""
    text = str(error).strip().splitlines()
    return f"{type(error).__name__}: {text[0]}" if text else type(error).__name__
