"""The doctor: what it finds on a machine where all is well, and what it says where something is not."""

from __future__ import annotations

import subprocess
import sys
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from soma_bullet.cli import doctor as command
from soma_bullet.cli.doctor import doctor, examine
from soma_bullet.doctor import installation, machine, pictures
from soma_bullet.doctor.finding import WIDTH, Finding, table
from soma_bullet.doctor.installation import check_packages, check_python, serves
from soma_bullet.doctor.machine import check_folders

ROOT = Path(__file__).resolve().parents[1]
SLOWEST = 60.0  # [s]; 15 are meant, and a busy machine is not to fail it


@pytest.mark.slow
def test_all_is_well_here(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "scripts" / "doctor.py")]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=SLOWEST, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    said = done.stdout
    for name in (
        "python",
        "pybullet",
        "ompl",
        "pin",
        "coal",
        "inverse kinematics",
        "collision check",
        "physics",
        "renderer",
        "video",
    ):
        assert f"\n{name} " in "\n" + said, name
    assert "FAILED" not in said and "everything that is needed works" in said and done.stderr == ""
    assert list(tmp_path.iterdir()) == []
    assert max(map(len, said.splitlines())) <= WIDTH


@pytest.mark.parametrize(
    ("version", "requirement", "good"),
    [
        ("3.2.7", "pybullet<4,>=3.2.7", True),
        ("3.2.6", "pybullet<4,>=3.2.7", False),
        ("3.10", "pybullet<4,>=3.2.7", True),
        ("4.0.0", "pybullet<4,>=3.2.7", False),
        ("4.4.0.post1", "embreex<5,>=4.4", True),
        ("2.4", "numpy<3,>=2.4; python_version > '3'", True),
        ("1", "anything", True),
        ("2.0", "thing>2", False),
        ("2.0", "thing<=2", True),
    ],
)
def test_versions_are_compared_as_numbers(version: str, requirement: str, good: bool) -> None:
    assert serves(version, requirement) is good


def findings(check: Any) -> dict[str, Finding]:
    return {finding.what: finding for finding in check()}


def test_a_package_that_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    real = metadata.version

    def version(name: str) -> str:
        if name == "coal":
            raise metadata.PackageNotFoundError(name)
        return real(name)

    monkeypatch.setattr(installation.metadata, "version", version)
    found = findings(check_packages)
    assert found["coal"].state == "bad" and found["coal"].advice.startswith("pip install 'coal")
    assert found["numpy"].state == "good" and "pytest" not in found


def test_a_package_that_is_too_old_or_does_not_load(monkeypatch: pytest.MonkeyPatch) -> None:
    real = installation.importlib.import_module

    def load(name: str) -> Any:
        if name == "toppra":
            raise ImportError("libgomp.so.1: no such file")
        return real(name)

    monkeypatch.setattr(installation.importlib, "import_module", load)
    monkeypatch.setattr(
        installation.metadata, "version", lambda name: "1.0" if name == "ompl" else metadata_version(name)
    )
    found = findings(check_packages)
    assert "1.0 does not serve" in found["ompl"].says and found["ompl"].state == "bad"
    assert "libgomp" in found["toppra"].says and "--force-reinstall" in found["toppra"].advice


metadata_version = metadata.version


def test_the_package_itself_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installation, "PACKAGE", "no-such-package")
    (finding,) = check_packages()
    assert finding.state == "bad" and "pip install --editable ." in finding.advice


def test_another_python(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installation, "PYTHON", (3, 9))
    (finding,) = check_python()
    assert finding.state == "bad" and "CPython 3.11" in finding.advice


def test_a_folder_that_cannot_be_written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc")
    monkeypatch.setattr(machine.tempfile, "gettempdir", lambda: str(tmp_path))
    found = findings(check_folders)
    assert (
        found["folder of kept plans"].state == "warning"
        and "XDG_CACHE_HOME" in found["folder of kept plans"].advice
    )
    assert found["scratch folder"].state == "good" and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("done", "state", "said"),
    [
        (SimpleNamespace(returncode=0, stdout="egl|31.0|\n", stderr=""), "good", "EGL draws"),
        (
            SimpleNamespace(returncode=0, stdout="tiny|31.0|no plugin\n", stderr=""),
            "warning",
            "slow: no plugin",
        ),
        (SimpleNamespace(returncode=0, stdout="egl|0.0|\n", stderr=""), "bad", "empty picture"),
        (SimpleNamespace(returncode=-11, stdout="", stderr=""), "bad", "exit status -11"),
        (
            SimpleNamespace(returncode=1, stdout="", stderr="Traceback\nValueError: no\n"),
            "bad",
            "ValueError: no",
        ),
    ],
)
def test_who_draws(done: Any, state: str, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures.subprocess, "run", lambda *_, **__: done)
    finding = pictures._renderer()
    assert finding.state == state and said in finding.says
    assert ("libegl1" in finding.advice) is (state != "good")


def test_a_check_that_falls_over_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    def check() -> Any:
        yield Finding("first", "good", "fine")
        raise RuntimeError("what now\nand more")

    monkeypatch.setattr(
        command, "CHECKS", {"odd": check, "last": lambda: iter([Finding("last", "good", "fine")])}
    )
    assert [(f.what, f.state) for f in examine()] == [("first", "good"), ("odd", "bad"), ("last", "good")]


@pytest.mark.parametrize(("state", "status"), [("good", 0), ("warning", 0), ("bad", 1)])
def test_the_exit_status(
    state: Any, status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        command, "CHECKS", {"it": lambda: iter([Finding("it", state, "says", "do this" * (state != "good"))])}
    )
    assert doctor([]) == status
    said = capsys.readouterr().out
    assert ("-> do this" in said) is (state != "good")
    assert ("everything that is needed works" in said) is (status == 0)


def test_long_lines_are_wrapped() -> None:
    lines = table(
        [Finding("it", "bad", "word " * 60, "advice " * 60), Finding("a longer name", "good", "")]
    ).splitlines()
    assert max(map(len, lines)) <= WIDTH and sum("->" in line for line in lines) == 1
