"""The benchmark of motions, physics and episodes: what it measures, and what it says of bad arguments. Not:
how fast it is."""

from __future__ import annotations

import importlib.util
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from test_evaluation import write_two_blocks

from soma_bullet.assembly.file import load_assembly
from soma_bullet.errors import InputError
from soma_bullet.robot.cell import load_cell
from soma_bullet.task.workcell import Workcell

SCRIPT = Path(__file__).resolve().parents[1] / "scripts" / "benchmark.py"


@pytest.fixture(scope="module")
def benchmark() -> Iterator[Any]:
    spec = importlib.util.spec_from_file_location("benchmark_script", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["benchmark_script"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["benchmark_script"]


@pytest.fixture(scope="module")
def two_blocks(tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_two_blocks(tmp_path_factory.mktemp("two"))


def row(
    benchmark: Any, kind: str, cpu: float, birrt: float, solved: bool = True, birrt_solved: bool | None = True
) -> Any:
    parts = dict.fromkeys(benchmark.PARTS, cpu / len(benchmark.PARTS))
    return benchmark.Timed("q", kind, solved, cpu, 2 * cpu, parts, birrt_solved, birrt, 2 * birrt)


def test_the_table_of_motions(benchmark: Any) -> None:
    rows = [
        row(benchmark, "transfer", 0.010, 0.200),
        row(benchmark, "transfer", 0.020, 0.400),
        row(benchmark, "transit", 0.030, 0.600),
        row(benchmark, "home", 0.9, 0.0, solved=False, birrt_solved=False),
    ]
    rows[-1].birrt_note = "goal in collision"
    said = benchmark.motion_table(rows)
    assert (
        "| transfer | 2 of 2 | 15.0 ms |" in said
        and "| home | 0 of 1 |" in said
        and "| all | 3 of 4 |" in said
    )
    assert "| chain, median | < 25 ms | 50.0 ms | 25.0 ms | no |" in said
    assert "| birrt's median over ours | > 15 | 20.0 | 20.0 | yes |" in said
    assert "| transfer | 2 of 2 | 2 of 2 | 15.0 ms | 300.0 ms | 390.0 ms | 20.0 |" in said
    assert "not begun in 1 cases" in said


def test_the_table_without_birrt(benchmark: Any) -> None:
    said = benchmark.motion_table([row(benchmark, "transfer", 0.010, 0.0, birrt_solved=None)])
    assert "birrt" not in said and "| chain, median | < 25 ms | 20.0 ms | 10.0 ms | yes |" in said


def test_hooks_measure_and_go_away(benchmark: Any) -> None:
    class Module:
        @staticmethod
        def work(n: int) -> int:
            return sum(range(n))

    original, seconds = Module.work, {"work": 0.0}
    with benchmark._hooked(Module, {"work": "work"}, seconds):
        assert Module.work(200_000) == sum(range(200_000))
    assert Module.work is original and 0.0 < seconds["work"] < 1.0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"seeds": 0}, "--seeds 0: must be at least 1"),
        ({"resolution": 0.0}, "--resolution 0: must be above 0"),
        ({"assemblies": ("som3",)}, "no such assembly"),
    ],
)
def test_bad_arguments(benchmark: Any, arguments: dict, said: str, tmp_path: Path) -> None:
    options = benchmark.Motion(**{"birrt": False, "out": tmp_path / "out.json", **arguments})
    with pytest.raises(InputError, match=said):
        benchmark.motion(options, lambda text: None)
    assert benchmark.main(options) == 2
    assert list(tmp_path.iterdir()) == []


def test_without_pybullet_planning_one_is_told(benchmark: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(
        InputError, match=r"pip install 'soma_bullet\[benchmark\]' installs it, --no-birrt does without"
    ):
        benchmark.motion(benchmark.Motion(), lambda text: None)


@pytest.mark.slow
def test_motions_of_a_program(
    benchmark: Any, two_blocks: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pybullet_planning", reason="an extra: pip install soma_bullet[benchmark]")
    options = benchmark.Motion((two_blocks,), seeds=1, resolution=0.05, out=tmp_path / "out.json")
    benchmark.motion(options, lambda text: None)
    queries = json.loads(options.out.read_text())["queries"]
    assert {query["kind"] for query in queries} >= {"transit", "transfer"}
    for query in queries:
        assert query["solved"] and query["birrt_solved"], query
        assert sum(query["parts"].values()) <= query["cpu"] * 1.01 and query["birrt_cpu"] > 0
    assert "| the same queries |" in capsys.readouterr().out


@pytest.mark.slow
def test_the_world_of_birrt_is_ours(benchmark: Any, two_blocks: str) -> None:
    """What is free in our scene is free in its world; an arm in the table or in the other block collides in
    both."""
    pytest.importorskip("pybullet_planning", reason="an extra: pip install soma_bullet[benchmark]")
    workcell = Workcell(load_assembly(two_blocks), load_cell("ur5e_pair"))
    queries = benchmark._queries("two", workcell, 0, "preferred")
    with benchmark._BirrtWorld(workcell, 0.05) as world:
        for query in queries:
            blocked = world._lay_out(query)
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
def test_physics_and_an_episode(benchmark: Any, two_blocks: str, capsys: pytest.CaptureFixture[str]) -> None:
    benchmark.simulate(benchmark.Simulate(two_blocks))
    said = capsys.readouterr().out
    assert (
        "| steps, nothing gripped |" in said and "| steps, one hand grips |" in said and "ended: done" in said
    )
    benchmark.episode(benchmark.Episode(two_blocks, seeds=1, poses="preferred"), lambda text: None)
    said = capsys.readouterr().out
    assert (
        all(f"| {stage} |" in said for stage in ("motion", "execution", "judgement", "all"))
        and "1 of 1 succeeded" in said
    )
