"""A folder of its own for every test, one plan of soma3, and a guard against planning."""

from __future__ import annotations

from pathlib import Path

import pytest

from soma_bullet.cli.episode import run_episode


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is written by default lands in the test's own folder."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="session")
def planned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of one plan of soma3."""
    folder = tmp_path_factory.mktemp("planned")
    assert run_episode(["soma3", "--plan-only", "--out", str(folder)]) == 0
    return folder


@pytest.fixture
def never_planned(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever plans or simulates has not looked at the input first."""

    def fail(*_: object, **__: object) -> None:
        pytest.fail("it planned before it refused the input")

    import soma_bullet.episode as episode

    for name in ("kept_plan", "program_of_best_order", "Workcell", "executed"):
        monkeypatch.setattr(episode, name, fail)
