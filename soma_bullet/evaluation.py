"""How often: seeded episodes in worker processes, one line each, and a summary with its interval.

A run can be interrupted and resumed; its lines and its summary do not depend on the number of workers, nor on who runs them. A
line has all that is needed to run its episode again, and a hash that shows whether it came out the same.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import logging
import multiprocessing
import os
import signal
import tempfile
import threading
import traceback
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, fields, replace
from importlib import util
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Literal

import numpy as np
from cattrs import Converter
from cattrs.errors import BaseValidationError
from scipy.stats import binomtest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.episode import EpisodeOptions, run_episode
from soma_bullet.errors import InputError, NoSolutionError
from soma_bullet.executive import ExecutionOptions
from soma_bullet.planner.qualities import PlannerOptions
from soma_bullet.records import package_versions, read_npz, to_tree
from soma_bullet.report.report import EpisodeReport
from soma_bullet.robot.cell import find_hand, load_cell
from soma_bullet.sim.film import FilmOptions
from soma_bullet.sim.judge import Judgement, Tolerance
from soma_bullet.sim.log import ExecutionLog
from soma_bullet.sim.stage import Physics
from soma_bullet.task.feed import FeedOptions

Line = dict[str, Any]  # what one episode came to, as JSON
Lines = Generator[Line, None, None]
VARIED = ("friction", "mass", "perception", "feed")
LINES, SUMMARY = "episodes.jsonl", "summary.json"
PATIENCE = 20_000  # reports of progress of one episode, after which it is stopped; an ordinary one makes some hundreds
FIXED_VERSIONS = ("soma_bullet", "pybullet")  # lines of different ones are not mixed
DIGITS = 4  # of the numbers in a line
EPISODE_PARTS = {
    "planner": PlannerOptions, "feed": FeedOptions, "execution": ExecutionOptions, "physics": Physics, "tolerance": Tolerance,
}  # fmt: skip
# which causes a text stands for, first match first
CAUSES = (
    (" jammed in ", "jammed"), (" lost in ", "lost"), (" fell", "fell"), ("cannot be made", "no motion"),
    ("no way back", "no motion"),
)  # fmt: skip


@dataclass(frozen=True)
class Spread:
    """By how much what varies does.

    Attributes:
        friction, mass: largest relative deviation of the factor on all friction coefficients, and on all masses; uniform.
        mm, deg: one sigma of the error of the perceived places [mm] and yaws [deg]; of uniform errors the largest.
        errors: how these are spread; square: whether pieces are squared against them. See FeedOptions.
    """

    friction: float = 0.2
    mass: float = 0.2
    mm: float = 0.5
    deg: float = 0.5
    errors: Literal["normal", "uniform"] = "normal"
    square: bool = True


@dataclass(frozen=True)
class EvaluationOptions:
    """What is evaluated.

    Attributes:
        assembly: file or name.
        episodes: how many; their seeds follow on from `seed`.
        seed: of the first episode.
        vary: what differs from episode to episode, of VARIED; without `feed` pieces lie in their preferred resting poses.
        spread: by how much.
        cell, hand, stability, tolerance, execution, ablate: see EpisodeOptions.
    """

    assembly: str
    episodes: int = 20
    seed: int = 0
    vary: tuple[str, ...] = ("feed",)
    spread: Spread = Spread()
    cell: str = "ur5e_pair"
    hand: str | None = None
    stability: str = "equilibrium"
    tolerance: Tolerance = Tolerance()
    execution: ExecutionOptions = ExecutionOptions()
    ablate: str = ""

    @property
    def seeds(self) -> range:
        """Of the episodes."""
        return range(self.seed, self.seed + self.episodes)

    def conditions(self) -> dict[str, Any]:
        """All that a line depends on beside assembly, seed and versions, by the names of the command line."""
        vary = [name for name in VARIED if name in self.vary]
        spread = {f"--spread.{name}": getattr(self.spread, name) for name in ("friction", "mass") if name in vary}
        if "perception" in vary:
            spread |= {f"--spread.{name}": getattr(self.spread, name) for name in ("mm", "deg", "errors", "square")}
        return {
            "--vary": ",".join(vary) or "none",
            **spread,
            "--cell": self.cell,
            "--hand": self.hand,
            "--stability": self.stability,
            "--tolerance-mm": self.tolerance.mm,
            "--tolerance-deg": self.tolerance.deg,
            **{f"--{name}": value for name, value in to_tree(self.execution).items()},
            "--ablate": self.ablate or "none",
        }


Episode = Callable[[int, EvaluationOptions], Line]


@dataclass(frozen=True)
class Watch:
    """Who is told how an evaluation goes on: `found` the lines of an earlier run, `done` every new one."""

    found: Callable[[list[Line]], object] = lambda lines: None
    done: Callable[[Line], object] = lambda line: None


# --- what varies -------------------------------------------------------------------------------------------------------


def draw(seed: int, options: EvaluationOptions) -> dict[str, float]:
    """The factors of one episode; each depends on the seed alone, whatever else varies."""
    drawn = {}
    for key, name in enumerate(("friction", "mass"), 1):
        if name in options.vary:
            spread = getattr(options.spread, name)
            rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(key,)))
            drawn[name] = round(float(rng.uniform(1.0 - spread, 1.0 + spread)), 6)
    return drawn


def episode_options(seed: int, options: EvaluationOptions) -> EpisodeOptions:
    """Everything that decides one episode."""
    drawn, spread = draw(seed, options), options.spread
    feed = FeedOptions(poses="all" if "feed" in options.vary else "preferred")
    if "perception" in options.vary:
        feed = replace(feed, noise_mm=spread.mm, noise_deg=spread.deg, errors=spread.errors, square=spread.square)
    return EpisodeOptions(
        cell=options.cell,
        hand=options.hand,
        seed=seed,
        planner=PlannerOptions(stability=options.stability),
        feed=feed,
        execution=options.execution,
        physics=Physics(friction=drawn.get("friction", 1.0), mass=drawn.get("mass", 1.0)),
        tolerance=options.tolerance,
        ablate=options.ablate,
    )


# --- one episode -------------------------------------------------------------------------------------------------------


class EndlessError(Exception):
    """An episode went on and on."""


class _Patience:
    """Counts reports of progress, not seconds: what becomes of an episode must not depend on the load of the machine."""

    def __init__(self) -> None:
        self.reports = 0

    def __call__(self, what: str, fraction: float) -> None:
        self.reports += 1
        if self.reports > PATIENCE:
            raise EndlessError(f"stopped after {PATIENCE} segments and searches, last: {what}")


def run_line(seed: int, options: EvaluationOptions) -> Line:
    """Run the episode of one seed. Whatever happens, it is a line."""
    return _blank(seed, options) | _outcome(options.assembly, episode_options(seed, options), None)


def _blank(seed: int, options: EvaluationOptions) -> Line:
    versions, episode = package_versions(), episode_options(seed, options)
    return {
        "seed": seed,
        "assembly": options.assembly,
        "digest": load_assembly(options.assembly).digest,
        "options": options.conditions(),
        "drawn": draw(seed, options),
        "versions": {name: versions[name] for name in FIXED_VERSIONS},
        "episode": {part.name: to_tree(getattr(episode, part.name)) for part in fields(episode) if part.name != "film"},
        "success": False,
        "cause": "",
        "causes": [],
    }


def _crashed(seed: int, options: EvaluationOptions, why: str) -> Line:
    return {**_blank(seed, options), "cause": "crash", "causes": [why]}


def _outcome(assembly: str, episode: EpisodeOptions, out: Path | None) -> Line:
    """Run an episode, in a folder or without leaving anything; what came of it."""
    try:
        with tempfile.TemporaryDirectory() as scratch:
            folder = out or Path(scratch)
            report = run_episode(assembly, episode, folder, progress=_Patience())
            assert report is not None
            return _described(report, read_npz(ExecutionLog, folder / "log.npz"))
    except NoSolutionError as error:
        reasons = [f"{count} x {reason}" for reason, count in error.reasons.most_common(12)]
        return {"cause": f"no {error.stage}", "causes": [error.summary, *reasons]}
    except EndlessError as error:
        return {"cause": "endless", "causes": [str(error)]}
    except Exception as error:  # one episode must not end the others
        frame = traceback.extract_tb(error.__traceback__)[-1]
        last = "".join(traceback.format_exception_only(error)).strip().splitlines()[-1]
        return {"cause": "crash", "causes": [f"{last} ({Path(frame.filename).name}:{frame.lineno})"]}


def _described(report: EpisodeReport, log: ExecutionLog) -> Line:
    verdict = report.judgement
    kinds = Counter(event.kind for event in log.events)
    return _rounded(
        {
            "success": report.success,
            "cause": "" if report.success else categorise(verdict, log.ended),
            "causes": verdict.causes,
            "order": report.order,
            "pieces": to_tree(verdict.pieces),
            "slips": to_tree(verdict.slips),
            "holds": to_tree(verdict.holds),
            "insertions": to_tree(verdict.insertions),
            "forbidden": to_tree(verdict.forbidden),
            "dropped": verdict.dropped,
            "limits": to_tree(verdict.limits),
            "events": [to_tree(event) for event in log.events],
            "retries": kinds["jammed"],
            "recoveries": kinds["planned anew"],
            "feed_rejected": report.feed_rejected,
            "makespan_s": report.makespan_s,
            "planned_s": report.planned_s,
            "log_sha256": hashlib.sha256(np.ascontiguousarray(log.poses, "<f8").tobytes()).hexdigest(),
            "wall_s": report.wall_s,
        }
    )


def _rounded(node: Any) -> Any:
    """Plain JSON, its numbers rounded."""
    if isinstance(node, dict):
        return {key: _rounded(child) for key, child in node.items()}
    if isinstance(node, list | tuple):
        return [_rounded(child) for child in node]
    return round(node, DIGITS) if isinstance(node, float) else node


def categorise(verdict: Judgement, ended: str) -> str:
    """The cause of a failure in a word or two; how the executive ended comes before how the pieces lie."""
    if ended != "done":
        return next((cause for text, cause in CAUSES if text in ended), "stopped")
    if verdict.dropped:
        return "fell"
    if not all(piece.in_place for piece in verdict.pieces):
        return "not in place"
    return "forbidden contact" if verdict.forbidden else "limits"


# --- all of them -------------------------------------------------------------------------------------------------------


def evaluate(
    options: EvaluationOptions,
    jobs: int,
    out: Path,
    watch: Watch | None = None,
    backend: Literal["processes", "ray"] = "processes",
    episode: Episode = run_line,
) -> tuple[dict[str, Any], list[Line]]:
    """Run what is missing in `out`/episodes.jsonl, write it in the order of seeds, and write and return summary and lines.

    Args:
        jobs: worker processes.
        watch: who is told of every line.
        backend: who runs the episodes: processes of this machine, or a cluster (or this machine) by ray, where the assembly's
            file must lie at the same place.
        episode: runs one; a function of a module.

    Raises:
        InputError: an option is wrong, or `out` holds another evaluation; nothing has been written then.
    """
    watch = watch or Watch()
    digest = _check(options, backend)
    file = out / LINES
    lines = {line["seed"]: line for line in read_lines(file)}
    _check_lines(lines.values(), options, digest, out)
    _make_folder(out)
    with _alone(out):
        _write_lines(file, lines)  # without what an interruption cut off
        watch.found([lines[seed] for seed in options.seeds if seed in lines])
        missing = [seed for seed in options.seeds if seed not in lines]
        running = (_on_ray if backend == "ray" else _in_processes)(missing, options, jobs, episode)
        with closing(running), file.open("a", encoding="utf-8") as stream:
            for line in running:
                lines[line["seed"]] = line
                stream.write(_text(line))
                stream.flush()
                watch.done(line)
        _write_lines(file, lines)
    chosen = [lines[seed] for seed in options.seeds]
    what = {"assembly": options.assembly, "digest": digest, "options": options.conditions(), "versions": chosen[0]["versions"]}
    summary = {**what, **summarise(chosen)}
    _write_text(out / SUMMARY, json.dumps(summary, indent=1, ensure_ascii=False) + "\n")
    return summary, chosen


@contextmanager
def _alone(out: Path) -> Iterator[None]:
    """Keep a second evaluation out of the folder while the block runs."""
    folder = os.open(out, os.O_RDONLY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError("--out", f"another evaluation is writing into {out}") from None
        yield
    finally:
        os.close(folder)


def _check(options: EvaluationOptions, backend: str) -> str:
    """Refuse bad input before any worker starts; returns the assembly's digest."""
    if backend == "ray" and util.find_spec("ray") is None:
        raise InputError("--backend ray", "ray is not installed; `pip install 'soma_bullet[ray]'` installs it")
    strange = sorted(set(options.vary) - set(VARIED))
    if strange:
        raise InputError("--vary", f"{', '.join(map(repr, strange))}: must be of {', '.join(VARIED)}, or none")
    digest = load_assembly(options.assembly).digest
    load_cell(options.cell)
    if options.hand is not None:
        find_hand(options.hand)
    return digest


def _check_lines(lines: Iterable[Line], options: EvaluationOptions, digest: str, out: Path) -> None:
    """Refuse a folder whose lines were made under other conditions; says which, and both values."""
    here, versions = options.conditions(), package_versions()
    for line in lines:
        there = line.get("options", {})
        if not {"digest", "options", "versions"} <= line.keys():
            raise InputError(str(out / LINES), "was written by an older version of this package; choose another --out")
        faults = []
        if line["digest"] != digest:
            before, now = f"{line['assembly']} ({line['digest'][:12]})", f"{options.assembly} ({digest[:12]})"
            faults.append(f"assembly: {before} there, {now} here")
        faults += [
            f"{name}: {there.get(name, 'not given')} there, {here.get(name, 'not given')} here"
            for name in dict.fromkeys([*here, *there])
            if there.get(name) != here.get(name) and (name in here) is (name in there)
        ]
        faults += [
            f"version of {name}: {line['versions'].get(name)} there, {versions[name]} here"
            for name in FIXED_VERSIONS
            if line["versions"].get(name) != versions[name]
        ]
        if faults:
            raise InputError(str(out), [f"{fault}; choose another --out" for fault in faults])


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise InputError("--out", f"{out} cannot be written: {error.strerror}") from None


def read_lines(file: Path) -> list[Line]:
    """The lines of an evaluation, the later one where a seed has two; what an interruption cut off is left out."""
    if not file.is_file():
        return []
    found: dict[int, Line] = {}
    for text in file.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            line = json.loads(text)
        except json.JSONDecodeError:
            continue
        if isinstance(line, dict) and isinstance(line.get("seed"), int):
            found[line["seed"]] = line
    return [found[seed] for seed in sorted(found)]


def _text(line: Line) -> str:
    return json.dumps(line, ensure_ascii=False) + "\n"


def _write_lines(file: Path, lines: dict[int, Line]) -> None:
    if lines:
        _write_text(file, "".join(_text(lines[seed]) for seed in sorted(lines)))


def _write_text(file: Path, text: str) -> None:
    """Whole or not at all."""
    scratch = file.with_name(f".{file.name}.{os.getpid()}")
    try:
        scratch.write_text(text, encoding="utf-8")
        os.replace(scratch, file)
    finally:
        scratch.unlink(missing_ok=True)


# --- who runs them -----------------------------------------------------------------------------------------------------


def _in_processes(seeds: Sequence[int], options: EvaluationOptions, jobs: int, episode: Episode) -> Lines:
    """Lines as they are ready. A process that dies (not: an exception) costs its own episode alone."""
    waiting, busy = deque(seeds), dict[Connection, tuple[Any, int]]()
    idle: list[tuple[Connection, Any]] = []
    try:
        while waiting or busy:
            while waiting and len(busy) < jobs:
                connection, process = idle.pop() if idle else _new_worker(episode, options)
                seed = waiting.popleft()
                busy[connection] = (process, seed)
                connection.send(seed)
            for ready in wait(list(busy)):
                assert isinstance(ready, Connection)
                process, seed = busy.pop(ready)
                try:
                    line = ready.recv()
                    idle.append((ready, process))
                except (EOFError, OSError):
                    ready.close()
                    process.join()
                    line = _crashed(seed, options, f"its process died ({_exit_reason(process.exitcode)})")
                yield line
    finally:
        for connection, process in [*idle, *((connection, process) for connection, (process, _) in busy.items())]:
            connection.close()
            process.terminate()
            process.join()


def _exit_reason(code: int | None) -> str:
    if code is not None and code < 0:
        return signal.Signals(-code).name
    return f"exit status {code}"


def _new_worker(episode: Episode, options: EvaluationOptions) -> tuple[Connection, Any]:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs, episode, options), daemon=True)
    with _inherited():
        process.start()
    theirs.close()
    return ours, process


@contextmanager
def _inherited() -> Iterator[None]:
    """What a new process takes over: one thread for linear algebra, and that Ctrl-C is for its parent to deal with."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    main = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN) if main else None
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        if main:
            signal.signal(signal.SIGINT, handler)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _work(connection: Connection, episode: Episode, options: EvaluationOptions) -> None:
    """A worker: seeds in, lines out, until the other end is closed."""
    while True:
        try:
            seed = connection.recv()
            connection.send(_guarded(seed, options, episode))
        except (EOFError, OSError):
            return


def _guarded(seed: int, options: EvaluationOptions, episode: Episode) -> Line:
    try:
        return episode(seed, options)
    except Exception as error:
        return _crashed(seed, options, f"{type(error).__name__}: {error}")


def _on_ray(seeds: Sequence[int], options: EvaluationOptions, jobs: int, episode: Episode) -> Lines:
    """The same as tasks of ray: on the cluster that RAY_ADDRESS names, else on this machine."""
    if not seeds:
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    import ray

    address = os.environ.get("RAY_ADDRESS")
    local: dict[str, Any] = {} if address else {"num_cpus": jobs, "object_store_memory": 100 * 2**20}
    ray.init(address=address or "local", include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR, **local)
    try:
        remote = ray.remote(max_retries=0, num_cpus=1)(_guarded)
        waiting, busy = deque(seeds), dict[Any, int]()
        while waiting or busy:
            while waiting and len(busy) < jobs:
                seed = waiting.popleft()
                busy[remote.remote(seed, options, episode)] = seed
            (ready, *_), _ = ray.wait(list(busy), num_returns=1)
            seed = busy.pop(ready)
            try:
                line = ray.get(ready)
            except ray.exceptions.RayError as error:
                line = _crashed(seed, options, f"its process died ({type(error).__name__})")
            yield line
    finally:
        ray.shutdown()


# --- the summary -------------------------------------------------------------------------------------------------------


def wilson(successes: int, count: int) -> tuple[float, float]:
    """95 % interval of a success rate (E. Wilson, 1927)."""
    interval = binomtest(successes, count).proportion_ci(0.95, method="wilson")
    return round(float(interval.low), DIGITS), round(float(interval.high), DIGITS)


# name in the summary: list in a line, key of its members
MEASURED = {
    "error_mm": ("pieces", "error_mm"),
    "error_deg": ("pieces", "error_deg"),
    "slip_mm": ("slips", "slip_mm"),
    "slip_deg": ("slips", "slip_deg"),
    "drift_mm": ("holds", "drift_mm"),
    "grip_n": ("holds", "grip_n"),
    "peak_n": ("insertions", "peak_n"),
}


def summarise(lines: Sequence[Line]) -> dict[str, Any]:
    """Success rate with its 95 % Wilson interval, causes of failure, and how every number is spread.

    Numbers are over all that was executed, and again over successes alone.
    """
    good = [line for line in lines if line["success"]]
    bad = [line for line in lines if not line["success"]]
    causes = Counter(line["cause"] for line in bad)
    events = Counter(event["kind"] for line in lines for event in line.get("events", ()))
    return {
        "episodes": len(lines),
        "successes": len(good),
        "success_rate": round(len(good) / len(lines), DIGITS),
        "interval_95": wilson(len(good), len(lines)),
        "causes": dict(sorted(causes.items(), key=lambda item: (-item[1], item[0]))),
        "failed_seeds": {cause: [line["seed"] for line in bad if line["cause"] == cause] for cause in sorted(causes)},
        "seeds": [line["seed"] for line in lines],
        "recoveries": sum(line.get("recoveries", 0) for line in lines),
        "retries": sum(line.get("retries", 0) for line in lines),
        "recovered_episodes": sum(line.get("recoveries", 0) + line.get("retries", 0) > 0 for line in good),
        "events": dict(sorted(events.items())),
        "forbidden_contacts_in_successes": sum(len(line["forbidden"]) for line in good),
        "executed": _numbers(lines),
        "successful": _numbers(good),
        "wall_s": _walls(lines),
    }


def _numbers(lines: Sequence[Line]) -> dict[str, Any]:
    spreads = {
        name: _spread([member[key] for line in lines for member in line.get(group, ())])
        for name, (group, key) in MEASURED.items()
    }
    planned = [line["planned_s"] for line in lines if "together" in line.get("planned_s", ())]
    saved = [100.0 * (1.0 - times["together"] / times["one at a time"]) for times in planned]
    makespans = [line["makespan_s"] for line in lines if "makespan_s" in line]
    return {**spreads, "makespan_s": _spread(makespans), "saved_percent": _spread(saved)}


def _walls(lines: Sequence[Line]) -> dict[str, Any]:
    walls = [line["wall_s"] for line in lines if "wall_s" in line]
    stages = dict.fromkeys(stage for wall in walls for stage in wall)
    return {stage: _spread([wall[stage] for wall in walls if stage in wall]) for stage in stages}


def _spread(values: Sequence[float]) -> dict[str, float]:
    if not values:
        return {"count": 0}
    median, p95 = np.percentile(values, [50, 95])
    mean, largest = float(np.mean(values)), float(max(values))
    return _rounded({"count": len(values), "mean": mean, "median": float(median), "p95": float(p95), "max": largest})


# --- once more ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Replay:
    """An episode that was run again: the line of then, that of now, and where its files are."""

    before: Line
    after: Line
    folder: Path

    @property
    def same(self) -> bool:
        """Whether every pose of every piece was the same; where nothing was executed, whether it ended alike."""
        keys = ("log_sha256", "success", "cause")
        return all(self.before.get(key) == self.after.get(key) for key in keys)


def replay(assembly: str, seed: int, out: Path, film: FilmOptions | None) -> Replay:
    """Run the episode of one line of `out`/episodes.jsonl again, under that line's conditions, into `out`/replay_SEED.

    Raises:
        InputError: there is no such line, or it was made of another assembly.
    """
    line = next((line for line in read_lines(out / LINES) if line["seed"] == seed), None)
    if line is None:
        raise InputError("--replay", f"{out / LINES} has no line of seed {seed}")
    digest = load_assembly(assembly).digest
    if line.get("digest") != digest:
        raise InputError("--replay", f"that line was made of another assembly: {line.get('assembly')}, not {assembly}")
    episode, folder = options_of(line, str(out / LINES)), out / f"replay_{seed}"
    _make_folder(folder)
    for name in ("log.npz", "program.npz", "plan.json", "report.json", "episode.mp4", "still.png"):
        (folder / name).unlink(missing_ok=True)  # of an earlier replay
    (after,) = _in_processes([seed], EvaluationOptions(assembly), 1, _Again(episode, folder))
    if film is not None and "log_sha256" in after:
        run_episode(assembly, replace(episode, film=film), folder, folder / "log.npz")
    return Replay(line, after, folder)


@dataclass(frozen=True)
class _Again:
    """Runs one episode as it was, and leaves its files in a folder."""

    episode: EpisodeOptions
    folder: Path

    def __call__(self, seed: int, options: EvaluationOptions) -> Line:
        return {"seed": seed, "success": False} | _outcome(options.assembly, self.episode, self.folder)


def options_of(line: Line, source: str) -> EpisodeOptions:
    """The options of an episode from its line. Raises InputError."""
    converter, tree = Converter(forbid_extra_keys=True), dict(line.get("episode", {}))
    try:
        parts: dict[str, Any] = {name: converter.structure(tree.pop(name), kind) for name, kind in EPISODE_PARTS.items()}
        return EpisodeOptions(**tree, **parts)
    except (BaseValidationError, KeyError, TypeError, ValueError) as error:
        fault = f"the options of seed {line['seed']} are not of this version of the package: {error}"
        raise InputError(source, fault) from None
