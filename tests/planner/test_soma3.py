"""The paper's three-block case: a wall one cell thick that stands on one cell. The figures are those of the
design notes."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from soma_bullet.assembly.model import Assembly
from soma_bullet.errors import InputError, NoSolutionError
from soma_bullet.grasp.hand import Hand
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.equilibrium import classify
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.plan import make_plan
from soma_bullet.planner.qualities import Qualities
from soma_bullet.planner.remarks import TURNS
from soma_bullet.records import read_json, write_json

ROOT = Path(__file__).resolve().parents[2]
HALF = math.sqrt(0.5)


def named(assembly: Assembly, *names: str) -> frozenset[int]:
    return frozenset(assembly.index(name) for name in names)


@pytest.fixture(scope="module")
def equilibrium(soma3: Assembly, hand: Hand) -> AssemblyPlan:
    return make_plan(soma3, HandSet.alike(hand))


@pytest.fixture(scope="module")
def paper(soma3: Assembly, hand: Hand) -> AssemblyPlan:
    return make_plan(soma3, HandSet.alike(hand), PlannerOptions(stability="paper"))


@pytest.fixture(scope="module")
def qualities(soma3: Assembly, hand: Hand) -> Qualities:
    return Qualities(soma3, HandSet.alike(hand), PlannerOptions(stability="paper"))


@pytest.mark.parametrize("name", ["BigL", "smallL", "Z"])
def test_alone_every_piece_falls(soma3: Assembly, qualities: Qualities, name: str) -> None:
    alone = named(soma3, name)
    assert qualities.paper_stability(soma3.index(name), alone) == 0.0
    assert classify(soma3, alone).verdict == "unstable"
    assert classify(soma3, alone).quality == 0.0


def test_the_finished_wall_is_robust(soma3: Assembly) -> None:
    final = classify(soma3, frozenset(range(3)))
    assert final.verdict == "robust"
    assert final.margin == pytest.approx(0.1525, abs=5e-5)  # tipping along y: 0.1525 = 9 / 59
    assert final.margin == pytest.approx(9 / 59, abs=1e-6)


@pytest.mark.parametrize(
    ("placed", "held", "verdict"),
    [
        (("Z",), ("Z",), "robust"),
        (("Z", "BigL"), (), "unstable"),
        (("Z", "BigL"), ("BigL",), "robust"),
        (("Z", "BigL"), ("Z",), "unstable"),
        (("BigL", "smallL"), (), "unstable"),
        (("BigL", "smallL"), ("BigL",), "clearance-dependent"),
        (("Z", "smallL"), (), "unstable"),
        (("Z", "smallL"), ("Z",), "robust"),
        (("Z", "smallL"), ("smallL",), "unstable"),  # it would take preload
    ],
)
def test_what_has_to_be_held(
    soma3: Assembly, placed: tuple[str, ...], held: tuple[str, ...], verdict: str
) -> None:
    assert classify(soma3, named(soma3, *placed), named(soma3, *held)).verdict == verdict


def test_the_lean_of_smallL_on_BigL(soma3: Assembly) -> None:
    """By hand, in cells and weights: the pivot is BigL's upper edge, the centre of mass 1/6 beyond and 1/6
    above it, the side pushes back by N at a lever of 1. Moments: N = (1 + t) / 6. Friction on top: N + t <=
    0.5. So t = 2/7."""
    state = classify(soma3, named(soma3, "BigL", "smallL"), named(soma3, "BigL"))
    assert state.margin == 0.0
    assert state.margin_sides == pytest.approx(2 / 7, rel=0.02)  # the friction cone has twelve sides


def test_paper_mode_picks_the_fifth_order(soma3: Assembly, paper: AssemblyPlan) -> None:
    assert soma3.names == ("BigL", "smallL", "Z")
    assert paper.order == ("Z", "BigL", "smallL")
    assert list(permutations(soma3.names))[4] == paper.order
    best, runner_up = paper.orders[:2]
    assert best.order == paper.order
    assert min(best.s_recomputed) == pytest.approx(0.290, abs=5e-4)
    assert best.s_recomputed == pytest.approx((math.inf, 2.19, 0.29), abs=2e-3)
    assert best.held == (("Z",), ("BigL",), ())
    assert runner_up.order == ("BigL", "Z", "smallL")
    assert paper.ties == ()


def test_paper_mode_warns_of_a_state_that_falls(
    soma3: Assembly, qualities: Qualities, paper: AssemblyPlan
) -> None:
    placed = named(soma3, "Z", "smallL")
    assert qualities.paper_stability(soma3.index("smallL"), placed) == pytest.approx(0.087, abs=5e-4)
    assert qualities.paper_stability(soma3.index("Z"), placed) == pytest.approx(1.516, abs=5e-4)
    (warning,) = paper.warnings
    assert "{smallL, Z}" in warning
    assert "smallL 0.087, Z 1.516" in warning


def test_paper_mode_reports_what_the_frame_of_the_hexagon_does(paper: AssemblyPlan) -> None:
    assert TURNS == 12
    found = {(len(entry.state), entry.piece): entry for entry in paper.sensitivity}
    for k, name in enumerate(paper.order):
        entry = found[k + 1, name]
        assert entry.state == paper.order[: k + 1]
        assert entry.low <= entry.s <= entry.high
        assert entry.s == pytest.approx(paper.orders[0].s[k])
    lean = found[2, "BigL"]  # what other tangents than the pinned ones would say
    assert lean.s == 0.0
    assert 0.011 < lean.high < 0.25
    last = found[3, "smallL"]
    assert last.low < last.s < last.high


def test_a_hexagon_turned_by_a_sixth_is_the_same(soma3: Assembly, qualities: Qualities) -> None:
    everything = frozenset(range(3))
    for piece in everything:
        turned = qualities.paper_stability(piece, everything, np.pi / 3)
        assert turned == pytest.approx(qualities.paper_stability(piece, everything), abs=2e-7)


@pytest.mark.parametrize("mode", ["equilibrium", "paper"])
def test_both_modes_insert_alike(request: pytest.FixtureRequest, mode: str) -> None:
    plan: AssemblyPlan = request.getfixturevalue(mode)
    assert plan.order == ("Z", "BigL", "smallL")
    assert [tuple(hold.piece for hold in step.holds) for step in plan.steps] == [("Z",), ("BigL",), ()]
    assert plan.steps[0].direction == (0.0, 0.0, -1.0)
    # removal is (0, -1, 1) and (0, 1, 1), assembly the other way
    assert plan.steps[1].direction == pytest.approx((0.0, HALF, -HALF), abs=1e-9)
    assert plan.steps[2].direction == pytest.approx((0.0, -HALF, -HALF), abs=1e-9)
    assert [step.type for step in plan.steps] == ["plane", "wedge", "wedge"]
    assert all(step.verdict == "robust" for step in plan.steps)
    for step in plan.steps:
        assert step.grasps
        for hold in step.holds:
            assert hold.grasp in hold.grasps and hold.certificate.margin >= 1.0 and not hold.taken


@pytest.mark.parametrize("mode", ["equilibrium", "paper"])
def test_every_order_has_its_row(request: pytest.FixtureRequest, soma3: Assembly, mode: str) -> None:
    plan: AssemblyPlan = request.getfixturevalue(mode)
    assert {row.order for row in plan.orders} == set(permutations(soma3.names))
    assert [row.score for row in plan.orders] == sorted((row.score for row in plan.orders), reverse=True)
    for row in plan.orders:
        assert {
            len(field)
            for field in (row.s, row.s_recomputed, row.g, row.a, row.types, row.directions, row.held)
        } == {3}
        assert not row.stable_throughout  # all six orders have states that fall
        if row.feasible:
            assert row.score == pytest.approx(min(row.s_recomputed) * min(row.g) * min(row.a))
        elif mode == "equilibrium":
            assert row.score == 0.0 and row.reason


def test_equilibrium_mode_says_what_holds_do(equilibrium: AssemblyPlan) -> None:
    best = equilibrium.orders[0]
    assert best.held == (("Z",), ("BigL",), ())
    assert best.s == pytest.approx((0.0, 0.0, 9 / 59), abs=1e-6)
    assert best.s_recomputed == pytest.approx((1.0, 1.0, 9 / 59), abs=1e-6)
    leaning = next(row for row in equilibrium.orders if row.order == ("BigL", "smallL", "Z"))
    assert 0 < leaning.s_recomputed[1] <= 1e-3  # clearance-dependent: below every robust state
    assert equilibrium.warnings == () and equilibrium.sensitivity == ()


def test_an_excluded_order_is_not_taken(soma3: Assembly, hand: Hand, equilibrium: AssemblyPlan) -> None:
    second = make_plan(soma3, HandSet.alike(hand), excluded=frozenset({equilibrium.order}))
    assert second.order == ("BigL", "Z", "smallL")
    assert "nothing carries BigL when it is placed" in second.warnings[0]  # no other does without
    two = make_plan(soma3, HandSet.alike(hand), PlannerOptions(top=2))
    assert two.order == equilibrium.order and two.alternatives == ()
    with pytest.raises(NoSolutionError, match="orders of soma3"):
        make_plan(soma3, HandSet.alike(hand), excluded=frozenset(permutations(soma3.names)))


def test_one_hand_is_not_enough(soma3: Assembly, hand: Hand) -> None:
    with pytest.raises(NoSolutionError, match="there is no hand to spare"):
        make_plan(soma3, HandSet.alike(hand), PlannerOptions(hands=1))


def test_what_cannot_stand_in_the_end_is_refused(soma3: Assembly, hand: Hand) -> None:
    lean = replace(soma3, name="lean", pieces=(soma3.pieces[0], soma3.pieces[2]), goals=soma3.goals[[0, 2]])
    for mode in ("equilibrium", "paper"):
        with pytest.raises(InputError, match="not stable.*holding BigL would keep it up"):
            make_plan(lean, HandSet.alike(hand), PlannerOptions(stability=mode))


@pytest.mark.parametrize("mode", ["equilibrium", "paper"])
def test_the_plan_survives_its_file(request: pytest.FixtureRequest, tmp_path: Path, mode: str) -> None:
    plan: AssemblyPlan = request.getfixturevalue(mode)
    write_json(plan, tmp_path / "plan.json")
    again = read_json(AssemblyPlan, tmp_path / "plan.json")
    write_json(again, tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "plan.json").read_bytes()
    assert again.order == plan.order and again.steps == plan.steps and again.orders == plan.orders
    for table, other in zip(plan.grasps, again.grasps, strict=True):
        np.testing.assert_array_equal(table.poses, other.poses)
        assert not other.poses.flags.writeable


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["equilibrium", "paper"])
def test_two_processes_write_the_same_bytes(tmp_path: Path, mode: str) -> None:
    code = (
        "import sys; from pathlib import Path; from soma_bullet.assembly.file import load_assembly; "
        "from soma_bullet.grasp.hand import load_hand; from soma_bullet.grasp.hand_set import HandSet; "
        "from soma_bullet.planner.plan import "
        "PlannerOptions, make_plan; "
        "from soma_bullet.records import write_json; "
        "plan = make_plan(load_assembly('soma3'), HandSet.alike(load_hand(sys.argv[1])), "
        "PlannerOptions(stability=sys.argv[2])); "
        "write_json(plan, Path(sys.argv[3]))"
    )
    for seed in ("1", "2"):
        command = [
            sys.executable,
            "-c",
            code,
            str(ROOT / "robots/ur5e_pair/hand.toml"),
            mode,
            str(tmp_path / f"{seed}.json"),
        ]
        environment = os.environ | {"PYTHONHASHSEED": seed, "PYTHONPATH": str(ROOT)}
        subprocess.run(command, cwd=ROOT, env=environment, check=True, timeout=120)
    assert (tmp_path / "1.json").read_bytes() == (tmp_path / "2.json").read_bytes()
