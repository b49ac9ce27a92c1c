"""The benchmark of motions, physics and episodes: what it measures, and what it says of bad arguments. Not:
how fast it is."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import pytest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.benchmark.episodes import episode
from soma_bullet.benchmark.motion import motion, queries_of
from soma_bullet.benchmark.motion_table import motion_table
from soma_bullet.benchmark.options import PREFERRED, Episode, Motion, Simulate
from soma_bullet.benchmark.physics import simulate
from soma_bullet.benchmark.query import PARTS, Timed
from soma_bullet.benchmark.stopwatch import hooked
from soma_bullet.bullet.birrt import BirrtWorld
from soma_bullet.cli.benchmark import benchmark
from soma_bullet.errors import InputError
from soma_bullet.options import EpisodeOptions
from soma_bullet.robot.cell import load_cell
from soma_bullet.task.workcell import Workcell
from tests.blocks import write_two_blocks


@pytest.fixture(scope="module")
def two_blocks(tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_two_blocks(tmp_path_factory.mktemp("two"))


def row(kind: str, cpu: float, birrt: float, solved: bool = True, birrt_solved: bool | None = True) -> Any:
    parts = dict.fromkeys(PARTS, cpu / len(PARTS))
    return Timed("q", kind, solved, cpu, 2 * cpu, parts, birrt_solved, birrt, 2 * birrt)


def test_the_table_of_motions() -> None:
    rows = [
        row("transfer", 0.010, 0.200),
        row("transfer", 0.020, 0.400),
        row("transit", 0.030, 0.600),
        row("home", 0.9, 0.0, solved=False, birrt_solved=False),
    ]
    rows[-1].birrt_note = "goal in collision"
    said = motion_table(rows)
    assert (
        "| transfer | 2 of 2 | 15.0 ms |" in said
        and "| home | 0 of 1 |" in said
        and "| all | 3 of 4 |" in said
    )
    assert "| chain, median | < 25 ms | 50.0 ms | 25.0 ms | no |" in said
    assert "| birrt's median over ours | > 15 | 20.0 | 20.0 | yes |" in said
    assert "| transfer | 2 of 2 | 2 of 2 | 15.0 ms | 300.0 ms | 390.0 ms | 20.0 |" in said
    assert "not begun in 1 cases" in said


def test_the_table_without_birrt() -> None:
    said = motion_table([row("transfer", 0.010, 0.0, birrt_solved=None)])
    assert "birrt" not in said and "| chain, median | < 25 ms | 20.0 ms | 10.0 ms | yes |" in said


def test_hooks_measure_and_go_away() -> None:
    class Module:
        @staticmethod
        def work(n: int) -> int:
            return sum(range(n))

    original, seconds = Module.work, {"work": 0.0}
    with hooked(Module, {"work": "work"}, seconds):
        assert Module.work(200_000) == sum(range(200_000))
    assert Module.work is original and 0.0 < seconds["work"] < 1.0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["motion", "--seeds", "0"], "--seeds 0: must be at least 1"),
        (["motion", "--resolution", "0"], "--resolution 0: must be above 0"),
        (["motion", "--no-birrt", "--assemblies", "som3"], "no such assembly"),
        (["cube240", "--plans", "241"], "--plans 241: must be from 0 to 240"),
        (["planner", "--runs", "0"], "--runs 0: must be at least 1"),
        (["simulate", "--physics.mass", "0"], "--physics.mass 0: must be above 0"),
        (["episode", "--seed", "1"], "--seed"),
        (["--stages", "some"], "stages"),
    ],
)
def test_bad_arguments(
    arguments: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        monkeypatch.setenv(variable, "1")
    try:
        status = benchmark(arguments)
    except SystemExit as exit_:
        status = int(exit_.code or 0)
    assert status == 2 and said in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_without_pybullet_planning_one_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(
        InputError, match=r"pip install 'soma_bullet\[benchmark\]' installs it, --no-birrt does without"
    ):
        motion(Motion(), lambda text: None)


@pytest.mark.slow
def test_motions_of_a_program(two_blocks: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pybullet_planning", reason="an extra: pip install soma_bullet[benchmark]")
    options = Motion((two_blocks,), seeds=1, resolution=0.05, out=tmp_path / "out.json")
    motion(options, lambda text: None)
    queries = json.loads(options.out.read_text())["queries"]
    assert {query["kind"] for query in queries} >= {"transit", "transfer"}
    for query in queries:
        assert query["solved"] and query["birrt_solved"], query
        assert sum(query["parts"].values()) <= query["cpu"] * 1.01 and query["birrt_cpu"] > 0
    assert "| the same queries |" in capsys.readouterr().out


@pytest.mark.slow
def test_the_world_of_birrt_is_ours(two_blocks: str) -> None:
    """What is free in our scene is free in its world; an arm in the table or in the other block collides in
    both."""
    pytest.importorskip("pybullet_planning", reason="an extra: pip install soma_bullet[benchmark]")
    workcell = Workcell(load_assembly(two_blocks), load_cell("ur5e_pair"))
    queries = queries_of("two", workcell, 0, PREFERRED)
    with BirrtWorld(workcell, 0.05) as world:
        for query in queries:
            blocked = world.lay_out(query.context, query.segment.arm, float(query.widths.max()))
            arm, path = query.segment.arm, query.segment.path
            assert not any(blocked(list(q)) for q in path[:: max(1, len(path) // 20)]), query.name
            down = workcell.robot.inverse(arm, _lowered(workcell.robot.tcp(arm, path[-1])), path[-1])
            assert len(down) and blocked(list(down[0])), query.name


def _lowered(pose: Any) -> Any:
    """The same pose with the hand well under the table."""
    low = pose.copy()
    low[2, 3] = -0.05
    return low


@pytest.mark.slow
def test_physics_and_an_episode(two_blocks: str, capsys: pytest.CaptureFixture[str]) -> None:
    simulate(Simulate(two_blocks))
    said = capsys.readouterr().out
    assert (
        "| steps, nothing gripped |" in said and "| steps, one hand grips |" in said and "ended: done" in said
    )
    episode(Episode(two_blocks, seeds=1, episode=EpisodeOptions(feed=PREFERRED)), lambda text: None)
    said = capsys.readouterr().out
    assert (
        all(f"| {stage} |" in said for stage in ("motion", "execution", "judgement", "all"))
        and "1 of 1 succeeded" in said
    )
