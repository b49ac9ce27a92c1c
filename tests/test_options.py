"""Options: every one is a flag, its value arrives, its range is kept, and the documents name none that is not
there."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import pytest

import soma_bullet.episode as episodes
import soma_bullet.evaluation.evaluate as evaluating
import soma_bullet.planner.plan as planning
from soma_bullet.cli.episode import RunArguments, run_episode
from soma_bullet.cli.evaluate import EvaluateArguments, evaluate
from soma_bullet.cli.figure import FigureArguments
from soma_bullet.cli.flags import documentation, parse
from soma_bullet.cli.plan import PlanArguments, plan
from soma_bullet.cli.render import RenderArguments
from soma_bullet.errors import InputError
from soma_bullet.evaluation.options import EvaluationOptions
from soma_bullet.option import Flag, Options, Range, changed, flags
from soma_bullet.options import EpisodeOptions
from soma_bullet.pictures.camera import CAMERAS
from soma_bullet.pictures.options import CameraName, FilmOptions, RendererName
from soma_bullet.pictures.studio import RENDERERS
from soma_bullet.planner.options import PlannerOptions

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "soma_bullet"
DOCUMENTS = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMANDS = [RunArguments, FigureArguments, EvaluateArguments, PlanArguments, RenderArguments]
EPISODE = list(flags(EpisodeOptions))
Captured = pytest.CaptureFixture[str]


class Received(Exception):
    """What a command has passed on."""


def receiver(at: int) -> Any:
    """A function that raises its argument of that number."""

    def receive(*arguments: Any, **_: Any) -> None:
        raise Received(arguments[at])

    return receive


def bare(kind: Any) -> tuple[Any, tuple[Any, ...]]:
    """An annotated kind without what it must be, and that."""
    return (get_args(kind)[0], get_args(kind)[1:]) if get_origin(kind) is Annotated else (kind, ())


def another(flag: Flag, value: Any) -> Any:
    """A value in range that is not the one given."""
    kind, rules = bare(flag.kind)
    if get_origin(kind) is Literal:
        return next(word for word in get_args(kind) if word != value)
    if isinstance(value, bool):
        return not value
    if get_origin(kind) is tuple:
        return {str: ("feed", "mass"), float: (0.0, 0.5), int: (640, 360)}[bare(get_args(kind)[0])[0]]
    if kind is str or str in get_args(kind):
        return "another"
    numbers = [2 * value, value / 2, value + 1] if value is not None else []
    whole = int in (kind, *get_args(kind))
    for number in (int(n) if whole else float(n) for n in (*numbers, 1, 2)):
        if number != value and not any(rule.fault(number) for rule in rules):
            return number
    raise AssertionError(flag)


def typed(flag: Flag, value: Any) -> list[str]:
    """Arguments that set a value."""
    return flag.text(value).split(" ")


# --- every option is a flag ---------------------------------------------------------------------------------


@pytest.mark.parametrize("flag", EPISODE, ids=lambda flag: flag.name)
def test_every_option_of_an_episode_arrives(flag: Flag, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(episodes, "run_episode", receiver(1))
    usual = EpisodeOptions(film=FilmOptions())
    value = another(flag, flag.value(usual))
    with pytest.raises(Received) as received:
        run_episode(["soma3", "--out", "nowhere", *typed(flag, value)])
    options = received.value.args[0]
    assert flag.value(options) == value
    assert list(changed(options, usual)) == [flag.name]


@pytest.mark.parametrize("flag", list(flags(PlannerOptions)), ids=lambda flag: flag.name)
def test_every_option_of_a_plan_arrives(flag: Flag, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planning, "make_plan", receiver(2))
    value = another(flag, flag.value(PlannerOptions()))
    with pytest.raises(Received) as received:
        plan(["soma3", *typed(flag, value)])
    options = received.value.args[0]
    assert flag.value(options) == value and list(changed(options, PlannerOptions(hands=2))) == [flag.name]


EVALUATION = [flag for flag in flags(EvaluationOptions) if "film" not in flag.path]


@pytest.mark.parametrize("flag", EVALUATION, ids=lambda flag: flag.name)
def test_every_option_of_an_evaluation_arrives(flag: Flag, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluating, "evaluate", receiver(0))
    if flag.name == "--assembly":  # the argument without a flag
        return
    varied = [] if flag.name == "--vary" else ["--vary", "friction,mass,perception,feed"]
    usual = EvaluationOptions(
        "soma3", vary=("feed",) if not varied else ("friction", "mass", "perception", "feed")
    )
    value = another(flag, flag.value(usual))
    with pytest.raises(Received) as received:
        evaluate(["soma3", *varied, *typed(flag, value)])
    assert list(changed(received.value.args[0], usual)) == [flag.name]


def test_evaluations_and_episodes_take_all_that_decides_a_plan() -> None:
    plans = {flag.name for flag in flags(PlannerOptions)}
    for command in (RunArguments, EvaluateArguments, PlanArguments):
        assert plans <= {flag.name for flag in flags(command)}, command
    assert {"--stability", "--analyzer", "--push", "--disturbance", "--hands", "--top"} <= plans


@pytest.mark.parametrize("command", COMMANDS)
def test_no_flag_stands_twice(command: type[Options]) -> None:
    names = [flag.name for flag in flags(command)]
    assert len(set(names)) == len(names)


def test_a_repeated_flag_adds_up() -> None:
    arguments = ["soma3", "--analyzer", "grounded", "--analyzer", "mine:own"]
    assert parse(RunArguments, arguments, "x").episode.planner.analyzers == ("grounded", "mine:own")


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        (plan, ["soma3", "--feed.noise-mm", "1"]),
        (plan, ["soma3", "--search.lines", "1"]),
        (run_episode, ["soma3", "--vary", "feed"]),
        (evaluate, ["soma3", "--feed.square"]),
    ],
)
def test_a_stage_that_has_no_such_option_says_so(
    command: Any, arguments: list[str], capsys: Captured
) -> None:
    with pytest.raises(SystemExit) as ended:
        command(arguments)
    assert ended.value.code == 2 and arguments[1] in capsys.readouterr().err


# --- ranges -------------------------------------------------------------------------------------------------


def ranged() -> list[tuple[Flag, float]]:
    """Options with a range, and a value that is just out of it, on either side."""
    found = []
    for flag in EPISODE:
        for rule in bare(flag.kind)[1]:
            if isinstance(rule, Range):
                low = rule.low if rule.above else rule.low - 1
                found += [(flag, value) for value in (low, rule.high + 1) if abs(value) < float("inf")]
    return found


@pytest.mark.parametrize(("flag", "value"), ranged(), ids=lambda part: getattr(part, "name", str(part)))
def test_a_value_out_of_range_is_refused(
    flag: Flag, value: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Captured
) -> None:
    monkeypatch.setattr(episodes, "run_episode", receiver(1))
    monkeypatch.chdir(tmp_path)
    assert run_episode(["soma3", flag.name, f"{value:.10g}"]) == 2
    written = capsys.readouterr()
    assert written.err.startswith(f"error: options: {flag.name} {value:.10g}"[:60].rstrip("0123456789."))
    assert written.err.count("must") == 1 and written.out == "" and list(tmp_path.iterdir()) == []


def test_python_is_told_the_same() -> None:
    options = EpisodeOptions(seed=-1, feed=dataclasses.replace(EpisodeOptions().feed, noise_mm=-1.0))
    with pytest.raises(InputError) as refused:
        episodes.run_episode("soma3", options)
    assert refused.value.faults == (
        "--seed -1: must be from 0 to 2147483647",
        "--feed.noise-mm -1: must not be negative",
    )


def test_a_seed_of_the_planners_own_is_refused() -> None:
    with pytest.raises(InputError, match="planner.seed = 3: must be left alone"):
        episodes.run_episode("soma3", EpisodeOptions(planner=PlannerOptions(seed=3)))


# --- how they stand -----------------------------------------------------------------------------------------


def kinds(root: type[Options]) -> set[type[Options]]:
    """All dataclasses of options in one."""
    return {root} | {flag.owner for flag in flags(root)}


@pytest.mark.parametrize("kind", sorted(kinds(EvaluationOptions), key=lambda kind: kind.__name__))
def test_every_option_is_frozen_typed_and_documented(kind: type[Options]) -> None:
    assert kind.__dataclass_params__.frozen  # type: ignore[attr-defined]
    assert set(documentation(kind)) == {field.name for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    assert inspect.getdoc(kind)


def test_the_defaults_are_in_range() -> None:
    assert EpisodeOptions(film=FilmOptions()).faults() == []


OWN = {"soma_bullet.option", "soma_bullet.assembly.advice"}
LEAVES = sorted({Path(inspect.getfile(kind)) for kind in kinds(EpisodeOptions)})


@pytest.mark.parametrize("path", LEAVES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_options_are_leaves(path: Path) -> None:
    """They import what types and dataclasses need, and other options."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else [node.module or ""]
            for name in names:
                leaf = name in OWN or name.endswith("options")
                assert leaf or name in {"__future__", "collections.abc", "dataclasses", "os", "typing"}, name


def test_no_command_has_a_default_of_its_own() -> None:
    """What is an option of a stage stands in its module alone."""
    owned = {field.name for kind in kinds(EpisodeOptions) for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    for command in COMMANDS:
        own = {field.name for field in dataclasses.fields(command)}  # type: ignore[arg-type]
        assert own & owned <= {"film", "planner", "cell", "hand", "jobs"}, command


def test_cameras_and_renderers_are_those_that_there_are() -> None:
    assert get_args(CameraName) == ("auto", *CAMERAS) and get_args(RendererName) == RENDERERS


# --- what the documents say ---------------------------------------------------------------------------------

FLAG = re.compile(r"(?<![\w-])--[a-z][a-z0-9.-]*[a-z0-9]")
SCRIPTS = {path.stem for path in (ROOT / "scripts").glob("*.py")}
INSTALLED = {
    "soma-plan": "plan", "soma-episode": "run_episode", "soma-evaluate": "evaluate", "soma-render": "render",
    "soma-compare": "compare_runs", "soma-doctor": "doctor", "soma-benchmark": "benchmark",
    "soma-figure": "figure",
}  # fmt: skip
TIMINGS = ("stages", "planner", "cube240", "motion", "simulate", "episode")
ELSEWHERE = ("pip ", "python -m pip", "git ", "apt-get ", "make ")  # commands that are not ours


@cache
def offered(script: str, timing: str = "") -> frozenset[str]:
    """The flags that a script has, by its own help."""
    command = [
        sys.executable,
        str(ROOT / "scripts" / f"{script}.py"),
        *([timing] if timing else []),
        "--help",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    return frozenset(FLAG.findall(done.stdout))


def snippets(text: str) -> list[str]:
    """Lines of blocks of code, and spans of code."""
    blocks = re.findall(r"```[^\n]*\n(.*?)```", text, re.DOTALL)
    rest = re.sub(r"```[^\n]*\n.*?```", "", text, flags=re.DOTALL)
    return [line for block in blocks for line in block.splitlines()] + re.findall(r"`([^`]+)`", rest)


def commands(snippet: str) -> list[tuple[str, str]]:
    """The scripts, and the timings of the benchmark, that a snippet is about; all where it names none."""
    names = [name for name in SCRIPTS if re.search(rf"\b{name}\.py\b", snippet)]
    names += [script for name, script in INSTALLED.items() if re.search(rf"\b{name}\b", snippet)]
    words = snippet.split()
    timings = [word for word in TIMINGS if word in words]
    if "benchmark" in names or (not names and words[0] in TIMINGS):
        return [("benchmark", timing) for timing in timings] or [("benchmark", "")]
    if names:
        return [(name, "") for name in names]
    return [(name, "") for name in sorted(SCRIPTS)]


NAMED = [
    (path.name, snippet, flag)
    for path in DOCUMENTS
    for snippet in snippets(path.read_text(encoding="utf-8"))
    if not snippet.strip().startswith(ELSEWHERE)
    for flag in FLAG.findall(snippet)
]


def test_the_documents_name_flags() -> None:
    assert len({flag for _, _, flag in NAMED}) > 20


@pytest.mark.parametrize(("document", "snippet", "flag"), NAMED)
def test_a_flag_that_a_document_names_is_there(document: str, snippet: str, flag: str) -> None:
    places = commands(snippet)
    assert any(flag in offered(*place) for place in places), f"{document}: `{snippet}`: no {flag}"
