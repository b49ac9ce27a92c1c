"""From a drawing to a plan, and the command line on top."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

import soma_bullet as sb
from soma_bullet.assembly.file import load_assembly
from soma_bullet.cli.figure import figure
from soma_bullet.errors import InputError, NoSolutionError
from soma_bullet.figure.choice import NoFigurePlanError
from soma_bullet.figure.drawing import Drawing, drawing_of
from soma_bullet.figure.examine import LAST, STANDS, examine
from soma_bullet.figure.model import packed
from soma_bullet.figure.options import FigureOptions
from soma_bullet.figure.packing import NoPackingError, Packing
from soma_bullet.figure.plan_figure import plan_figure
from soma_bullet.figure.sides import NowhereStandsError
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.qualities import Qualities
from soma_bullet.records import read_json
from soma_bullet.robot.cell import find_hand

HANDS = HandSet.alike(find_hand("ur5e_pair"))
FLAT = "LLL.VV\nL...V.\n"
CUBE = [["###"] * 3] * 3
HANGING = [["VV", "V."], ["."], ["."], [".", ".", ".", "....LLL", "....L.."]]  # corner to corner
Captured = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def drawn(text: str, name: str = "drawn.txt") -> str:
    Path(name).write_text(text, encoding="utf-8")
    return name


def packing_of(layers: list[list[str]]) -> Packing:
    packing = drawing_of(layers, "x").packing
    assert packing is not None
    return packing


def test_a_packing_is_the_same_assembly_in_memory_and_on_disk() -> None:
    found = plan_figure(drawing_of([["LLL.VV", "L...V."]], "two"), HANDS)
    path = found.write(Path("out"))
    loaded = load_assembly(path)
    assert loaded.names == found.assembly.names == ("V", "L")
    assert np.abs(loaded.goals - found.assembly.goals).max() < 1e-12
    for ours, theirs in zip(found.assembly.pieces, loaded.pieces, strict=True):
        assert np.array_equal(ours.vertices, theirs.vertices) and np.array_equal(ours.color, theirs.color)
    assert found.side == "as-drawn" and found.layers == "LLL.VV\nL...V.\n"
    assert sorted(path.name for path in Path("out").iterdir()) == ["L.obj", "V.obj", "two.toml"]


def test_pieces_of_one_kind_have_names_of_their_own() -> None:
    found = plan_figure(drawing_of([["###.###", "#...#.."]], "x"), HANDS, FigureOptions(pieces="LL"))
    assert found.assembly.names == ("L", "L2") and found.packings.placed == 1


def test_no_packing_is_proven_unless_the_nodes_are_spent() -> None:
    square = drawing_of([["##", "##"]], "square")
    with pytest.raises(NoPackingError, match=r"do not fill its 4 cells; the search was complete"):
        plan_figure(square, HANDS)
    with pytest.raises(NoPackingError, match="no packing of cube was found within 5 nodes; --nodes"):
        plan_figure(drawing_of(CUBE, "cube"), HANDS, FigureOptions(nodes=5))


def test_what_stands_on_no_side_is_told_side_by_side() -> None:
    hanging = drawing_of(HANGING, "hanging")
    with pytest.raises(NowhereStandsError, match=r"any of its \d sides(.|\n)*as-drawn: \d of its cells hang"):
        plan_figure(hanging, HANDS)


def test_what_cannot_be_planned_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    lonely = Drawing("lonely", packing_of([["VV", "V."]])[0][1], packing_of([["VV", "V."]]))
    none = PlannerOptions(analyzers=("tests_figure_never:never",))
    Path("tests_figure_never.py").write_text(
        "from soma_bullet.planner.analyzers import Judgement\n"
        "def never(qualities, placed, piece):\n    return Judgement(0.0, 'never')\n"
    )
    monkeypatch.syspath_prepend(str(Path.cwd()))
    with pytest.raises(NoFigurePlanError, match="no packing of the 3 looked at can be built") as refused:
        plan_figure(lonely, HANDS, planner=none)
    assert refused.value.proven and "never" in str(refused.value)
    assert [survey.obstacles for survey in refused.value.surveys] == [{LAST: 1}] * 3


def test_a_packing_that_falls_is_not_planned() -> None:
    tall = packing_of([["..V", "..."], ["..V", "..V"], ["LLL", "L.."]])
    falls = examine(Qualities(packed("x", tall), HANDS, PlannerOptions().with_hands()), range(2))
    assert (falls.outlook, falls.obstacle) == ("impossible", STANDS) and "resists" in falls.reason


def test_the_face_offers_it() -> None:
    assert sb.plan_figure is plan_figure and sb.FigureOptions is FigureOptions
    with pytest.raises(InputError, match="--tries 0: must be at least 1"):
        sb.plan_figure("nowhere.txt", HANDS, sb.FigureOptions(tries=0))


@pytest.mark.slow
def test_a_figure_of_seven_pieces_is_planned() -> None:
    layers = [
        ["##...##", "##...##", "#######", ".#####.", "..###..", "...#..."],
        ["#.....#", ".......", ".......", ".......", "...#...", "......."],
    ]
    found = plan_figure(drawing_of(layers, "arch"), HANDS)
    assert found.packings.placed == 8 and found.packings.complete
    assert len(found.plan.order) == 7 and found.plan.warnings == ()
    again = plan_figure(drawing_of(layers, "arch"), HANDS)
    assert again.packing == found.packing and again.plan.order == found.plan.order


# --- the command line ---------------------------------------------------------------------------------------


def said(capsys: Captured) -> str:
    captured = capsys.readouterr()
    assert captured.out == ""
    return re.sub(r"\s+", " ", captured.err)


def test_a_drawing_is_planned_and_written(capsys: Captured) -> None:
    assert figure([drawn(FLAT)]) == 0
    text = said(capsys)
    assert "drawn: 1 packings, 1 as placed" in text and "chosen: as drawn" in text and "LLL.VV" in text
    out = Path("runs/figure/drawn")
    written = {"L.obj", "V.obj", "drawn.toml", "exploded.png", "orders.png", "plan.json"}
    assert {path.name for path in out.iterdir()} == written
    assert read_json(AssemblyPlan, out / "plan.json").digest == load_assembly(out / "drawn.toml").digest


@pytest.mark.slow
def test_a_drawing_is_built() -> None:
    assert figure([drawn(FLAT), "--build", "--no-video", "--out", "built"]) == 0
    assert json.loads(Path("built/report.json").read_text())["success"]


@pytest.mark.parametrize(
    ("text", "arguments", "status", "message"),
    [
        ("##\n##\n", [], 3, "error: packing: no packing of drawn: .* search was complete"),
        ("#####\n", [], 2, "has 5 cells; some of the pieces V, L, T, Z, A, B, P have 3, 4, 7, 8, "),
        ("", [], 2, "has no cells"),
        ("VVV\nL..\n", [], 2, "letter 'V': is no piece"),
        (FLAT, ["--pieces", "LT"], 2, "drawn: has the piece V; --pieces LT"),
        (FLAT, ["--pieces", "Q"], 2, "--pieces: 'Q': there is no piece Q"),
        (FLAT, ["--plans", "0", "--looks", "0"], 2, "2 faults - --plans 0.* - --looks 0"),
        (FLAT, ["--feed.noise-mm", "1"], 2, "--feed.noise-mm 1: counts only with --build"),
        (FLAT, ["--out", "drawn.txt"], 2, "--out: drawn.txt cannot be a folder"),
        ("#..\n\n###\n", ["--side", "as-drawn"], 3, "cannot stand on the side that was looked at"),
    ],
)
def test_what_ends_it_has_its_status(
    text: str, arguments: list[str], status: int, message: str, capsys: Captured
) -> None:
    assert figure([drawn(text), *arguments]) == status
    told = said(capsys)
    assert re.search(message, told), told
    assert [path.name for path in Path.cwd().iterdir()] == ["drawn.txt"]


def test_a_single_piece_is_a_figure_too() -> None:
    assert figure([drawn("##\n#.\n")]) == 0


def test_packings_are_listed_on_request(capsys: Captured) -> None:
    assert figure([drawn("####\n####\n"), "--packings", "1", "--pieces", "LL"]) == 0
    text = said(capsys)
    assert "packing 1 of 1" in text and "the search ended before it had found all" in text


def test_errors_are_of_the_house() -> None:
    for kind in (NoPackingError, NowhereStandsError, NoFigurePlanError):
        assert issubclass(kind, NoSolutionError) and kind.exit_status == 3


@pytest.mark.slow
def test_a_figure_of_seven_pieces_is_built() -> None:
    """From the drawing to the judged episode; no placed piece is moved by a millimetre."""
    layers = [
        "###.#####\n#.#......\n##.......",
        "###.#####\n#........\n#........",
        "....#####\n.........\n.........",
    ]
    assert figure([drawn("\n\n".join(layers)), "--build", "--no-video", "--out", "built"]) == 0
    report = json.loads(Path("built/report.json").read_text())
    assert report["success"] and max(i["neighbours_mm"] for i in report["judgement"]["insertions"]) < 1.0


def test_a_packing_that_has_no_schedule_is_passed_over() -> None:
    drawing = drawing_of([["###", "###"], ["###", "###"]], "box")
    first = plan_figure(drawing, HANDS)
    other = plan_figure(drawing, HANDS, refused=frozenset({first.packing}))
    assert other.packing != first.packing
    assert any("1 without a schedule" in survey.text() for survey in other.surveys)


def test_a_figure_of_any_name_can_be_loaded_again() -> None:
    found = plan_figure(drawing_of([["LLL.VV", "L...V."]], "2x3 + one, \u00fc"), HANDS)
    assert load_assembly(found.write(Path("out"))).name == found.name == "2x3_one_\u00fc"
