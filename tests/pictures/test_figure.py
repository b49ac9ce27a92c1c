"""The figure of orders: every number and name as text, a still a step, the minima framed, the chosen order
marked."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from soma_bullet.assembly.model import Assembly
from soma_bullet.errors import InputError
from soma_bullet.grasp.hand import Hand, load_hand
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.pictures import still
from soma_bullet.pictures.figure import Layout, best_rows, draw_orders, minima, number
from soma_bullet.pictures.shapes import hand_body, spread_grasps
from soma_bullet.pictures.still import GROUPS, Scene, StepStills
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.qualities import Qualities

ROOT = Path(__file__).resolve().parents[2]
SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture
def blank(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stills without rendering, for what does not depend on what they show."""

    def image(self: StepStills, scene: Scene, feasible: bool = True) -> np.ndarray:
        return np.full((self.height, self.width, 4), 200 if feasible else 100, np.uint8)

    monkeypatch.setattr(StepStills, "image", image)


def read(path: Path) -> tuple[list[str], list[str]]:
    """Texts and ids of an SVG."""
    root = ElementTree.parse(path).getroot()
    texts = ["".join(element.itertext()).strip() for element in root.iter(f"{SVG}text")]
    return texts, [element.get("id", "") for element in root.iter()]


@pytest.mark.parametrize(
    ("values", "framed"),
    [
        ((0.0, 2.0, 1.0), [(0, 1)]),
        ((0.0, 0.0, 1.0), [(0, 1), (1, 2)]),
        ((3, 3, 3), [(0, 3)]),
        ((math.inf, math.inf), [(0, 2)]),
        ((math.inf, 10.0, 3.0), [(2, 3)]),
        ((0.3, 0.1 + 0.2, 1.0), [(0, 1), (1, 2)]),
    ],
)
def test_the_smallest_are_framed(values: tuple[float, ...], framed: list[tuple[int, int]]) -> None:
    assert minima(values) == framed


def test_numbers_are_short() -> None:
    assert [number(v) for v in (math.inf, 0.0, 10.0, 2.1910639, 0.290211, 631)] == [
        "∞",
        "0",
        "10",
        "2.19",
        "0.29",
        "631",
    ]


@pytest.mark.parametrize("steps", [1, 2, 3, 4, 5, 7, 8, 9, 12])
def test_groups_do_not_overlap_and_lie_on_the_sheet(steps: int) -> None:
    layout = Layout(steps, (False, True, False))
    assert layout.lines * layout.across == 4
    places = [layout.group(row, group) for row in range(3) for group in GROUPS]
    for k, (left, top) in enumerate(places):
        assert left > 0 and left + steps * layout.cell < layout.width - 0.7
        assert top > 0 and top + layout.cell < layout.height - 0.6
        for other_left, other_top in places[:k]:
            beside = abs(left - other_left) >= steps * layout.cell
            assert beside or abs(top - other_top) >= layout.cell + 0.2


def test_the_chosen_order_is_always_shown(plan: AssemblyPlan) -> None:
    assert best_rows(plan, 6) == plan.orders
    late = replace(plan, order=plan.orders[4].order)
    assert best_rows(late, 2) == (plan.orders[0], plan.orders[4])


@pytest.mark.usefixtures("blank")
def test_all_of_the_plan_stands_in_the_figure(
    soma3: Assembly, hand: Hand, plan: AssemblyPlan, tmp_path: Path
) -> None:
    texts, ids = read(draw_orders(soma3, HandSet.alike(hand), plan, tmp_path / "orders.svg"))
    assert len([name for name in ids if re.fullmatch(r"still-\d-\w+-\d", name)]) == 6 * 4 * 3
    for row in plan.orders:
        for value in (*row.s, *row.g, *row.a):
            assert number(value) in texts
        for held, value in zip(row.held, row.s_recomputed, strict=True):
            assert f"{' + '.join(held) or 'none'}, {number(value)}" in texts
        assert number(row.score) in texts
    for name in soma3.names:
        assert texts.count(name) == len(plan.orders) + 1  # in every order, and in the legend
    assert {"stability S", "graspability G", "assisting grasps", "assemblability A"} <= set(texts)
    assert any(
        text.startswith("soma3: all 6 orders") and "paper mode" in text and "slim_hand" in text
        for text in texts
    )
    assert ids.count("chosen") == 1
    assert texts.count("chosen order") == 1


@pytest.mark.usefixtures("blank")
def test_the_minima_of_each_order_are_framed(
    soma3: Assembly, hand: Hand, plan: AssemblyPlan, tmp_path: Path
) -> None:
    _, ids = read(draw_orders(soma3, HandSet.alike(hand), plan, tmp_path / "orders.svg", rows=2))
    framed = sorted(name for name in ids if name.startswith("minimum-0"))
    assert framed == [
        "minimum-0-assemblability-0-3",
        "minimum-0-assisting-2-3",
        "minimum-0-graspability-2-3",
        "minimum-0-stability-0-1",
        "minimum-0-stability-1-2",
    ]


@pytest.mark.usefixtures("blank")
def test_an_order_that_cannot_be_built_says_why(
    soma3: Assembly, hand: Hand, plan: AssemblyPlan, tmp_path: Path
) -> None:
    lost = replace(
        plan.orders[1],
        feasible=False,
        reason="Z has no straight way in",
        directions=(None, None, None),
        score=0.0,
        g=(0, 0, 0),
    )
    texts, _ = read(
        draw_orders(
            soma3, HandSet.alike(hand), replace(plan, orders=(plan.orders[0], lost)), tmp_path / "orders.svg"
        )
    )
    assert "cannot be built: Z has no straight way in" in texts
    assert "infeasible" in texts


def test_another_format_is_refused(soma3: Assembly, hand: Hand, plan: AssemblyPlan, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.png, \.svg, \.pdf"):
        draw_orders(soma3, HandSet.alike(hand), plan, tmp_path / "orders.gif", rows=1)


def test_stills_show_pieces_and_hands(soma3: Assembly, hand: Hand, plan: AssemblyPlan) -> None:
    stills = StepStills(soma3, Qualities(soma3, HandSet.alike(hand), plan.options), 80, 80)
    (scenes,) = stills.frame(plan.orders[:1])
    assert [len(scene.bodies) for scene in scenes["stability"]] == [1, 2, 3]
    for step, scene in enumerate(scenes["graspability"]):
        assert [b.alpha < 1 for b in scene.bodies].count(False) == step + 1
        assert 1 <= [b.alpha < 1 for b in scene.bodies].count(True) <= 4
    assert [any(b.alpha < 1 for b in scene.bodies) for scene in scenes["assisting"]] == [True, True, False]
    assert [b.on_top for b in scenes["assemblability"][2].bodies] == [False, False, False, True]
    picture = stills.image(scenes["assisting"][0])
    red = (picture[..., 0] > picture[..., 1].astype(int) + 60) & (picture[..., 3] > 0)
    assert red.mean() > 0.02
    assert stills.image(scenes["assisting"][0]) is picture


def test_each_grasp_is_drawn_with_its_own_hand(
    soma3: Assembly, hand: Hand, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = load_hand(ROOT / "tests/data/mixed_pair/hand.toml")
    judge = Qualities(soma3, HandSet.of([hand, small]), PlannerOptions())
    drawn: list[Hand] = []
    monkeypatch.setattr(still, "hand_body", lambda shown, *_: drawn.append(shown))
    for kind in range(2):
        chosen = np.flatnonzero(judge.grasps(0).kinds == kind)
        StepStills(soma3, judge, 80, 80)._hands(0, chosen, (0.0, 1.0, 0.0), 3)
        assert drawn and set(shown.name for shown in drawn) == {judge.hands.kinds[kind].name}
        drawn.clear()


def test_a_drawn_hand_ends_where_it_is_cut(hand: Hand) -> None:
    whole, short = (hand_body(hand, np.eye(4), 0.03, (0.0, 1.0, 0.0), 0.5, depth) for depth in (1.0, 0.04))
    assert short.triangles[..., 2].min() == pytest.approx(-0.047, abs=1e-6)  # the cut and the bar behind it
    assert short.triangles[..., 2].max() == pytest.approx(whole.triangles[..., 2].max())
    assert whole.triangles[..., 2].min() < -0.07


def test_drawn_grasps_are_few_and_differ() -> None:
    Ts = np.tile(np.eye(4), (50, 1, 1))
    Ts[:, 0, 3] = np.linspace(0, 1, 50)
    chosen = spread_grasps(Ts, 3, np.array((0.0, 0.0, 1.0)))
    assert len(set(chosen.tolist())) == 3
    assert np.ptp(Ts[chosen, 0, 3]) == 1.0
    assert len(spread_grasps(Ts[:0], 3, np.array((0.0, 0.0, 1.0)))) == 0


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["png", "svg", "pdf"])
def test_the_whole_figure_is_deterministic(
    ending: str, soma3: Assembly, hand: Hand, plan: AssemblyPlan, tmp_path: Path
) -> None:
    first, second = (
        draw_orders(soma3, HandSet.alike(hand), plan, tmp_path / f"{k}.{ending}").read_bytes() for k in "ab"
    )
    assert first == second
    assert ending != "png" or len(first) < 600_000
