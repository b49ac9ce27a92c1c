"""Whether this installation and this machine can do the job: what works, what does not, and what to do about
it.

Uses nothing but the standard library until a check needs more, so that it can say what is missing.
"""

from __future__ import annotations

import argparse
import importlib
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

State = Literal["good", "warning", "bad"]
PACKAGE = "soma_bullet"
CELL = "ur5e_pair"
PYTHON = (3, 11)
# what is imported of a distribution, where that is not its name
MODULES = {
    "eaik": "eaik.IK_HP",
    "embreex": "embreex.mesh_construction",
    "ompl": "ompl.geometric",
    "pillow": "PIL",
    "pin": "pinocchio",
    "pybullet": "soma_bullet.bullet.quiet",  # which keeps it from talking
}
RENDERER = "apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri"
AGAIN = "install it again: pip install --force-reinstall"
CORES, MEMORY = 2, 4.0  # [GB] below which it is slow, or may not do
REACH = 1e-6  # [m] by which a pose may be missed on the way through inverse and forward kinematics
FALL = 0.2  # [s] of physics
SUNK, SAGGED = 2e-3, 0.5  # [m], [deg] by which pieces may sink or hover then, and an arm may sag
PATIENCE = 60  # [s] for one picture
WIDTH = 100  # [characters] of a line of the table


@dataclass(frozen=True)
class Finding:
    """What one check came to.

    Attributes:
        what: what was looked at.
        state: `good`, `warning` (something is slower or plainer than it could be), or `bad`.
        says: what was found.
        advice: what to do about it; empty where all is well.
    """

    what: str
    state: State
    says: str
    advice: str = ""


Check = Callable[[], Iterator[Finding]]


def doctor(arguments: list[str] | None = None) -> int:
    """Entry point of `soma-doctor` and of scripts/doctor.py. Prints a table; returns 0 if all that is needed
    works, else 1."""
    parser = argparse.ArgumentParser(
        prog="soma-doctor",
        description="Checks the installation and the machine, and says what is wrong and what to do about "
        "it. Exit status: 0 if everything that is needed works (a warning is no fault), else 1.",
    )
    parser.parse_args(arguments)
    start = time.perf_counter()
    findings = list(examine())
    sys.stdout.write(table(findings))
    bad = [finding for finding in findings if finding.state == "bad"]
    warned = sum(finding.state == "warning" for finding in findings)
    verdict = f"{len(bad)} of {len(findings)} checks failed" if bad else "everything that is needed works"
    more = f", {warned} warning{'s' if warned > 1 else ''}" if warned else ""
    sys.stdout.write(f"\n{verdict}{more} ({time.perf_counter() - start:.0f} s)\n")
    return 1 if bad else 0


def examine() -> Iterator[Finding]:
    """All findings. A check that fails in a way that nobody thought of is a finding too."""
    for name, check in CHECKS.items():
        try:
            yield from check()
        except Exception as error:
            yield Finding(
                name,
                "bad",
                _said(error),
                "if a line above explains it, mend that first; if none does, this is a fault of the "
                "package: report it",
            )


def table(findings: list[Finding]) -> str:
    """The findings in columns, advice below what it is about."""
    marks = {"good": "ok", "warning": "warning", "bad": "FAILED"}
    width = max(len(finding.what) for finding in findings)
    indent = " " * (width + 11)
    lines = []
    for finding in findings:
        says = textwrap.wrap(finding.says, WIDTH - len(indent)) or [""]
        lines.append(f"{finding.what:<{width}}  {marks[finding.state]:<9}{says[0]}")
        lines += [indent + line for line in says[1:]]
        lines += textwrap.wrap(
            finding.advice, WIDTH, initial_indent=indent + "-> ", subsequent_indent=indent + "   "
        )
    return "\n".join(lines) + "\n"


def _said(error: BaseException) -> str:
    text = str(error).strip().splitlines()
    return f"{type(error).__name__}: {text[0]}" if text else type(error).__name__


# --- the machine --------------------------------------------------------------------------------------------


def check_machine() -> Iterator[Finding]:
    """Cores and memory."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    says = f"{platform.system()} {platform.machine()}, {cores} core{'s' if cores > 1 else ''}"
    advice = "" if cores >= CORES else "works, but a film takes twice as long, and so do evaluations"
    yield Finding("cores", "good" if not advice else "warning", says, advice)
    memory = _memory()
    if memory is not None:
        advice = (
            ""
            if memory >= MEMORY
            else f"evaluate with --jobs 1; an episode takes about 1 GB, a film {MEMORY:.0f} GB"
        )
        yield Finding("memory", "good" if not advice else "warning", f"{memory:.1f} GB free", advice)


def _memory() -> float | None:
    """What is free [GB]; None where the system does not say."""
    file = Path("/proc/meminfo")
    found = re.search(r"MemAvailable:\s+(\d+) kB", file.read_text()) if file.is_file() else None
    return int(found.group(1)) * 1024 / 1e9 if found else None


def check_folders() -> Iterator[Finding]:
    """Where plans are kept between runs, and where scratch files go."""
    from soma_bullet.planner.store import store_folder

    for what, folder, state, advice in (
        (
            "folder of kept plans",
            store_folder(),
            "warning",
            "every run plans afresh; set XDG_CACHE_HOME to a folder of yours",
        ),
        ("scratch folder", Path(tempfile.gettempdir()), "bad", "set TMPDIR to a folder that can be written"),
    ):
        fault = _unwritable(folder)
        says = f"{folder} {fault or 'can be written'}"
        yield Finding(what, state if fault else "good", says, advice if fault else "")  # type: ignore[arg-type]


def _unwritable(folder: Path) -> str:
    """Why nothing can be written into a folder that may not be there yet; empty where something can."""
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    try:
        with tempfile.TemporaryFile(dir=there):
            return ""
    except OSError as error:
        return f"cannot be written: {error.strerror}"


# --- the installation ---------------------------------------------------------------------------------------


def check_python() -> Iterator[Finding]:
    """The interpreter."""
    good = sys.version_info[:2] == PYTHON and platform.python_implementation() == "CPython"
    says = f"{platform.python_implementation()} {platform.python_version()}, {sys.prefix}"
    advice = (
        "" if good else "pybullet has wheels for CPython 3.11 alone: make a virtual environment with that"
    )
    yield Finding("python", "good" if good else "bad", says, advice)


def check_packages() -> Iterator[Finding]:
    """Every dependency: is it there, of a version that serves, and does it load?"""
    try:
        wanted = metadata.requires(PACKAGE) or []
        yield Finding(PACKAGE, "good", f"{metadata.version(PACKAGE)}, {Path(__file__).parents[1]}")
    except metadata.PackageNotFoundError:
        yield Finding(PACKAGE, "bad", "is not installed", "in the checkout: pip install --editable .")
        return
    for requirement in wanted:
        if "extra ==" in requirement.replace('"', "'").replace("extra==", "extra =="):
            continue
        name = re.match(r"[\w.-]+", requirement)
        if name is not None:
            yield _package(name.group(), requirement)


def _package(name: str, requirement: str) -> Finding:
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        return Finding(name, "bad", "is not installed", f"pip install '{requirement}'")
    if not serves(version, requirement):
        return Finding(
            name, "bad", f"{version} does not serve: {requirement} is needed", f"pip install '{requirement}'"
        )
    start = time.perf_counter()
    try:
        importlib.import_module(MODULES.get(name, name.replace("-", "_")))
    except Exception as error:
        return Finding(name, "bad", f"{version} does not load: {_said(error)}", f"{AGAIN} '{requirement}'")
    return Finding(name, "good", f"{version}, loads in {time.perf_counter() - start:.1f} s")


def serves(version: str, requirement: str) -> bool:
    """Whether a version keeps the bounds (>=, >, <=, <) of a requirement; bounds of other kinds are taken as
    kept."""
    has = _numbers(version)
    tests = {">=": has.__ge__, ">": has.__gt__, "<=": has.__le__, "<": has.__lt__}
    bounds = re.findall(r"(>=|<=|<|>)\s*([\d.]+)", requirement.split(";")[0])
    return all(tests[sign](_numbers(bound)) for sign, bound in bounds)


def _numbers(version: str) -> tuple[int, ...]:
    found = re.match(r"[\d.]+", version)
    numbers = [int(part) for part in found.group().split(".") if part] if found else []
    return (*numbers, *[0] * (6 - len(numbers)))


# --- what it can do -----------------------------------------------------------------------------------------


def check_robot() -> Iterator[Finding]:
    """Inverse kinematics there and back, and a collision check, with the default cell."""
    import numpy as np

    from soma_bullet.assembly.file import load_assembly
    from soma_bullet.robot.cell import load_cell
    from soma_bullet.task.workcell import Workcell

    workcell = Workcell(load_assembly("soma3"), load_cell(CELL))
    robot, idle = workcell.robot, workcell.idle()
    for arm, q in enumerate(robot.home):
        pose = robot.tcp(arm, q)
        found = robot.inverse(arm, pose, q)
        off = max((float(np.abs(robot.tcp(arm, other) - pose).max()) for other in found), default=np.inf)
        back = len(found) > 0 and float(np.abs(found[0] - q).max()) < 1e-6
        good = back and off < REACH
        says = (
            f"{robot.arm(arm).name} arm at home: {len(found)} ways to reach its pose, all within {off:.0e} m"
        )
        advice = "" if good else f"{AGAIN} eaik pin"
        yield Finding("inverse kinematics", "good" if good else "bad", says, advice)
    scene = workcell.scene({}, idle, 0)
    free = not scene.collides(workcell.configuration(idle, 0, robot.home[0]))
    through = robot.home[0] + np.array(
        [0.0, 1.2, 0.0, 0.0, 0.0, 0.0]
    )  # [rad] the shoulder bends forward and down
    hit = any(
        scene.collides(workcell.configuration(idle, 0, robot.home[0] + share * (through - robot.home[0])))
        for share in np.linspace(0.0, 2.0, 21)
    )
    good = free and hit
    says = (
        "home is free, an arm that bends down collides"
        if good
        else f"home free: {free}, an arm that bends down collides: {hit}"
    )
    yield Finding("collision check", "good" if good else "bad", says, "" if good else f"{AGAIN} coal pin")


def check_physics() -> Iterator[Finding]:
    """PyBullet without a window, and a short run of the real world: what lies on the table must stay
    there."""
    import numpy as np

    from soma_bullet.assembly.file import load_assembly
    from soma_bullet.bullet.simulator import BulletSimulator
    from soma_bullet.bullet.stage import time_step
    from soma_bullet.frames import apply, translate
    from soma_bullet.robot.cell import load_cell
    from soma_bullet.task.workcell import Workcell
    from soma_bullet.world.options import Physics

    assembly, cell = load_assembly("soma3"), load_cell(CELL)
    workcell = Workcell(assembly, cell)
    side, start = cell.feed_areas[0].mean(axis=1), time.perf_counter()
    poses = {}
    for k, piece in enumerate(
        assembly.pieces
    ):  # as their meshes are, one beside the other, a hair above the table
        poses[piece.name] = translate(
            np.eye(4), (side[0], side[1] + 0.12 * (k - 1), 1e-4 - piece.vertices[:, 2].min())
        )
    world = BulletSimulator(
        cell, assembly, workcell.robot.stand_size, poses, np.array(workcell.robot.home), Physics()
    )
    try:
        yield Finding(
            "pybullet, no window", "good", f"the cell is loaded in {time.perf_counter() - start:.1f} s"
        )
        start, steps = time.perf_counter(), round(FALL / time_step(Physics()))
        for _ in range(steps):
            world.step()
        factor = FALL / (time.perf_counter() - start)
        found = world.piece_poses()
        lowest = min(float(apply(found[piece.name], piece.vertices)[:, 2].min()) for piece in assembly.pieces)
        sag = float(np.rad2deg(np.abs(world.measured_joints() - workcell.robot.home).max()))
    finally:
        world.close()
    good = abs(lowest) < SUNK and sag < SAGGED
    says = f"{FALL:g} s in {steps} steps, {factor:.1f} times as fast as real time; "
    says += f"pieces stay on the table to {abs(lowest) * 1e3:.2f} mm, arms at home to {sag:.3f} deg"
    yield Finding("physics", "good" if good else "bad", says, "" if good else f"{AGAIN} pybullet numpy")


def check_pictures() -> Iterator[Finding]:
    """Who draws, and whether a video can be encoded."""
    import av
    import numpy as np

    yield _renderer()
    with tempfile.TemporaryDirectory() as folder:
        file = str(Path(folder) / "test.mp4")
        with av.open(file, "w") as container:
            stream = container.add_stream("libx264", rate=10)
            stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
            for k in range(3):
                picture = av.VideoFrame.from_ndarray(np.full((64, 64, 3), 80 * k, np.uint8), format="rgb24")
                container.mux(stream.encode(picture))
            container.mux(stream.encode())
        with av.open(file) as container:
            count = sum(1 for _ in container.decode(video=0))
    good = count == 3
    tool = shutil.which("ffmpeg")
    says = f"H.264 by av {av.__version__}" + (
        f"; ffmpeg at {tool}" if tool else "; no ffmpeg on the path, and none is needed"
    )
    yield Finding("video", "good" if good else "bad", says, "" if good else f"{AGAIN} av")


def _renderer() -> Finding:
    """In a process of its own: what draws is not of this package, and a faulty driver ends a process without
    a word."""
    code = f"from {__name__} import draw_home; draw_home()"
    try:
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, timeout=PATIENCE, check=False
        )
    except subprocess.TimeoutExpired:
        return Finding(
            "renderer", "bad", f"one picture took more than {PATIENCE} s", "film with --no-video; " + RENDERER
        )
    lines = done.stdout.splitlines()
    if done.returncode or not lines:
        last = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
        return Finding(
            "renderer", "bad", f"no picture: {last}", f"run episodes with --no-video, or: {RENDERER}"
        )
    renderer, contrast, reason = lines[-1].split("|", 2)
    if float(contrast) < 1.0:
        return Finding(
            "renderer",
            "bad",
            f"{renderer} draws an empty picture",
            f"use --film.renderer tiny, or: {RENDERER}",
        )
    if renderer == "egl":
        return Finding("renderer", "good", "EGL draws")
    return Finding("renderer", "warning", f"PyBullet's own draws, which is slow: {reason}", RENDERER)


def draw_home() -> None:
    """Prints who drew a picture of the cell at home, its contrast, and why it was not EGL if it was not."""
    from soma_bullet.pictures.camera import CAMERAS
    from soma_bullet.pictures.studio import Studio
    from soma_bullet.robot.cell import load_cell
    from soma_bullet.robot.compose import compose_urdf

    with tempfile.TemporaryDirectory() as folder:
        urdf = compose_urdf(load_cell(CELL), (0.1, 0.1), Path(folder) / "cell.urdf")
        with Studio(urdf, size=(160, 90)) as studio:
            picture = studio.frame({}, {}, CAMERAS["front"])
            sys.stdout.write(f"{studio.renderer}|{picture.std():.1f}|{studio.reason}\n")


CHECKS: dict[str, Check] = {
    "python": check_python,
    "packages": check_packages,
    "machine": check_machine,
    "folders": check_folders,
    "robot": check_robot,
    "physics": check_physics,
    "pictures": check_pictures,
}
