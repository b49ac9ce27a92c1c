"""What the command line says of bad input, which must cost nothing and write nothing."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from soma_bullet.cli.episode import run_episode

Captured = pytest.CaptureFixture[str]


def refused(arguments: list[str], capsys: Captured) -> str:
    """What goes to stderr when the input is bad, in one line; checks that nothing else happened."""
    out = Path("refused")
    before = sorted(Path.cwd().rglob("*"))
    try:
        status = run_episode([*arguments, "--out", str(out)])
    except SystemExit as exit_:  # tyro ends the process itself
        status = int(exit_.code or 0)
    captured = capsys.readouterr()
    assert status == 2, captured.err
    assert captured.out == ""
    assert "Traceback" not in captured.err
    assert sorted(Path.cwd().rglob("*")) == before
    return re.sub(r"[\s│]+", " ", captured.err)
