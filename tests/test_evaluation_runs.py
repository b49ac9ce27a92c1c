"""Evaluations: who runs the episodes, what an interrupt does, the command, and two blocks in physics."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from soma_bullet.cli.evaluate import evaluate as command
from soma_bullet.errors import InputError
from soma_bullet.evaluation import evaluate as evaluating
from soma_bullet.evaluation.evaluate import Watch, evaluate
from soma_bullet.evaluation.folder import LINES, SUMMARY, read_lines
from soma_bullet.evaluation.options import EvaluationOptions, episode_options
from soma_bullet.evaluation.replay import replay
from soma_bullet.evaluation.statistics import wilson
from soma_bullet.evaluation.workers import _inherited
from soma_bullet.options import EpisodeOptions
from tests.blocks import write_two_blocks
from tests.canned import SOMA3, canned, fragile, leave, threads

ROOT = Path(__file__).resolve().parents[1]


def without_wall(tree: Any) -> Any:
    """A line or a summary without wall times."""
    return {key: value for key, value in tree.items() if key != "wall_s"}


# --- who runs them ------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_lines_and_summary_do_not_depend_on_the_jobs(tmp_path: Path) -> None:
    seen: list[int] = []
    one = evaluate(
        SOMA3, 1, tmp_path / "one", Watch(done=lambda line: seen.append(line["seed"])), episode=canned
    )
    two = evaluate(SOMA3, 2, tmp_path / "two", episode=canned)
    assert one == two and sorted(seen) == list(SOMA3.seeds)
    for name in (LINES, SUMMARY):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    assert {path.name for path in (tmp_path / "one").iterdir()} == {LINES, SUMMARY}


@pytest.mark.slow
def test_neither_an_exception_nor_a_dead_process_stops_the_run(tmp_path: Path) -> None:
    summary, lines = evaluate(SOMA3, 2, tmp_path, episode=fragile)
    assert summary["causes"] == {"crash": 2, "jammed": 1} and summary["failed_seeds"]["crash"] == [1, 3]
    assert lines[1]["causes"] == ["ValueError: no such luck"] and "exit status 7" in lines[3]["causes"][0]
    assert [line["seed"] for line in lines] == list(SOMA3.seeds)


def test_the_workers_have_one_thread_and_leave_the_environment_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    _, (line,) = evaluate(replace(SOMA3, episodes=1), 1, tmp_path, episode=threads)
    assert line["threads"] == "1" and os.environ["OMP_NUM_THREADS"] == "5"


@pytest.mark.slow
def test_ray_makes_the_same_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray", reason="ray is an extra: pip install soma_bullet[ray]")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))  # its workers import the canned episodes from here
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    ours = evaluate(SOMA3, 2, tmp_path / "processes", episode=fragile)
    rays = evaluate(SOMA3, 2, tmp_path / "ray", backend="ray", episode=fragile)
    same = lambda lines: [line for line in lines if line["seed"] != 3]  # noqa: E731
    assert same(ours[1]) == same(rays[1])
    assert rays[1][3]["cause"] == "crash" and rays[0]["success_rate"] == ours[0]["success_rate"]


def test_without_ray_one_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluating.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"ray is not installed; `pip install 'soma_bullet\[ray\]'`"):
        evaluate(SOMA3, 2, tmp_path / "out", backend="ray", episode=canned)
    assert not (tmp_path / "out").exists()


# --- an interrupt -------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_interrupted_run_keeps_what_is_done_and_goes_on(tmp_path: Path) -> None:
    """Ctrl-C goes to the whole process group, as a terminal sends it."""
    arguments = ["soma3", "--episodes", "6", "--jobs", "2", "--out", str(tmp_path / "out")]
    patched = f"""
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job would ignore it
sys.path[:0] = [{str(ROOT)!r}]
import functools
from tests import canned
from soma_bullet.evaluation import evaluate as evaluating
if __name__ == "__main__":
    evaluating.evaluate = functools.partial(evaluating.evaluate, episode=canned.slow)
    from soma_bullet.cli.evaluate import evaluate
    raise SystemExit(evaluate(sys.argv[1:]))
"""
    (tmp_path / "patched.py").write_text(patched)
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "patched.py"), *arguments],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    file = tmp_path / "out" / LINES
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and not (file.is_file() and file.read_text().count("\n") == 3):
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "3 of 6 episodes are done; the same command goes on" in said and "Traceback" not in said
    assert [line["seed"] for line in read_lines(file)] == [0, 1, 2]
    assert {path.name for path in (tmp_path / "out").iterdir()} == {LINES}
    leave(SOMA3, tmp_path / "whole")
    assert evaluate(SOMA3, 1, tmp_path / "out", episode=canned) == evaluate(
        SOMA3, 1, tmp_path / "whole", episode=canned
    )


@pytest.mark.slow
def test_workers_leave_an_interrupt_to_their_parent() -> None:
    """From the first one on, in a process that has started none before."""
    code = f"""
import sys
sys.path[:0] = [{str(ROOT)!r}]
from tests import canned as t
from soma_bullet.evaluation.workers import in_processes
print([line["blocked"] for line in in_processes([0, 1], t.SOMA3, 2, t.masked)])
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True
    )
    assert done.stdout.strip() == "[True, True]"


def test_an_interrupt_while_a_worker_starts_is_not_lost() -> None:
    # whoever started these tests in the background has it ignored
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            with _inherited():
                signal.raise_signal(signal.SIGINT)
                assert signal.SIGINT in signal.sigpending()  # a worker that starts now has it blocked
        assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())
    finally:
        signal.signal(signal.SIGINT, before)


# --- the command --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--episodes", "0"], "--episodes 0: must be at least 1"),
        (["--jobs", "0"], "--jobs 0: must be at least 1"),
        (["--seed", "-1"], "--seed -1: must be from 0 to 2147483647"),
        (["--vary", "fricton"], "--vary fricton: 'fricton' is none of friction, mass, perception, feed"),
        (["--spread.friction", "1"], "--spread.friction 1: must be at least 0 and below 1"),
        (["--spread.mass", "nan"], "--spread.mass nan"),
        (["--spread.deg", "-1"], "--spread.deg -1: must not be negative"),
        (["--tolerance-mm", "0"], "--tolerance-mm 0: must be positive"),
        (["--cell", "no_cell"], "no such cell"),
        (["--hand", "no_hand"], "no such hand"),
        (["--replay", "3"], "has no line of seed 3"),
        (["--backend", "cloud"], "backend"),
        (["--feed.poses", "all"], "feed.poses"),
        (["--feed.noise-mm", "1"], "feed.noise-mm"),
        (["--physics.mass", "0"], "--physics.mass 0: must be above 0 and at most 10"),
        (["--hands", "3"], "--hands: 3: ur5e_pair has 2 arms"),
        (["--film.fps", "5"], "--film.fps 5: only a replay is filmed"),
        (["--replay", "3", "--push", "1"], "--push 1: a replay is run as its line says"),
    ],
)
def test_bad_arguments(
    arguments: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        status = command(["soma3", "--out", str(tmp_path / "out"), *arguments])
    except SystemExit as exit:
        status = exit.code
    written = capsys.readouterr()
    assert status == 2 and said in written.err and written.out == "" and "Traceback" not in written.err
    assert not (tmp_path / "out").exists()


def test_a_whole_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run = lambda *arguments, **options: evaluate(*arguments, **options, episode=canned)  # noqa: E731
    monkeypatch.setattr(evaluating, "evaluate", run)
    assert command(["soma3", "--episodes", "6", "--jobs", "1", "--out", str(tmp_path)]) == 0
    written = capsys.readouterr()
    assert (
        "4 of 6 succeeded, 67%" in written.out
        and "error of a piece [mm]" in written.out
        and "seeds 1, 4" in written.out
    )
    assert "seed 1: jammed: A jammed in place" in written.err and "6/6" in written.err
    assert {path.name for path in tmp_path.iterdir()} == {LINES, SUMMARY, "summary.png"}
    summary = json.loads((tmp_path / SUMMARY).read_text())
    assert summary["interval_95"] == list(wilson(4, 6)) and summary["options"]["--vary"] == "feed"
    image = (tmp_path / "summary.png").read_bytes()
    assert image.startswith(b"\x89PNG") and len(image) > 20_000


# --- in physics ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def two_blocks(tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_two_blocks(tmp_path_factory.mktemp("two"))


@pytest.mark.slow
def test_two_blocks_in_physics_and_once_more(two_blocks: str, tmp_path: Path) -> None:
    """One worker or two: the same lines; and a line is enough to run its episode again, to the last bit."""
    options = EvaluationOptions(two_blocks, 2, vary=("friction", "mass", "perception"))
    one, lines = evaluate(options, 1, tmp_path / "one")
    two, others = evaluate(options, 2, tmp_path / "two")
    assert list(map(without_wall, lines)) == list(map(without_wall, others))
    assert without_wall(one) == without_wall(two)
    assert one["successes"] == 2, one["causes"]
    line = lines[0]
    assert {"execution", "judgement"} <= line["wall_s"].keys() and len(line["log_sha256"]) == 64
    assert line["makespan_s"] > 1.0 and {piece["name"] for piece in line["pieces"]} == {"lower", "upper"}
    assert isinstance(episode_options(1, options), EpisodeOptions)
    again = replay(two_blocks, 1, tmp_path / "one", None)
    assert again.same and (again.folder / "log.npz").is_file()
    tampered = {**lines[1], "log_sha256": "0" * 64}
    (tmp_path / "one" / LINES).write_text(json.dumps(tampered) + "\n")
    with pytest.raises(InputError, match="another assembly"):
        replay("soma3", 1, tmp_path / "one", None)
