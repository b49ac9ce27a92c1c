"""What the README shows runs as shown."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
Captured = pytest.CaptureFixture[str]


def test_the_first_python_of_the_readme_runs(capsys: Captured) -> None:
    exec(compile(BLOCKS[0], "README.md", "exec"), {})
    assert "Z <- BigL <- smallL" in capsys.readouterr().out


@pytest.mark.slow
def test_all_python_of_the_readme_runs_one_after_the_other(capsys: Captured) -> None:
    exec(compile("\n".join(BLOCKS), "README.md", "exec"), {})
    assert capsys.readouterr().out.splitlines()[-1].startswith("True {'BigL': '")


def test_the_python_of_the_readme_needs_nothing_but_the_package_itself() -> None:
    for block in BLOCKS:
        for node in ast.walk(ast.parse(block)):
            assert not isinstance(node, ast.ImportFrom)
            if isinstance(node, ast.Import):
                assert [alias.name for alias in node.names] == ["soma_bullet"]


def test_the_files_that_the_readme_names_are_there() -> None:
    for name in re.findall(r"\]\(([^)]+)\)", TEXT):
        assert (ROOT / name).is_file(), name
    for script in re.findall(r"^(scripts/\w+\.py)", TEXT, re.MULTILINE):
        assert (ROOT / script).is_file(), script
