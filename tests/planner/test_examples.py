"""Every example assembly plans, and the plan says what an engineer would say."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from soma_bullet.assembly.contacts import SUPPORT
from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.grasp.hand import load_hand
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.options import HoldLoad, PlannerOptions
from soma_bullet.planner.plan import NoPlanError, make_plan

ROOT = Path(__file__).resolve().parents[2]
DOWN, ALONG_X, AGAINST_X = (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)


@dataclass(frozen=True)
class Facts:
    """What is true of every sensible plan of an example.

    Attributes:
        before: pairs of pieces of which the first goes in first.
        last: what can only go in at the end, if anything.
        ways: assembly directions and types of pieces that have no other; None for either direction of the
            axis y.
        holds: least number of states that a hand has to hold up.
    """

    before: tuple[tuple[str, str], ...] = ()
    last: str | None = None
    ways: dict[str, tuple[tuple[float, float, float] | None, str]] = field(default_factory=dict)
    holds: int = 0


FACTS = {
    "dowel": Facts((("block", "dowel"),), "dowel", {"dowel": (DOWN, "peg blind")}),
    "bracket": Facts((), "bracket", {"bracket": (DOWN, "slot + bottom")}),
    "sliding_lid": Facts(
        (("box", "cargo"),), "lid", {"cargo": (DOWN, "plane"), "lid": (ALONG_X, "peg blind")}
    ),
    "crate": Facts(
        (("box", "lower"),), "upper", {"lower": (DOWN, "slot + bottom"), "upper": (DOWN, "peg blind")}
    ),
    "dovetail": Facts((), "pin", {"pin": (DOWN, "peg blind")}),
    "hinge": Facts((), "pin", {"pin": (AGAINST_X, "peg blind")}),
    "wedge_clamp": Facts(),
    "stool": Facts(
        tuple(("seat", f"leg_{k}") for k in "abc"), None, {f"leg_{k}": (DOWN, "peg blind") for k in "abc"}
    ),
    "tower": Facts(
        (("foot", "large"), ("large", "middle"), ("middle", "small")),
        "knob",
        {name: (DOWN, "peg blind") for name in ("large", "middle", "small", "knob")},
    ),
    "gears": Facts((("plate", "left_shaft"), ("plate", "right_shaft"))),
    "leaning_bridge": Facts(
        (("left_over", "rafter_under"), ("right_over", "rafter_under"), ("left_under", "rafter_under")),
        None,
        holds=3,
    ),
    "arch": Facts(holds=2),
    "dominoes": Facts((("block", "first"), ("first", "second"), ("second", "third"), ("third", "fourth"))),
    "leonardo": Facts(holds=1),
    "burr": Facts((), "key", {"key": (None, "peg through")}),
}
CLOSED = {"leonardo"}  # each piece is carried by others: the first hangs in a hand until they are there
SLOW = {"stool", "tower", "gears", "leaning_bridge", "burr", "hinge", "arch"}


NAMES = [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in FACTS]


@cache
def planned(name: str) -> tuple[Assembly, AssemblyPlan]:
    assembly = load_assembly(name)
    # the keystone and its small stones would give way to the usual 2 N of the last insertion
    load = HoldLoad(push=1.0) if name == "arch" else HoldLoad()
    hand, options = (
        load_hand(ROOT / "robots/ur5e_pair/hand.toml"),
        PlannerOptions(analyzers=() if name in CLOSED else ("grounded",), load=load),
    )
    return assembly, make_plan(assembly, HandSet.alike(hand), options)


def test_every_example_has_its_facts() -> None:
    assert {path.stem for path in (ROOT / "meshes").glob("*/*.toml")} - {"soma3", "soma4", "cube"} == set(
        FACTS
    )


@pytest.mark.parametrize("name", NAMES)
def test_an_example_is_planned_as_it_must_be(name: str) -> None:
    _, plan = planned(name)
    facts = FACTS[name]
    place = {step.piece: k for k, step in enumerate(plan.steps)}
    assert [pair for pair in facts.before if place[pair[0]] > place[pair[1]]] == []
    assert facts.last in (None, plan.order[-1])
    for step in plan.steps:
        assert step.verdict != "unstable" and step.grasps
        if step.piece not in facts.ways:
            continue
        direction, kind = facts.ways[step.piece]
        assert step.type == kind, step.piece
        if direction is None:
            assert np.abs(step.direction) == pytest.approx((0.0, 1.0, 0.0), abs=1e-6)
        else:
            assert step.direction == pytest.approx(direction, abs=1e-6), step.piece
    assert sum(bool(step.holds) for step in plan.steps) >= facts.holds
    assert not plan.steps[-1].holds


def test_a_bridge_that_carries_itself_begins_with_a_beam_in_the_air() -> None:
    """Grounded there is no plan: no grasp of left bears a right tip that is pushed on left_cross."""
    assembly, plan = planned("leonardo")
    assert [w for w in plan.warnings if w.startswith("nothing carries left_cross when it is placed")]
    hand = load_hand(ROOT / "robots/ur5e_pair/hand.toml")
    with pytest.raises(NoPlanError) as caught:
        make_plan(assembly, HandSet.alike(hand), PlannerOptions(analyzers=("grounded",)))
    assert any(reason.startswith("holding left in {left, left_cross}") for reason in caught.value.reasons)


@pytest.mark.parametrize("name", [name for name in NAMES if name.values[0] not in CLOSED])
def test_every_piece_of_an_example_goes_onto_something(name: str) -> None:
    """Nothing hangs in the air until something is put under it: each piece is carried when it goes in."""
    assembly, plan = planned(name)
    placed: set[int] = {SUPPORT}
    for step in plan.steps:
        piece = assembly.index(step.piece)
        contacts = assembly.contacts_of(piece, frozenset(placed - {SUPPORT}))
        assert any(contact.normal[2] > 0.1 for contact in contacts), f"{step.piece} after {placed}"
        assert step.direction[2] < 0.1, step.piece
        placed.add(piece)


@pytest.mark.slow
def test_the_bridge_needs_a_hand_for_each_pair_of_beams() -> None:
    _, plan = planned("leaning_bridge")
    held = {hold.piece for step in plan.steps for hold in step.holds}
    for pair in ({"left_under", "left_over"}, {"right_under", "right_over"}, {"rafter_under", "rafter_over"}):
        assert len(held & pair) == 1
    # each pair stands by itself once it is whole, before the next is begun
    assert [bool(step.holds) for step in plan.steps] == [True, False] * 3


@pytest.mark.slow
def test_the_arch_can_be_built_from_its_springers_with_two_holds() -> None:
    """The hand goes from the first haunch to the keystone, and lets go when the second haunch has closed the
    arch."""
    _, plan = planned("arch")
    rows = [
        row
        for row in plan.orders
        if row.feasible and {row.order[0], row.order[1]} == {"left_springer", "right_springer"}
    ]
    assert rows
    best = max(rows, key=lambda row: row.score)
    assert best.held[:2] == ((), ()) and best.held[4] == ()
    assert best.held[2] == (best.order[2],) and best.order[2].endswith("haunch")
    assert best.order[3] == "keystone" and best.held[3] == ("keystone",)
    # the other haunch comes radially, from outside
    direction = np.array(best.directions[4])
    assert abs(direction[0]) == pytest.approx(np.cos(np.deg2rad(54)), abs=0.02)
    assert direction[2] == pytest.approx(-np.sin(np.deg2rad(54)), abs=0.02)


@pytest.mark.slow
def test_the_arch_says_that_it_must_be_closed_gently() -> None:
    hand, options = (
        load_hand(ROOT / "robots/ur5e_pair/hand.toml"),
        PlannerOptions(analyzers=("grounded",), load=HoldLoad(push=2.5)),
    )
    with pytest.raises(NoPlanError) as caught:
        make_plan(load_assembly("arch"), HandSet.alike(hand), options)
    refusals = [reason for reason in caught.value.reasons if reason.startswith("holding keystone in")]
    assert len(refusals) == 2
    assert all("x the load (2.5 N of the next insertion" in reason for reason in refusals)


@pytest.mark.slow
def test_no_beam_and_no_haunch_stands_alone() -> None:
    for name, fallers in (("leaning_bridge", set(range(6))), ("arch", {2, 3, 4})):
        assembly, plan = planned(name)
        for row in plan.orders:
            if assembly.index(row.order[0]) in fallers:
                assert row.s[0] == 0.0, row.order
