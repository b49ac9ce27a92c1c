"""Rules of the house that no single module can keep: what imports what, what ships, what the simulator may
touch."""

from __future__ import annotations

import ast
import configparser
import importlib
import os
import subprocess
import sys
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "soma_bullet"
MODULES = sorted(PACKAGE.rglob("*.py"))
SCRIPTS = sorted((ROOT / "scripts").glob("*.py"))
DATA = ("meshes", "robots")  # folders of the top level that install as packages
LARGEST_FILE = 2_000_000  # [bytes]
SLOWEST_HELP = 5.0  # [s]; half a second is meant, and a busy machine is not to fail it
# a body may be put somewhere before time starts, by the module that lays out the world, and in pictures,
# which have no time
PLACING = {
    Path("soma_bullet/bullet/stage.py"),
    Path("soma_bullet/bullet/birrt.py"),  # another planner's world, in which there is no time
    Path("soma_bullet/pictures/studio.py"),
    Path("soma_bullet/pictures/sight.py"),
    Path("soma_bullet/pictures/look.py"),
}
TELEPORTS = {
    "resetBasePositionAndOrientation",
    "resetBaseVelocity",
    "resetJointState",
    "resetJointStatesMultiDof",
}


def python(*arguments: str, folder: Path = ROOT, path: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run the interpreter of the tests in `folder`, with `path` to import from."""
    environment = os.environ | {"PYTHONPATH": str(path)}
    command = [sys.executable, *arguments]
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120, check=False
    )


def tracked_files() -> list[Path]:
    """The files of the repository, the new ones included; in an unpacked archive, all that no rule ignores by
    its folder."""
    listing = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(listing, cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode == 0:
        return [path for path in (ROOT / line for line in listed.stdout.splitlines()) if path.is_file()]
    hidden = {".git", ".venv", ".cache", "runs", "build", "dist"}
    return [
        path for path in ROOT.rglob("*") if path.is_file() and not hidden & set(path.relative_to(ROOT).parts)
    ]


def calls(path: Path) -> Iterator[tuple[str, ast.Call]]:
    """Name and node of every call of a method or a function."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            function = node.func
            yield function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", ""), node


def imports(path: Path) -> set[str]:
    """Top-level names of all that a module imports, inside functions too."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.split(".")[0])
    return found


def test_imports_go_one_way() -> None:
    code = "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports(no_cache=True))"
    result = python("-c", code)
    assert result.returncode == 0, result.stdout + result.stderr


def test_pybullet_is_used_in_one_folder_alone() -> None:
    users = {
        path.relative_to(PACKAGE).parts[0]
        for path in MODULES
        if {"pybullet", "pybullet_data"} & imports(path)
    }
    assert users <= {"bullet"}


@pytest.mark.parametrize("layer", ["assembly", "planner", "task", "motion"])
def test_planning_runs_without_the_simulator(layer: str) -> None:
    """Import all modules of a layer, and see that nothing brought the simulator in by another way."""
    names = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in sorted((PACKAGE / layer).rglob("[!_]*.py"))
    ]
    code = (
        f"import importlib, sys; [importlib.import_module(name) for name in {names}]; print('pybullet' in "
        f"sys.modules)"
    )
    result = python("-c", code)
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1] == "False"


def test_no_file_is_large() -> None:
    sizes = {str(path.relative_to(ROOT)): path.stat().st_size for path in tracked_files()}
    assert {name: size for name, size in sizes.items() if size > LARGEST_FILE} == {}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_every_script_says_what_it_does(script: Path, tmp_path: Path) -> None:
    start = time.monotonic()
    result = python(str(script), "--help", folder=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "usage" in result.stdout.lower()
    assert list(tmp_path.iterdir()) == []
    assert time.monotonic() - start < SLOWEST_HELP


def test_only_gears_between_fingers_are_constraints() -> None:
    """Nothing is welded: each constraint made is a gear, the coupling of two fingers of one hand."""
    for path in MODULES:
        for name, call in calls(path):
            if name == "createConstraint":
                where = f"{path.relative_to(ROOT)}:{call.lineno}"
                assert path.is_relative_to(PACKAGE / "bullet"), where
                assert "JOINT_GEAR" in ast.unparse(call), where


def test_nothing_is_teleported_once_time_runs() -> None:
    for path in MODULES:
        made = {name for name, _ in calls(path)}
        if path.relative_to(ROOT) not in PLACING:
            assert not made & TELEPORTS, path
        if made & TELEPORTS and "stepSimulation" in made:
            pytest.fail(
                f"{path.relative_to(ROOT)} both places bodies and lets time run; keep the two in modules "
                f"of their own"
            )


def test_the_package_says_no_address_of_a_registry() -> None:
    hosts = ("pypi.", "pythonhosted.", "deb.debian", "registry.npm")
    for path in tracked_files():
        if (
            path.suffix in {".py", ".cfg", ".toml", ".md", ".in", ".txt", ""}
            and path != Path(__file__).resolve()
        ):
            text = path.read_text(encoding="utf-8", errors="ignore")
            assert not [host for host in hosts if host in text], path


def test_every_package_is_listed_for_installation() -> None:
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    listed = set(config["options"]["packages"].split())
    data = {f"soma_bullet.{name}" for name in DATA}
    assert data <= listed
    folders = {path.parent.relative_to(ROOT) for path in MODULES}
    assert listed - data == {".".join(folder.parts) for folder in folders}
    assert [folder for folder in folders if not (ROOT / folder / "__init__.py").is_file()] == []


@pytest.mark.slow
def test_a_wheel_holds_all_data_and_works_outside_the_checkout(tmp_path: Path) -> None:
    pytest.importorskip("setuptools", minversion="77")
    checkout, site = tmp_path / "checkout", tmp_path / "site"
    files = [path.relative_to(ROOT) for path in tracked_files()]
    files = [path for path in files if path.parts[0] in {"soma_bullet", *DATA} or len(path.parts) == 1]
    for path in files:
        (checkout / path).parent.mkdir(parents=True, exist_ok=True)
        (checkout / path).write_bytes((ROOT / path).read_bytes())
    built = python(
        "-c", f"from setuptools import build_meta as b; b.build_wheel({str(tmp_path)!r})", folder=checkout
    )
    assert built.returncode == 0, built.stderr
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        held = set(archive.namelist())
        archive.extractall(site)
    expected = {
        path if path.parts[0] == "soma_bullet" else Path("soma_bullet", path)
        for path in files
        if len(path.parts) > 1
    }
    assert {path.as_posix() for path in expected} - held == set()
    code = (
        "from soma_bullet.assembly import file; from soma_bullet.robot.cell import load_cell; "
        "print(file.__file__, file.load_assembly('soma3').name, load_cell('ur5e_pair').name)"
    )
    used = python("-c", code, folder=tmp_path, path=site)
    assert used.stdout.split() == [
        str(site / "soma_bullet" / "assembly" / "file.py"),
        "soma3",
        "ur5e_pair",
    ], used.stderr
    for name, module, function in commands():
        code = f"import sys; sys.argv[0] = {name!r}; from {module} import {function} as f; sys.exit(f())"
        told = python("-c", code, "--help", folder=tmp_path, path=site)
        assert told.returncode == 0 and name in told.stdout, told.stderr


def commands() -> list[tuple[str, str, str]]:
    """Name, module and function of every command that is installed."""
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    found = []
    for line in config["options.entry_points"]["console_scripts"].split("\n"):
        if line:
            name, place = line.split(" = ")
            found.append((name, *place.split(":")))
    return found  # type: ignore[return-value]


def test_every_command_is_there() -> None:
    names = ("benchmark", "compare", "doctor", "episode", "evaluate", "figure", "plan", "render")
    assert [name for name, _, _ in commands()] == [f"soma-{name}" for name in names]
    for _, module, function in commands():
        assert callable(getattr(importlib.import_module(module), function))


LONGEST_FILE = 350  # [lines]


@pytest.mark.parametrize("path", [*MODULES, *SCRIPTS], ids=lambda path: path.name)
def test_no_file_is_long(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= LONGEST_FILE
