"""Evaluations: the draws, the lines, who runs them, going on after an interruption, and the numbers in the
end."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh

from soma_bullet.cli.evaluate import evaluate as command
from soma_bullet.control.options import ExecutionOptions
from soma_bullet.errors import InputError, NoSolutionError
from soma_bullet.evaluation import evaluate as evaluating
from soma_bullet.evaluation import line as running
from soma_bullet.evaluation.evaluate import Watch, evaluate
from soma_bullet.evaluation.folder import LINES, SUMMARY, read_lines, write_lines
from soma_bullet.evaluation.line import (
    EPISODE_PARTS,
    PATIENCE,
    Line,
    blank_line,
    categorise,
    crashed_line,
    options_of,
    run_line,
)
from soma_bullet.evaluation.options import EvaluationOptions, Spread, draw, episode_options
from soma_bullet.evaluation.replay import replay
from soma_bullet.evaluation.statistics import wilson
from soma_bullet.evaluation.summary import summarise
from soma_bullet.evaluation.workers import _inherited
from soma_bullet.options import EpisodeOptions
from soma_bullet.pictures.options import FilmOptions
from soma_bullet.planner.options import HoldLoad, PlannerOptions
from soma_bullet.task.feed_options import FeedOptions
from soma_bullet.task.search_options import SearchOptions
from soma_bullet.verdict.options import Tolerance
from soma_bullet.world.options import Physics

SOMA3 = EvaluationOptions("soma3", 6)
EVERYTHING = ("friction", "mass", "perception", "feed")


# --- episodes that were never run; workers import them from here --------------------------------------------


def canned(seed: int, options: EvaluationOptions) -> Line:
    """Every third episode fails."""
    line = blank_line(seed, options)
    good = seed % 3 != 1
    numbers = np.random.default_rng(seed).random(4).round(4).tolist()
    return line | {
        "success": good,
        "cause": "" if good else "jammed",
        "causes": [] if good else ["A jammed in place"],
        "pieces": [{"name": "A", "error_mm": numbers[0], "error_deg": numbers[1]}],
        "slips": [{"slip_mm": numbers[2], "slip_deg": 0.1}],
        "holds": [],
        "insertions": [{"peak_n": numbers[3]}],
        "forbidden": [],
        "events": [{"time": 1.0, "kind": "jammed", "piece": "A", "text": ""}],
        "retries": 1,
        "recoveries": int(seed == 0),
        "makespan_s": 20.0 + seed,
        "planned_s": {"together": 15.0 + seed, "one at a time": 20.0 + seed, "as scheduled": 30.0 + seed},
        "log_sha256": f"{seed:064x}",
        "wall_s": {"execution": 1.0},
    }


def fragile(seed: int, options: EvaluationOptions) -> Line:
    """The second raises, the fourth takes its process with it."""
    if seed == 1:
        raise ValueError("no such luck")
    if seed == 3:
        os._exit(7)
    return canned(seed, options)


def slow(seed: int, options: EvaluationOptions) -> Line:
    """The later ones do not end."""
    if seed >= 3:
        time.sleep(60)
    return canned(seed, options)


def leave(options: EvaluationOptions, folder: Path) -> list[Line]:
    """What an evaluation leaves when it has run all its episodes, without workers."""
    folder.mkdir(exist_ok=True)
    lines = [canned(seed, options) for seed in options.seeds]
    write_lines(folder / LINES, dict(zip(options.seeds, lines, strict=True)))
    return lines


def without_wall(tree: Any) -> Any:
    """A line or a summary without wall times."""
    return {key: value for key, value in tree.items() if key != "wall_s"}


# --- what varies --------------------------------------------------------------------------------------------


def test_draws_depend_on_the_seed_alone() -> None:
    both = replace(SOMA3, vary=("mass", "friction"))
    assert draw(3, both) == draw(3, both) != draw(4, both)
    assert draw(3, replace(SOMA3, vary=("mass",))) == {"mass": draw(3, both)["mass"]}
    assert draw(3, SOMA3) == {}
    assert draw(3, both)["mass"] != draw(3, both)["friction"]


def test_draws_fill_their_spread() -> None:
    options = replace(SOMA3, vary=("friction",), spread=Spread(friction=0.2))
    drawn = np.array([draw(seed, options)["friction"] for seed in range(400)])
    assert 0.8 <= drawn.min() < 0.81 and 1.19 < drawn.max() <= 1.2
    assert abs(drawn.mean() - 1.0) < 0.02 and abs(drawn.std() - 0.4 / np.sqrt(12)) < 0.01


def test_what_varies_reaches_the_episode() -> None:
    varied = episode_options(5, replace(SOMA3, vary=EVERYTHING, spread=Spread(mm=0.7, deg=0.3)))
    assert (varied.feed.layout, varied.feed.poses, varied.feed.noise_mm, varied.feed.noise_deg) == (
        "random",
        "all",
        0.7,
        0.3,
    )
    assert varied.physics.friction != 1.0 != varied.physics.mass and varied.seed == 5
    plain = episode_options(5, replace(SOMA3, vary=()))
    assert (plain.feed.poses, plain.feed.noise_mm, plain.physics.friction, plain.physics.mass) == (
        "preferred",
        0.0,
        1.0,
        1.0,
    )


def test_options_reach_the_episode_and_come_back_from_its_line() -> None:
    common = EpisodeOptions(
        planner=PlannerOptions(stability="paper", load=HoldLoad(push=1.0)), tolerance=Tolerance(1.0, 3.0),
        ablate="hold", execution=ExecutionOptions(together=False, recover=False),
        physics=Physics(gravity=5.0), search=SearchOptions(orders=3),
    )  # fmt: skip
    options = replace(SOMA3, vary=EVERYTHING, episode=common)
    episode = episode_options(2, options)
    assert (episode.planner.stability, episode.tolerance, episode.ablate) == (
        "paper",
        Tolerance(1.0, 3.0),
        "hold",
    )
    assert (episode.execution.together, episode.execution.compliant, episode.execution.recover) == (
        False,
        True,
        False,
    )
    assert (episode.planner.load.push, episode.physics.gravity, episode.search.orders) == (1.0, 5.0, 3)
    line = json.loads(json.dumps(canned(2, options)))
    assert options_of(line, "here") == episode
    assert {"cell", "hand", "seed", "ablate", *EPISODE_PARTS} == set(line["episode"])
    line["episode"]["physics"]["magic"] = 1
    with pytest.raises(InputError, match="not of this version"):
        options_of(line, "here")


# --- one line -----------------------------------------------------------------------------------------------


def ends_with(monkeypatch: pytest.MonkeyPatch, error: Exception) -> Line:
    def run_episode(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(running, "run_episode", run_episode)
    return run_line(0, SOMA3)


def test_an_episode_without_a_schedule_is_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    line = ends_with(
        monkeypatch, NoSolutionError("schedule", "none of 3 orders", Counter({"A: no grasp": 2}))
    )
    assert (line["success"], line["cause"], line["causes"]) == (
        False,
        "no schedule",
        ["none of 3 orders", "2 x A: no grasp"],
    )


def test_a_crash_is_a_line_that_says_where(monkeypatch: pytest.MonkeyPatch) -> None:
    line = ends_with(monkeypatch, ZeroDivisionError("at last"))
    assert line["cause"] == "crash"
    assert line["causes"][0].startswith("ZeroDivisionError: at last (test_evaluation.py:")


def test_an_episode_that_goes_on_and_on_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    def run_episode(*_: object, progress: Any, **__: object) -> None:
        for _ in range(PATIENCE + 1):
            progress("left: place A", 0.5)

    monkeypatch.setattr(running, "run_episode", run_episode)
    assert (line := run_line(0, SOMA3))["cause"] == "endless" and "left: place A" in line["causes"][0]


@pytest.mark.parametrize(
    ("ended", "cause"),
    [
        ("A jammed in place", "jammed"),
        ("A lost in grasp; none of 3 orders", "lost"),
        ("A, B fell; A: no grasp", "fell"),
        ("A: transfer cannot be made from the measured joints: budget", "no motion"),
        ("something new", "stopped"),
    ],
)
def test_how_the_executive_ended_is_the_cause(ended: str, cause: str) -> None:
    verdict = SimpleNamespace(dropped=("A",), pieces=(), forbidden=())
    assert categorise(verdict, ended) == cause  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("dropped", "in_place", "forbidden", "cause"),
    [
        (("A",), False, (1,), "fell"),
        ((), False, (1,), "not in place"),
        ((), True, (1,), "forbidden contact"),
        ((), True, (), "limits"),
    ],
)
def test_otherwise_it_is_how_the_pieces_lie(
    dropped: tuple, in_place: bool, forbidden: tuple, cause: str
) -> None:
    verdict = SimpleNamespace(
        dropped=dropped, pieces=(SimpleNamespace(in_place=in_place),), forbidden=forbidden
    )
    assert categorise(verdict, "done") == cause  # type: ignore[arg-type]


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


def threads(seed: int, options: EvaluationOptions) -> Line:
    """How many threads a worker is told to use."""
    return canned(seed, options) | {"threads": os.environ["OMP_NUM_THREADS"]}


@pytest.mark.slow
def test_ray_makes_the_same_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ray", reason="ray is an extra: pip install soma_bullet[ray]")
    monkeypatch.setenv(
        "PYTHONPATH", str(Path(__file__).parent)
    )  # its workers import the canned episodes from here
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


def common(**options: Any) -> dict[str, Any]:
    """What all episodes have in common, as a change of the options of an evaluation."""
    return {"episode": EpisodeOptions(**options)}


# --- going on -----------------------------------------------------------------------------------------------


def test_a_run_goes_on_where_it_stopped(tmp_path: Path) -> None:
    leave(SOMA3, tmp_path / "whole")
    whole = evaluate(SOMA3, 1, tmp_path / "whole", episode=canned)
    leave(replace(SOMA3, episodes=3), tmp_path / "parts")
    file = tmp_path / "parts" / LINES
    file.write_text(file.read_text() + file.read_text().splitlines()[0][:200])  # cut off while it was written
    found: list[int] = []
    new: list[int] = []
    watch = Watch(
        lambda lines: found.extend(line["seed"] for line in lines), lambda line: new.append(line["seed"])
    )
    assert evaluate(SOMA3, 1, tmp_path / "parts", watch, episode=canned) == whole
    assert found == [0, 1, 2] and sorted(new) == [3, 4, 5]
    assert file.read_bytes() == (tmp_path / "whole" / LINES).read_bytes()


def test_seeds_beyond_those_asked_for_are_kept(tmp_path: Path) -> None:
    leave(SOMA3, tmp_path)
    summary, lines = evaluate(replace(SOMA3, episodes=2, seed=1), 1, tmp_path, episode=canned)
    assert summary["seeds"] == [1, 2] == [line["seed"] for line in lines]
    assert [line["seed"] for line in read_lines(tmp_path / LINES)] == list(range(6))


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"vary": ("friction", "feed")}, "--vary: feed there, friction,feed here"),
        (common(tolerance=Tolerance(1.0, 2.0)), "--tolerance-mm: 2.0 there, 1.0 here"),
        (common(planner=PlannerOptions(stability="paper")), "--stability: equilibrium there, paper here"),
        (common(ablate="hold"), "--ablate: none there, hold here"),
        (
            common(execution=ExecutionOptions(recover=False)),
            "--execution.recover: True there, False here",
        ),
        (common(feed=FeedOptions(layout="rows")), "--feed.layout: random there, rows here"),
        (common(physics=Physics(asleep=0.0)), "--physics.asleep: 1e-06 there, 0.0 here"),
        ({"assembly": "soma4"}, "assembly: soma3 .* there, soma4 .* here"),
    ],
)
def test_another_evaluation_in_the_same_folder_is_refused(changed: dict, said: str, tmp_path: Path) -> None:
    leave(replace(SOMA3, episodes=1), tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(InputError, match=said):
        evaluate(replace(SOMA3, **changed), 1, tmp_path, episode=canned)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (replace(SOMA3, spread=Spread(mass=0.1)), "--spread.mass: mass does not vary, see --vary"),
        (replace(SOMA3, vary=("luck",)), "--vary luck: 'luck' is none of friction"),
        (replace(SOMA3, **common(feed=FeedOptions(noise_mm=1.0))), "must be left alone"),
        (replace(SOMA3, **common(film=FilmOptions())), "no episode of an evaluation is filmed"),
        (replace(SOMA3, **common(planner=PlannerOptions(stability="luck"))), "'luck' is not known"),
        (replace(SOMA3, seed=2**31 - 6, episodes=7), "--episodes 7: the last seed must be from 0"),
    ],
)
def test_options_that_no_evaluation_could_use(options: EvaluationOptions, said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(said)):
        evaluate(options, 1, tmp_path / "out", episode=canned)
    assert not (tmp_path / "out").exists()


def test_the_order_of_what_varies_does_not_matter() -> None:
    assert (
        replace(SOMA3, vary=("feed", "mass")).conditions()
        == replace(SOMA3, vary=("mass", "feed")).conditions()
    )


def test_lines_of_another_version_are_refused(tmp_path: Path) -> None:
    (line,) = leave(replace(SOMA3, episodes=1), tmp_path)
    line["versions"]["pybullet"] = "1.0"
    (tmp_path / LINES).write_text(json.dumps(line) + "\n")
    with pytest.raises(InputError, match="version of pybullet: 1.0 there"):
        evaluate(SOMA3, 1, tmp_path, episode=canned)
    (tmp_path / LINES).write_text('{"seed": 0, "success": true}\n')
    with pytest.raises(InputError, match="older version"):
        evaluate(SOMA3, 1, tmp_path, episode=canned)


def test_a_folder_that_cannot_be_one(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="--out: .* cannot be written"):
        evaluate(SOMA3, 1, tmp_path / "file", episode=canned)


def test_two_evaluations_do_not_write_into_one_folder(tmp_path: Path) -> None:
    def second(lines: list[Line]) -> None:
        with pytest.raises(InputError, match="another evaluation is writing into"):
            evaluate(SOMA3, 1, tmp_path, episode=canned)

    leave(replace(SOMA3, episodes=1), tmp_path)
    evaluate(replace(SOMA3, episodes=1), 1, tmp_path, Watch(found=second), episode=canned)


@pytest.mark.slow
def test_an_interrupted_run_keeps_what_is_done_and_goes_on(tmp_path: Path) -> None:
    """Ctrl-C goes to the whole process group, as a terminal sends it."""
    arguments = ["soma3", "--episodes", "6", "--jobs", "2", "--out", str(tmp_path / "out")]
    patched = f"""
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job would ignore it
sys.path[:0] = [{str(Path(__file__).parent)!r}]
import functools, test_evaluation
from soma_bullet.evaluation import evaluate as evaluating
if __name__ == "__main__":
    evaluating.evaluate = functools.partial(evaluating.evaluate, episode=test_evaluation.slow)
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


def masked(seed: int, options: EvaluationOptions) -> Line:
    return {"seed": seed, "blocked": signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())}


@pytest.mark.slow
def test_workers_leave_an_interrupt_to_their_parent() -> None:
    """From the first one on, in a process that has started none before."""
    code = f"""
import sys
sys.path[:0] = [{str(Path(__file__).parent)!r}]
import test_evaluation as t
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


# --- the summary --------------------------------------------------------------------------------------------


def test_the_interval_is_wilsons() -> None:
    n, k, z = 20, 17, 1.959964
    p = k / n
    middle, half = (p + z**2 / (2 * n)), z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    assert np.allclose(
        wilson(k, n), [(middle - half) / (1 + z**2 / n), (middle + half) / (1 + z**2 / n)], atol=1e-4
    )
    assert wilson(5, 5)[1] == 1.0 and wilson(0, 5)[0] == 0.0


def test_the_summary_counts() -> None:
    lines = [canned(seed, SOMA3) for seed in SOMA3.seeds]
    lines.append(crashed_line(6, SOMA3, "why"))
    summary = summarise(lines)
    assert (summary["episodes"], summary["successes"]) == (7, 4)
    assert summary["causes"] == {"jammed": 2, "crash": 1} and summary["failed_seeds"] == {
        "crash": [6],
        "jammed": [1, 4],
    }
    assert (summary["recoveries"], summary["retries"], summary["recovered_episodes"]) == (1, 6, 4)
    errors = [line["pieces"][0]["error_mm"] for line in lines[:6]]
    assert summary["executed"]["error_mm"] == pytest.approx(
        {
            "count": 6,
            "mean": np.mean(errors),
            "median": np.median(errors),
            "p95": np.percentile(errors, 95),
            "max": max(errors),
        },
        abs=1e-4,
    )
    assert summary["successful"]["error_mm"]["count"] == 4 and summary["executed"]["drift_mm"] == {"count": 0}
    assert summary["executed"]["makespan_s"]["max"] == 25.0
    assert summary["executed"]["saved_percent"]["max"] == pytest.approx(100 * 5 / 20, abs=1e-3)
    assert summary["executed"]["saved_of_scheduled_percent"]["max"] == pytest.approx(100 * 15 / 30, abs=1e-3)
    json.dumps(summary, allow_nan=False)


def test_a_summary_of_crashes_alone() -> None:
    summary = summarise([crashed_line(0, SOMA3, "why")])
    assert (
        summary["success_rate"] == 0.0
        and summary["wall_s"] == {}
        and summary["executed"]["error_mm"] == {"count": 0}
    )


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


def write_two_blocks(folder: Path) -> str:
    """The file of two blocks, one on the other."""
    trimesh.creation.box((0.03, 0.03, 0.03)).export(folder / "block.stl")
    piece = (
        '[[piece]]\nname = "{}"\nmesh = "block.stl"\ngoal = '
        "{{ position = [0, 0, {}], rpy_deg = [0, 0, 0] }}\n"
    )
    head = (
        'name = "two"\nunit = "m"\n[support]\nheight = 0.0\nfriction = 0.5\n[defaults]\ndensity = 700.0\n'
        "friction = 0.5\n"
    )
    (folder / "two.toml").write_text(head + piece.format("lower", 0.015) + piece.format("upper", 0.045))
    return str(folder / "two.toml")


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
