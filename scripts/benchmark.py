"""Timings: the stages of an episode, the planner and the motions against their targets, physics, all 240 Soma
cubes."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

if TYPE_CHECKING:
    from soma_bullet.grasp.hand_set import HandSet

CELL = "ur5e_pair"
GRASPS = 1000


@dataclass(frozen=True)
class Stages:
    """Times the stages of an episode over seeds. Wall times of this machine: compare ratios within one
    run."""

    assembly: tyro.conf.Positional[str] = "soma3"
    """An assembly file, or the name of one that comes with the package."""
    cell: str = CELL
    """A cell, as for run_episode.py."""
    seeds: int = 5
    """How many seeds, from 0 on."""
    stages: Literal["planning", "all"] = "all"
    """planning leaves out the simulation and the judgement."""
    out: Path = Path("runs/benchmark.json")
    """Where the figures are written."""


@dataclass(frozen=True)
class Planner:
    """Times the planner against its targets, and says where the time goes: Markdown on stdout."""

    runs: int = 5
    """How often each job is done, afresh each time; the median is printed. Where the time goes is measured
    once more."""


@dataclass(frozen=True)
class Cube240:
    """Plans the 240 Soma cubes, and looks for orders without any hold whichever side is down: Markdown on
    stdout."""

    plans: int = 240
    """How many of them are planned in full, drawn by the seed."""
    turned: int = 240
    """How many are turned, drawn by the seed."""
    orientations: Literal[6, 24] = 6
    """6: each side down; 24: and turned about the vertical, which should change nothing."""
    grasps: bool = True
    """Whether turned cubes are also asked for an order without holds whose pieces the hand can grip."""
    seed: int = 0
    """Of the draws."""
    jobs: int = 1
    """Worker processes; all but the times is the same for any number."""
    out: Path = Path("runs/cube240.json")
    """Where the figures of every cube are written."""


@dataclass(frozen=True)
class Motion:
    """Times the motions around obstacles of real programs, against targets and, on the very same queries,
    against the birrt of the package pybullet-planning with its collision function in PyBullet: Markdown on
    stdout."""

    assemblies: tuple[str, ...] = ("soma3", "soma4", "cube")
    """Assembly files, or names of ones that come with the package."""
    seeds: int = 3
    """How many feeds of each, from seed 0 on."""
    poses: Literal["all", "preferred"] = "preferred"
    """Resting poses of the feed."""
    birrt: bool = True
    """--no-birrt leaves out the comparison, which takes most of the time."""
    resolution: float = 0.02
    """Joint step between checked states of birrt [rad]. Ours checks every 0.02; the default of that package
    is 0.05."""
    cell: str = CELL
    """A cell, as for run_episode.py."""
    out: Path = Path("runs/benchmark_motion.json")
    """Where the figures of every query are written."""


@dataclass(frozen=True)
class Simulate:
    """How fast physics runs: simulated seconds in a second, with pieces in the hands and without."""

    assembly: tyro.conf.Positional[str] = "soma3"
    """An assembly file, or the name of one that comes with the package."""
    cell: str = CELL
    """A cell, as for run_episode.py."""
    seed: int = 0
    """Of the feed."""
    poses: Literal["all", "preferred"] = "preferred"
    """Resting poses of the feed."""


@dataclass(frozen=True)
class Episode:
    """Wall time of whole episodes by stage."""

    assembly: tyro.conf.Positional[str] = "soma3"
    """An assembly file, or the name of one that comes with the package."""
    cell: str = CELL
    """A cell, as for run_episode.py."""
    seeds: int = 3
    """How many episodes, from seed 0 on."""
    poses: Literal["all", "preferred"] = "all"
    """Resting poses of the feed."""


class Stopwatch:
    """Collects seconds by name: wall, and of this process alone."""

    def __init__(self) -> None:
        self.seconds: dict[str, list[float]] = defaultdict(list)
        self.cpu: dict[str, list[float]] = defaultdict(list)

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        start, cpu = time.perf_counter(), time.process_time()
        yield
        self.seconds[name].append(time.perf_counter() - start)
        self.cpu[name].append(time.process_time() - cpu)


def main(arguments: Stages | Planner | Cube240 | Motion | Simulate | Episode) -> int:
    """Run a benchmark. Returns the exit status."""
    from soma_bullet.errors import InputError, SomaBulletError

    try:
        if isinstance(arguments, Stages):
            stages(arguments, lambda text: sys.stderr.write(text + "\n"))
        elif isinstance(arguments, Planner):
            if arguments.runs < 1:
                raise InputError("arguments", f"--runs {arguments.runs}: must be at least 1")
            planner(arguments.runs)
        elif isinstance(arguments, Motion):
            motion(arguments, lambda text: sys.stderr.write(text + "\n"))
        elif isinstance(arguments, Simulate):
            simulate(arguments)
        elif isinstance(arguments, Episode):
            episode(arguments, lambda text: sys.stderr.write(text + "\n"))
        else:
            if not (0 <= arguments.plans <= 240 and 0 <= arguments.turned <= 240 and arguments.jobs >= 1):
                raise InputError(
                    "arguments", "--plans and --turned must be from 0 to 240, and --jobs at least 1"
                )
            cube240(arguments)
    except SomaBulletError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_status
    return 0


# --- stages of an episode -----------------------------------------------------------------------------------


def stages(arguments: Stages, say: Callable[[str], object]) -> None:
    """Prints the figures of every stage, and writes them."""
    figures = run(arguments, say)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    width = max(map(len, figures["stages"]))
    sys.stdout.write(f"{'stage':<{width}}  {'median':>10}  {'p95':>10}  runs\n")
    for name, row in figures["stages"].items():
        sys.stdout.write(
            f"{name:<{width}}  {row['median_s']:>8.3f} s  {row['p95_s']:>8.3f} s  {row['runs']:>4}\n"
        )


def run(arguments: Stages, say: Callable[[str], object]) -> dict[str, Any]:
    """Figures of every stage: median and 95th percentile [s]."""
    import numpy as np

    from soma_bullet.assembly.file import load_assembly
    from soma_bullet.episode import EpisodeOptions, execute
    from soma_bullet.judge.judge import judge
    from soma_bullet.planner.plan import make_plan
    from soma_bullet.planner.qualities import PlannerOptions, Qualities
    from soma_bullet.records import package_versions
    from soma_bullet.robot.cell import load_cell
    from soma_bullet.task.builder import ProgramBuilder
    from soma_bullet.task.feed import draw_feed
    from soma_bullet.task.program import make_program
    from soma_bullet.task.schedule import Scheduler
    from soma_bullet.task.segments import MOTIONS
    from soma_bullet.task.workcell import Workcell

    watch = Stopwatch()
    for seed in range(arguments.seeds):
        say(f"seed {seed}")
        with watch.measure("load assembly and cell"):
            assembly, cell = load_assembly(arguments.assembly), load_cell(arguments.cell)
        hands = cell.hands
        with watch.measure("contacts"):
            _ = assembly.contacts
        with watch.measure("grasps of all pieces"):
            qualities = Qualities(assembly, hands, PlannerOptions())
            for k in range(len(assembly.pieces)):
                qualities.grasps(k)
        with watch.measure("plan, equilibrium mode"):
            plan = make_plan(assembly, hands, PlannerOptions(seed=seed))
        with watch.measure("plan, paper mode"):
            make_plan(assembly, hands, PlannerOptions(stability="paper", seed=seed))
        with watch.measure("robot and collision model"):
            workcell = Workcell(assembly, cell)
        with watch.measure("feed"):
            feed = draw_feed(assembly, plan, cell, seed)
        with watch.measure("schedule"):
            schedule = Scheduler(workcell, plan, feed).find()
        with watch.measure("motions of that schedule"):
            segments = [segment for _, segment, _ in ProgramBuilder(workcell, feed, schedule, seed).run()]
        motions = sum(segment.kind in MOTIONS for segment in segments)
        watch.seconds["one motion"].append(watch.seconds["motions of that schedule"][-1] / motions)
        with watch.measure("schedule and motions, with failures"):
            program = make_program(workcell, plan, feed, seed)
        if arguments.stages == "planning":
            continue
        with watch.measure("execution"):
            log = execute(
                assembly, workcell, plan, program, EpisodeOptions(seed=seed), lambda what, fraction: None
            )
        watch.seconds["execution, a simulated second"].append(
            watch.seconds["execution"][-1] / float(log.times[-1])
        )
        with watch.measure("judgement"):
            judge(log, assembly, cell, EpisodeOptions().tolerance)
    figures = {
        name: {"median_s": float(np.median(s)), "p95_s": float(np.percentile(s, 95)), "runs": len(s)}
        for name, s in watch.seconds.items()
    }
    return {
        "assembly": assembly.name,
        "cell": cell.name,
        "seeds": arguments.seeds,
        "stages": figures,
        "versions": package_versions(),
    }


# --- the planner against its targets ------------------------------------------------------------------------

# name: target, factor and unit that it is printed in
TARGETS = {
    "soma3, equilibrium": (1.0, 1.0, "s"),
    "soma3, paper": (1.0, 1.0, "s"),
    "soma4, equilibrium": (2.0, 1.0, "s"),
    "soma4, paper": (2.0, 1.0, "s"),
    "cube, all 5,040 orders, equilibrium": (8.0, 1.0, "s"),
    "cube, all 5,040 orders, paper": (8.0, 1.0, "s"),
    "contacts of 7 meshes": (0.150, 1e3, "ms"),
    "equilibrium of one of the cube's 127 subsets": (0.010, 1e3, "ms"),
    "1,000 grasps against 7 pieces": (0.040, 1e3, "ms"),
}
MEMORY = 1000.0  # [MB]
PLANNED = tuple((name, mode) for name in ("soma3", "soma4", "cube") for mode in ("equilibrium", "paper"))


def planner(runs: int) -> None:
    """Prints times against targets, and where the time goes."""
    watch, shares = Stopwatch(), {}
    _bench_plan("soma3", "paper", Stopwatch())  # imports, and tables that are built once
    for _ in range(runs):
        for key in PLANNED:
            _bench_plan(*key, watch)
        _bench_parts(watch)
    for key in PLANNED:
        with _clocks() as shares[key]:
            _bench_plan(*key, Stopwatch())
    lines = ["| job | target | wall, median | CPU, median | met |", "|-|-|-|-|-|"]
    for job, (target, factor, unit) in TARGETS.items():
        wall, cpu = statistics.median(watch.seconds[job]), statistics.median(watch.cpu[job])
        values = " | ".join(f"{value * factor:.3g} {unit}" for value in (target, wall, cpu))
        lines.append(f"| {job} | < {values} | {_met(wall, cpu, target)} |")
    peak = _peak_memory()
    lines.append(
        f"| peak memory of the cube's plan | < {MEMORY:.0f} MB | {peak:.0f} MB | | "
        f"{_met(peak, peak, MEMORY)} |"
    )
    lines += [
        "",
        "| share of the CPU time | " + " | ".join(f"{name}, {mode}" for name, mode in PLANNED) + " |",
    ]
    lines.append("|-" * (len(PLANNED) + 1) + "|")
    for label in (*_timed(), "search and rows"):
        lines.append(
            f"| {label} | " + " | ".join(f"{_share(shares[key], label):.0%}" for key in PLANNED) + " |"
        )
    lines.append("| all | " + " | ".join(f"{sum(shares[key].values()):.2f} s" for key in PLANNED) + " |")
    sys.stdout.write("\n".join(lines) + "\n")


def _met(wall: float, cpu: float, target: float) -> str:
    return "yes" if wall < target else "by CPU time" if cpu < target else "no"


def _share(seconds: dict[str, float], label: str) -> float:
    return seconds.get(label, 0.0) / sum(seconds.values())


def _timed() -> dict[str, list[tuple[Any, str]]]:
    """Functions of the planner by the analyzer that they belong to: what they call counts for it unless it is
    listed too."""
    from soma_bullet.planner import plan
    from soma_bullet.planner.qualities import Qualities

    return {
        "stability programs": [(Qualities, "stability")],
        "hulls of paper mode": [(Qualities, "paper_stability")],
        "sampling of grasps": [(Qualities, "grasps")],
        "grasps clear of pieces": [
            (Qualities, name) for name in ("accessible", "candidates", "_clear_of_way")
        ],
        "hand against hand": [(Qualities, name) for name in ("assisting", "can_assist", "together")],
        "ways in": [(Qualities, "assemblability")],
        "certificates of holds": [(plan, "certify_hold")],
    }


@contextmanager
def _clocks() -> Iterator[dict[str, float]]:
    """Seconds of CPU by label while the block runs; what no label claims is `search and rows`."""
    seconds, running = defaultdict(float), ["search and rows"]
    last = time.process_time()

    def switch() -> None:
        nonlocal last
        now = time.process_time()
        seconds[running[-1]] += now - last
        last = now

    def clocked(function: Callable[..., Any], label: str) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            switch()
            running.append(label)
            try:
                return function(*arguments, **options)
            finally:
                switch()
                running.pop()

        return call

    originals = [
        (owner, name, getattr(owner, name), label)
        for label, group in _timed().items()
        for owner, name in group
    ]
    for owner, name, function, label in originals:
        setattr(owner, name, clocked(function, label))
    try:
        yield seconds
        switch()
    finally:
        for owner, name, function, _ in originals:
            setattr(owner, name, function)


def _bench_plan(name: str, mode: str, watch: Stopwatch) -> None:
    """Plans an assembly, loaded afresh."""
    from soma_bullet.assembly.file import load_assembly
    from soma_bullet.planner.plan import make_plan
    from soma_bullet.planner.qualities import PlannerOptions

    assembly, hands = load_assembly(name), _hands()  # to load it is to look at its contacts
    with watch.measure(f"{name}, all 5,040 orders, {mode}" if name == "cube" else f"{name}, {mode}"):
        make_plan(assembly, hands, PlannerOptions(stability=mode))


def _bench_parts(watch: Stopwatch) -> None:
    """The cube's contacts, the stability of its subsets, and 1,000 grasps against its pieces."""
    from itertools import combinations

    import numpy as np

    from soma_bullet.assembly.file import load_assembly
    from soma_bullet.grasp.clearance import clear_of_scene, sweep_hand
    from soma_bullet.planner.qualities import PlannerOptions, Qualities

    loaded = load_assembly("cube")
    # loading has looked at the contacts already: bodies and assembly without what they remember
    cube = replace(loaded, pieces=tuple(replace(piece) for piece in loaded.pieces))
    with watch.measure("contacts of 7 meshes"):
        _ = cube.contacts
    qualities, every = Qualities(cube, _hands(), PlannerOptions()), range(len(cube.pieces))
    for size in range(1, len(cube.pieces) + 1):
        for placed in map(frozenset, combinations(every, size)):
            with watch.measure("equilibrium of one of the cube's 127 subsets"):
                qualities.stability(placed)
    grasps = [qualities.grasps(k) for k in every]
    poses = np.vstack([cube.goals[k] @ grasps[k].Ts_piece_tcp for k in every])[:GRASPS]
    widths = np.concatenate([grasps[k].widths for k in every])[:GRASPS]
    assert len(poses) == GRASPS
    hand = _hands().kinds[0]
    with watch.measure("1,000 grasps against 7 pieces"):
        sweep = sweep_hand(hand, poses, widths)
        for parts in cube.goal_parts:
            clear_of_scene(sweep, parts, None)


@cache
def _hands() -> HandSet:
    from soma_bullet.robot.cell import load_cell

    return load_cell(CELL).hands


def _peak_memory() -> float:
    """Largest resident size [MB] of a process of its own that plans the cube."""
    code = (
        "import resource; from soma_bullet.assembly.file import load_assembly; from "
        "soma_bullet.planner.plan import make_plan; "
        f"from soma_bullet.robot.cell import load_cell; make_plan(load_assembly('cube'), "
        f"load_cell('{CELL}').hands); "
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    return float(done.stdout) * 1024 / 1e6


# --- motions against targets and against birrt --------------------------------------------------------------

CHAIN_MEDIAN, CHAIN_P95, FASTER = 0.025, 0.080, 15.0  # [s], [s], times
AROUND = ("transit", "transfer", "home")  # motions that go around obstacles
PARTS = ("inverse kinematics", "line traced", "plan and shortcuts", "blend", "timing", "checked again")


@dataclass(frozen=True, eq=False)
class Query:
    """One motion around obstacles of a program.

    Attributes:
        name: assembly, seed, and what the segment is.
        seed: of the planner.
        context: where pieces and hands are; segment: the motion that the program has for it.
        line: travel of the hand (3,) [m] of the line that follows with the same arm; None where none does.
        widths: of the hand, at each of which the way must be free [m].
    """

    name: str
    seed: int
    context: Any
    segment: Any
    line: Any
    widths: Any


@dataclass
class Timed:
    """What one query took: CPU and wall time [s], CPU time by part, and whether it was solved."""

    name: str
    kind: str
    solved: bool
    cpu: float
    wall: float
    parts: dict[str, float]
    birrt_solved: bool | None = None
    birrt_cpu: float = 0.0
    birrt_wall: float = 0.0
    birrt_note: str = ""


def motion(arguments: Motion, say: Callable[[str], object]) -> None:
    """Prints times against targets, and writes the figures of every query."""
    from dataclasses import asdict
    from importlib import metadata, util

    from soma_bullet.assembly.file import load_assembly
    from soma_bullet.errors import InputError
    from soma_bullet.records import package_versions
    from soma_bullet.robot.cell import load_cell
    from soma_bullet.task.workcell import Workcell

    if arguments.seeds < 1:
        raise InputError("arguments", f"--seeds {arguments.seeds}: must be at least 1")
    if not 0 < arguments.resolution <= 1:
        raise InputError("arguments", f"--resolution {arguments.resolution:g}: must be above 0 and at most 1")
    if arguments.birrt and util.find_spec("pybullet_planning") is None:
        advice = "pip install 'soma_bullet[benchmark]' installs it, --no-birrt does without"
        raise InputError("--birrt", f"the package pybullet-planning is not installed: {advice}")
    cell = load_cell(arguments.cell)
    figures: list[Timed] = []
    for name in arguments.assemblies:
        workcell = Workcell(load_assembly(name), cell)
        for seed in range(arguments.seeds):
            queries = _queries(name, workcell, seed, arguments.poses)
            say(f"{name}, seed {seed}: {len(queries)} motions")
            if not figures and queries:
                _time_chain(workcell, queries[0])  # imports, and tables that are built once
            timed = [_time_chain(workcell, query) for query in queries]
            if arguments.birrt and queries:
                with _BirrtWorld(workcell, arguments.resolution) as world:
                    for query, row in zip(queries, timed, strict=True):
                        world.time(query, row)
            figures += timed
    if not figures:
        raise InputError("arguments", "no program was found for any of the feeds")
    versions = package_versions() | (
        {"pybullet-planning": metadata.version("pybullet-planning")} if arguments.birrt else {}
    )
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    tree = {"queries": [asdict(row) for row in figures], "versions": versions}
    arguments.out.write_text(json.dumps(tree, indent=1) + "\n", encoding="utf-8")
    sys.stdout.write(motion_table(figures))


def _queries(name: str, workcell: Any, seed: int, poses: str) -> list[Query]:
    """The motions around obstacles of one program; none where there is no program."""
    import numpy as np

    from soma_bullet.errors import NoSolutionError
    from soma_bullet.planner.qualities import PlannerOptions
    from soma_bullet.planner.store import kept_plan
    from soma_bullet.task.feed import FeedOptions, draw_feed
    from soma_bullet.task.motions import widths_between
    from soma_bullet.task.program import make_program
    from soma_bullet.task.segments import SPEEDS, contexts

    cell = workcell.cell
    plan = kept_plan(workcell.assembly, cell.hands, PlannerOptions(seed=seed))
    try:
        feed = draw_feed(workcell.assembly, plan, cell, seed, FeedOptions(poses=poses))  # type: ignore[arg-type]
        program = make_program(workcell, plan, feed, seed)
    except NoSolutionError as error:
        sys.stderr.write(f"{name}, seed {seed}: {error.summary}\n")
        return []
    rows, queries = list(contexts(workcell, program)), []
    for k, (context, segment, _) in enumerate(rows):
        if segment.kind not in AROUND:
            continue
        following = next((later for _, later, _ in rows[k + 1 :] if later.arm == segment.arm), None)
        line = following.offset if following is not None and following.kind in SPEEDS else None
        now = float(context.hands.openings[segment.arm])
        widths = widths_between(now, now if np.isnan(segment.opening) else segment.opening)
        label = f"{name}, seed {seed}: {segment.kind} {segment.piece} {cell.arms[segment.arm].name}"
        queries.append(Query(label, seed + 1000 * (k + 1), context, segment, line, widths))
    return queries


def _time_chain(workcell: Any, query: Query) -> Timed:
    """From the pose of the hand at the goal to the timed motion, checked again; the scene is there
    already."""
    import numpy as np

    from soma_bullet.motion.line import LineError, line_back
    from soma_bullet.motion.timing import TimingError
    from soma_bullet.motion.transfer import TransferError
    from soma_bullet.task import motions
    from soma_bullet.task.builder import scene_of

    robot, segment, context = workcell.robot, query.segment, query.context
    arm, start, goal = segment.arm, context.hands.qs[segment.arm], segment.path[-1]
    scene = scene_of(workcell, context, arm)
    width = float(query.widths.max())
    free = lambda q: scene.collides(workcell.configuration(context.hands, arm, q, width))  # noqa: E731
    scene.collides(
        workcell.configuration(context.hands, arm, start, width)
    )  # the broad phase is built with the scene
    seconds: dict[str, float] = dict.fromkeys(PARTS, 0.0)
    hooks = {
        "plan_transfer": "plan and shortcuts",
        "blend_corners": "blend",
        "time_path": "timing",
        "check": "checked again",
    }
    wall, cpu = time.perf_counter(), time.process_time()
    pose = robot.tcp(arm, goal)
    robot.inverse(arm, pose, start)
    seconds["inverse kinematics"] = time.process_time() - cpu
    if query.line is not None:
        length = float(np.linalg.norm(query.line))
        mark = time.process_time()
        # at a goal that a line starts from, what it touches at its far end is not of this scene: free all the
        # way or not
        with suppress(LineError):
            line_back(robot, arm, goal, pose, query.line / length, length, free)
        seconds["line traced"] = time.process_time() - mark
    with _hooked(motions, hooks, seconds):
        try:
            found = motions.plan_motion(
                workcell, scene, context.hands, arm, start, goal, query.widths, query.seed
            )
        except (TransferError, TimingError):
            found = None
    return Timed(
        query.name,
        segment.kind,
        found is not None,
        time.process_time() - cpu,
        time.perf_counter() - wall,
        seconds,
    )


@contextmanager
def _hooked(module: Any, hooks: dict[str, str], seconds: dict[str, float]) -> Iterator[None]:
    """CPU time of functions of a module, by label, while the block runs."""
    originals = {name: getattr(module, name) for name in hooks}

    def timed(function: Callable[..., Any], label: str) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            start = time.process_time()
            try:
                return function(*arguments, **options)
            finally:
                seconds[label] += time.process_time() - start

        return call

    for name, label in hooks.items():
        setattr(module, name, timed(originals[name], label))
    try:
        yield
    finally:
        for name, function in originals.items():
            setattr(module, name, function)


class _BirrtWorld:
    """The cell in PyBullet, for pybullet-planning: it takes the first client, which it expects to be its own.

    Each arm is a body; the other arm, table, stand and pieces are obstacles. Pairs that may touch are left
    out as in the scenes of ours: a hand and the piece that it carries, pieces that meet in the assembly, and
    the cell's `never_checked`."""

    def __init__(self, workcell: Any, resolution: float):
        import numpy as np

        from soma_bullet.bullet.stage import Physics, Stage

        self.workcell, self.resolution = workcell, resolution
        names = workcell.assembly.names
        poses = {name: np.eye(4) for name in names}
        # with all frames, as it would load the URDF; without them it takes 0.6 of the time
        self.stage = Stage(
            workcell.cell,
            workcell.assembly,
            workcell.robot.stand_size,
            poses,
            np.array(workcell.robot.home),
            Physics(),
            frames=True,
        )
        assert self.stage.client == 0, "another client is open"

    def __enter__(self) -> _BirrtWorld:
        return self

    def __exit__(self, *_: object) -> None:
        self.stage.close()

    def time(self, query: Query, row: Timed) -> None:
        """Solve the query with birrt, ends checked first, all but the resolution as it is by default."""
        import random

        import numpy as np
        from pybullet_planning import birrt, get_distance_fn, get_extend_fn, get_sample_fn

        stage, arm = self.stage, query.segment.arm
        body, joints = stage.robots[arm], stage.arm_joints[arm]
        blocked = self._lay_out(query)
        start = [float(v) for v in query.context.hands.qs[arm]]
        goal = [float(v) for v in query.segment.path[-1]]
        random.seed(query.seed)
        np.random.seed(query.seed % 2**32)  # noqa: NPY002 (it is what that package draws from)
        steps = np.full(len(joints), self.resolution)
        tools = (
            get_distance_fn(body, joints),
            get_sample_fn(body, joints),
            get_extend_fn(body, joints, resolutions=steps),
        )
        wall, cpu = time.perf_counter(), time.process_time()
        ends = {"start": blocked(start), "goal": blocked(goal)}
        path = None if any(ends.values()) else birrt(start, goal, *tools, blocked)
        row.birrt_cpu, row.birrt_wall = time.process_time() - cpu, time.perf_counter() - wall
        row.birrt_solved = path is not None
        row.birrt_note = ", ".join(f"{end} in collision" for end, hit in ends.items() if hit)

    def _lay_out(self, query: Query) -> Callable[..., bool]:
        """Put everything where it is in the query; the collision function of the arm that moves."""
        import pybullet
        from pybullet_planning import Attachment, get_collision_fn

        from soma_bullet.frames import inverse, to_quat_xyzw

        stage, context, arm = self.stage, query.context, query.segment.arm
        hands, arms = context.hands, self.workcell.cell.arms
        openings = [
            float(query.widths.max()) if k == arm else float(hands.openings[k]) for k in range(len(arms))
        ]
        for k, body in enumerate(stage.robots):
            for joint, angle in zip(stage.arm_joints[k], hands.qs[k], strict=True):
                pybullet.resetJointState(body, joint, float(angle))
            for joint in stage.finger_joints[k]:
                pybullet.resetJointState(body, joint, openings[k] / 2)
        for name, pose in context.poses.items():
            place = to_quat_xyzw(pose @ inverse(stage.T_inertial_piece[name]))
            pybullet.resetBasePositionAndOrientation(stage.pieces[name], *place)
        body, attachments, allowed = stage.robots[arm], [], set()
        carried = context.carried.get(arm)
        if carried is not None:
            name, T_tcp_piece = carried
            child = stage.pieces[name]
            grasp = to_quat_xyzw(
                arms[arm].hand.T_mount_tcp @ T_tcp_piece @ inverse(stage.T_inertial_piece[name])
            )
            attachments.append(Attachment(body, stage.wrists[arm], grasp, child))
            hand = self.workcell.collision.hand_links
            allowed |= {
                ((body, link[1]), (child, -1))
                for name, link in stage.links.items()
                if name in hand and link[0] == body
            }
        for pair in context.touching:
            parts = [(stage.pieces | stage.fixtures).get(name) for name in pair]
            if None not in parts and len(parts) == 2:
                allowed.add(tuple((part, -1) for part in parts))
        for name, other in hands.gripped.items():
            if name == arm:
                allowed |= {
                    ((body, link[1]), (stage.pieces[other], -1))
                    for link in stage.links.values()
                    if link[0] == body
                }
        ignored = set()
        for pair in self.workcell.cell.never_checked:
            ends = [stage.links.get(name) for name in pair]
            if None not in ends and ends[0][0] == ends[1][0] == body:
                ignored |= {(ends[0][1], ends[1][1]), (ends[1][1], ends[0][1])}
        moving = {child for child in [stage.pieces[carried[0]]]} if carried is not None else set()
        others = [*stage.robots, *stage.fixtures.values(), *(stage.pieces[name] for name in context.poses)]
        obstacles = [other for other in others if other != body and other not in moving]
        blocked: Callable[..., bool] = get_collision_fn(
            body, stage.arm_joints[arm], obstacles=obstacles, attachments=attachments, self_collisions=True,
            disabled_collisions=ignored, extra_disabled_collisions=allowed,
        )  # fmt: skip
        return blocked


def _ratio(rows: list[Timed], clock: Literal["cpu", "wall"]) -> float:
    """Of the medians: birrt over ours."""
    medians = [statistics.median(getattr(row, name) for row in rows) for name in (f"birrt_{clock}", clock)]
    return medians[0] / medians[1]


def motion_table(figures: list[Timed]) -> str:
    """Times against targets, by kind of motion and by part, as Markdown."""
    import numpy as np

    def spread(values: list[float]) -> str:
        if not values:
            return "- | -"
        return f"{np.median(values) * 1e3:.1f} ms | {np.percentile(values, 95) * 1e3:.1f} ms"

    lines = ["| motions | solved | CPU, median | CPU, p95 | wall, median | wall, p95 |", "|-|-|-|-|-|-|"]
    groups = {kind: [row for row in figures if row.kind == kind] for kind in AROUND} | {"all": figures}
    for name, rows in groups.items():
        solved = f"{sum(row.solved for row in rows)} of {len(rows)}"
        lines.append(
            f"| {name} | {solved} | {spread([row.cpu for row in rows])} | "
            f"{spread([row.wall for row in rows])} |"
        )
    total = sum(row.cpu for row in figures)
    lines += ["", "| part of the chain | CPU, median | CPU, p95 | share |", "|-|-|-|-|"]
    for part in PARTS:
        values = [row.parts[part] for row in figures]
        lines.append(f"| {part} | {spread(values)} | {sum(values) / total:.0%} |")
    cpu, wall = [row.cpu for row in figures], [row.wall for row in figures]
    lines += ["", "| job | target | wall | CPU | met |", "|-|-|-|-|-|"]
    for job, target, values in (
        ("chain, median", CHAIN_MEDIAN, [float(np.median(wall)), float(np.median(cpu))]),
        ("chain, p95", CHAIN_P95, [float(np.percentile(wall, 95)), float(np.percentile(cpu, 95))]),
    ):
        shown = " | ".join(f"{value * 1e3:.1f} ms" for value in values)
        lines.append(f"| {job} | < {target * 1e3:.0f} ms | {shown} | {_met(values[0], values[1], target)} |")
    compared = [row for row in figures if row.birrt_solved is not None]
    both = [row for row in compared if row.solved and row.birrt_solved]
    if both:
        times = [_ratio(both, "wall"), _ratio(both, "cpu")]
        met = "yes" if min(times) >= FASTER else "no"
        lines.append(
            f"| birrt's median over ours | > {FASTER:.0f} | {times[0]:.1f} | {times[1]:.1f} | {met} |"
        )
    if compared:
        lines += [
            "",
            "| the same queries | ours solved | birrt solved | ours, median | birrt, median | birrt, p95 | "
            "ratio |",
        ]
        lines.append("|-|-|-|-|-|-|-|")
    for name in (*AROUND, "all") if compared else ():
        rows = [row for row in compared if name in (row.kind, "all")]
        done = [row for row in both if name in (row.kind, "all")]
        counts = (
            f"{sum(row.solved for row in rows)} of {len(rows)} | {sum(bool(r.birrt_solved) for r in rows)} "
            f"of {len(rows)}"
        )
        if done:
            ours = f"{np.median([row.cpu for row in done]) * 1e3:.1f} ms"
            theirs = spread([row.birrt_cpu for row in done])
            lines.append(f"| {name} | {counts} | {ours} | {theirs} | {_ratio(done, 'cpu'):.1f} |")
    hits = sum(bool(row.birrt_note) for row in compared)
    if hits:
        lines += [
            "",
            f"birrt was not begun in {hits} cases: its world has the start or the goal in collision.",
        ]
    return "\n".join(lines) + "\n"


# --- physics and whole episodes -----------------------------------------------------------------------------


def simulate(arguments: Simulate) -> None:
    """Prints how fast one program runs in physics."""
    from soma_bullet.assembly.file import load_assembly
    from soma_bullet.bullet.simulator import BulletSimulator
    from soma_bullet.episode import EpisodeOptions, execute
    from soma_bullet.planner.qualities import PlannerOptions
    from soma_bullet.planner.store import kept_plan
    from soma_bullet.robot.cell import load_cell
    from soma_bullet.task.feed import FeedOptions, draw_feed
    from soma_bullet.task.overlap import overlapped
    from soma_bullet.task.program import make_program
    from soma_bullet.task.workcell import Workcell

    options = EpisodeOptions(
        cell=arguments.cell, seed=arguments.seed, feed=FeedOptions(poses=arguments.poses)
    )
    assembly, cell = load_assembly(arguments.assembly), load_cell(arguments.cell)
    workcell = Workcell(assembly, cell)
    plan = kept_plan(assembly, cell.hands, PlannerOptions(seed=arguments.seed))
    feed = draw_feed(assembly, plan, cell, arguments.seed, options.feed)
    program = overlapped(workcell, make_program(workcell, plan, feed, arguments.seed))
    taken: dict[int, list[float]] = defaultdict(list)  # hands that squeeze -> CPU time of steps
    step = BulletSimulator.step

    def timed(world: BulletSimulator) -> None:
        start = time.process_time()
        step(world)
        taken[sum(force > 0.0 for force in world._squeezing)].append(time.process_time() - start)

    BulletSimulator.step = timed  # type: ignore[method-assign]
    wall, cpu = time.perf_counter(), time.process_time()
    try:
        log = execute(assembly, workcell, plan, program, options, lambda what, fraction: None)
    finally:
        BulletSimulator.step = step  # type: ignore[method-assign]
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    dt, simulated = options.physics.dt, float(log.times[-1])
    lines = ["| what runs | simulated | CPU | times real time |", "|-|-|-|-|"]
    names = {0: "steps, nothing gripped", 1: "steps, one hand grips", 2: "steps, both hands grip"}
    for hands, seconds in sorted(taken.items()):
        lines.append(
            f"| {names[hands]} | {len(seconds) * dt:.1f} s | {sum(seconds):.2f} s | "
            f"{len(seconds) * dt / sum(seconds):.1f} |"
        )
    rest = cpu - sum(map(sum, taken.values()))
    lines.append(
        f"| control, measuring and the log | {simulated:.1f} s | {rest:.2f} s | "
        f"{simulated / max(rest, 1e-9):.1f} |"
    )
    lines.append(
        f"| all | {simulated:.1f} s | {cpu:.2f} s | {simulated / cpu:.1f} ({simulated / wall:.1f} by wall "
        f"time) |"
    )
    sys.stdout.write("\n".join(lines) + f"\n\nended: {log.ended}\n")


def episode(arguments: Episode, say: Callable[[str], object]) -> None:
    """Prints the wall time of whole episodes by stage."""
    import numpy as np

    from soma_bullet.episode import EpisodeOptions, run_episode
    from soma_bullet.errors import InputError, NoSolutionError
    from soma_bullet.task.feed import FeedOptions

    if arguments.seeds < 1:
        raise InputError("arguments", f"--seeds {arguments.seeds}: must be at least 1")
    seconds: dict[str, list[float]] = defaultdict(list)
    verdicts, makespans = [], []
    for seed in range(arguments.seeds):
        options = EpisodeOptions(cell=arguments.cell, seed=seed, feed=FeedOptions(poses=arguments.poses))
        start = time.perf_counter()
        try:
            report = run_episode(arguments.assembly, options)
        except NoSolutionError as error:
            say(f"seed {seed}: {error.stage}: {error.summary}")
            continue
        assert report is not None
        seconds["all"].append(time.perf_counter() - start)
        for stage, value in report.wall_s.items():
            seconds[stage].append(value)
        verdicts.append(report.success)
        makespans.append(report.makespan_s)
        say(
            f"seed {seed}: {seconds['all'][-1]:.1f} s, "
            f"{'success' if report.success else report.judgement.causes[0]}"
        )
    if not verdicts:
        raise NoSolutionError("schedule", "no episode had a program")
    seconds["all"] = seconds.pop("all")  # last
    lines = ["| stage | median | p95 |", "|-|-|-|"]
    lines += [f"| {s} | {np.median(v):.2f} s | {np.percentile(v, 95):.2f} s |" for s, v in seconds.items()]
    lines.append(
        f"| makespan, simulated | {np.median(makespans):.1f} s | {np.percentile(makespans, 95):.1f} s |"
    )
    sys.stdout.write("\n".join(lines) + f"\n\n{sum(verdicts)} of {len(verdicts)} succeeded\n")


# --- all Soma cubes -----------------------------------------------------------------------------------------


def cube240(arguments: Cube240) -> None:
    """Prints the summary, and writes the figures of every cube."""
    from rich.console import Console
    from rich.progress import Progress

    from soma_bullet.records import package_versions, to_tree
    from soma_bullet.validation.cubes import cube_table, survey_cubes

    start = time.perf_counter()
    with Progress(console=Console(stderr=True)) as bar:
        task = bar.add_task("cubes", total=arguments.plans + arguments.turned)
        plans, turns = survey_cubes(
            arguments.plans,
            arguments.turned,
            arguments.orientations,
            arguments.grasps,
            arguments.seed,
            arguments.jobs,
            lambda: bar.advance(task),
        )
    figures = {"plans": to_tree(plans), "turns": to_tree(turns), "versions": package_versions()}
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    sys.stdout.write(cube_table(plans, turns))
    sys.stderr.write(
        f"{time.perf_counter() - start:.0f} s in {arguments.jobs} processes; written to {arguments.out}\n"
    )


if __name__ == "__main__":
    # many small matrices: threads of the linear algebra would only get in each other's way
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    Command = (
        Annotated[Stages, tyro.conf.subcommand("stages")]
        | Annotated[Planner, tyro.conf.subcommand("planner")]
        | Annotated[Cube240, tyro.conf.subcommand("cube240")]
        | Annotated[Motion, tyro.conf.subcommand("motion")]
        | Annotated[Simulate, tyro.conf.subcommand("simulate")]
        | Annotated[Episode, tyro.conf.subcommand("episode")]
    )
    raise SystemExit(main(tyro.cli(Command, default=Stages(), description=__doc__)))  # type: ignore[arg-type]
