"""What `import soma_bullet` offers: few names, typed, documented, and nothing loaded before it is asked
for."""

from __future__ import annotations

import ast
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import soma_bullet

PACKAGE = Path(soma_bullet.__file__).parent
FACE = {
    "functions": {
        "execute", "judge", "load_assembly", "load_cell", "load_hand", "make_plan", "make_program",
        "plan_figure", "run_episode",
    },
    "values": {
        "Assembly", "AssemblyPlan", "Cell", "EpisodeReport", "ExecutionLog", "FigurePlan", "Hand",
        "Judgement", "Program",
    },
    "options": {
        "EpisodeOptions", "ExecutionOptions", "FeedOptions", "FigureOptions", "FilmOptions", "HoldLoad",
        "Physics", "PlannerOptions", "SearchOptions", "Tolerance",
    },
    "errors": {"InputError", "NoSolutionError", "SomaBulletError"},
}  # fmt: skip
SLOWEST = (
    2.0  # [s] for the interpreter and the import; a tenth is meant, and a busy machine is not to fail it
)
HEAVY = {"numpy", "scipy", "pybullet", "trimesh", "shapely", "coal", "pinocchio", "rich", "tyro", "cattrs"}


def test_the_face_is_small() -> None:
    names = set().union(*FACE.values())
    assert set(soma_bullet.__all__) == names == set(dir(soma_bullet))
    assert len(soma_bullet.__all__) == len(names)


def test_no_name_is_that_of_a_module() -> None:
    """A module would take the place of what has its name as soon as it is loaded."""
    modules = {path.stem for path in PACKAGE.iterdir()}
    assert not modules & set(soma_bullet.__all__)


@pytest.mark.parametrize("name", sorted(set().union(*FACE.values())))
def test_every_name_is_documented(name: str) -> None:
    found = getattr(soma_bullet, name)
    assert inspect.getdoc(found)
    assert inspect.isfunction(found) if name in FACE["functions"] else inspect.isclass(found)
    if name in FACE["functions"]:
        assert "Raises" in (inspect.getdoc(found) or ""), "a caller wants to know what it raises"


def test_types_and_values_are_the_same() -> None:
    """What a type checker is told of a name is what one gets."""
    tree = ast.parse(Path(soma_bullet.__file__).read_text(encoding="utf-8"))
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    told = {}
    for node in block.body:
        assert isinstance(node, ast.ImportFrom)
        for alias in node.names:
            told[alias.asname or alias.name] = (node.module, alias.name)
    assert set(told) == set(soma_bullet.__all__)
    for name, (module, there) in told.items():
        assert module is not None
        assert getattr(soma_bullet, name) is getattr(sys.modules[module], there)


def test_a_name_that_is_not_there_is_told_which_are() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'make_plans'; it has .*make_plan"):
        _ = soma_bullet.make_plans


def fresh(code: str) -> str:
    """What a new interpreter prints."""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=PACKAGE.parent, capture_output=True, text=True, timeout=60, check=True)
    return done.stdout.strip()


def test_nothing_is_loaded_before_it_is_asked_for() -> None:
    loaded = fresh("import soma_bullet, sys; print(*{name.split('.')[0] for name in sys.modules})")
    assert not set(loaded.split()) & HEAVY
    others = fresh(
        "import soma_bullet, sys; print(*[n for n in sys.modules if n.startswith('soma_bullet.')])"
    )
    assert others == ""


def test_the_import_is_quick() -> None:
    code = "import time; t = time.perf_counter(); import soma_bullet; print(time.perf_counter() - t)"
    assert float(fresh(code)) < SLOWEST


def test_options_and_errors_load_nothing_heavy() -> None:
    names = sorted(FACE["options"] | FACE["errors"])
    code = f"import soma_bullet as sb, sys; [getattr(sb, n) for n in {names}]; print(*sys.modules)"
    assert not {name.split(".")[0] for name in fresh(code).split()} & HEAVY
