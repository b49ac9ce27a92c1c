"""The same input is planned once; whatever a plan depends on is part of the key."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from blocks import assembly, box

from soma_bullet.assembly.model import Assembly
from soma_bullet.grasp.hand import Hand
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.planner import store
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.plan import easiest_orders, make_plan, picked
from soma_bullet.planner.store import kept_plan
from soma_bullet.records import write_json


@pytest.fixture(autouse=True)
def own_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def twins() -> Assembly:
    """Two equal cubes that do not touch: either first."""
    cubes = [box((0.02,) * 3, name) for name in ("one", "two")]
    return replace(assembly(cubes, [(0, 0, 0.01), (0.3, 0, 0.01)]), digest="twins")


def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    made: list[int] = []

    def count(
        whole: Assembly, hands: HandSet, options: PlannerOptions, excluded: frozenset[tuple[str, ...]]
    ) -> object:
        made.append(options.seed)
        return make_plan(whole, hands, options, excluded)

    monkeypatch.setattr(store, "make_plan", count)
    return made


def written(plan: object, path: Path) -> bytes:
    write_json(plan, path)
    return path.read_bytes()


def test_a_kept_plan_is_the_plan_byte_for_byte(
    twins: Assembly, hand: Hand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = counted(monkeypatch)
    for seed in range(8):
        options = PlannerOptions(seed=seed)
        fresh = written(make_plan(twins, HandSet.alike(hand), options), tmp_path / "fresh.json")
        assert written(kept_plan(twins, HandSet.alike(hand), options), tmp_path / "kept.json") == fresh
        assert written(kept_plan(twins, HandSet.alike(hand), options), tmp_path / "again.json") == fresh
    assert len(made) == 2  # one for each of the two equal orders


def test_what_decides_a_plan_is_part_of_the_key(
    twins: Assembly, hand: Hand, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = counted(monkeypatch)
    kept_plan(twins, HandSet.alike(hand), PlannerOptions())
    kept_plan(twins, HandSet.alike(hand), PlannerOptions())
    assert len(made) == 1
    kept_plan(replace(twins, digest="others"), HandSet.alike(hand), PlannerOptions())
    kept_plan(twins, HandSet.alike(replace(hand, pad_size=np.array(hand.pad_size) * 0.9)), PlannerOptions())
    kept_plan(twins, HandSet.alike(hand), PlannerOptions(stability="paper"))
    kept_plan(twins, HandSet.alike(hand), PlannerOptions(), frozenset({("one", "two")}))
    assert len(made) == 5
    weak = replace(hand, grip_force=hand.grip_force / 2)
    for arms in ([hand, weak], [weak, hand], [hand, weak, weak], [hand, replace(hand, opening=0.05)]):
        for _ in range(2):
            kept_plan(twins, HandSet.of(arms), PlannerOptions())
    assert len(made) == 9
    monkeypatch.setattr(store, "_source", lambda: "another planner")
    kept_plan(twins, HandSet.alike(hand), PlannerOptions())
    assert len(made) == 10


def test_what_was_not_asked_for_the_longest_makes_room(
    twins: Assembly, hand: Hand, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = counted(monkeypatch)
    wholes, hands = [replace(twins, digest=f"twins{k}") for k in range(4)], HandSet.alike(hand)
    for k, whole in enumerate(wholes[:3]):
        kept_plan(whole, hands, PlannerOptions())
        for file in store.store_folder().iterdir():
            if file.stat().st_mtime > 1000:
                os.utime(file, (100 + k, 100 + k))
    size = sum(file.stat().st_size for file in store.store_folder().iterdir())
    monkeypatch.setattr(store, "LARGEST", size)
    kept_plan(wholes[0], hands, PlannerOptions())  # asked for again
    assert len(made) == 3
    kept_plan(wholes[3], hands, PlannerOptions())
    assert sum(file.stat().st_size for file in store.store_folder().iterdir()) <= size
    for whole, count in ((wholes[3], 4), (wholes[0], 4), (wholes[1], 5)):
        kept_plan(whole, hands, PlannerOptions())
        assert len(made) == count


def test_a_damaged_file_is_planned_anew(twins: Assembly, hand: Hand, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = kept_plan(twins, HandSet.alike(hand), PlannerOptions()).order
    for file in store.store_folder().iterdir():
        file.write_text("damaged")
    made = counted(monkeypatch)
    assert kept_plan(twins, HandSet.alike(hand), PlannerOptions()).order == expected
    assert len(made) == 1


def test_a_store_that_cannot_be_written_does_not_matter(twins: Assembly, hand: Hand, tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("a file where the folder should be")
    assert kept_plan(twins, HandSet.alike(hand), PlannerOptions()).order in {("one", "two"), ("two", "one")}


def test_without_a_digest_nothing_is_kept(twins: Assembly, hand: Hand) -> None:
    kept_plan(replace(twins, digest=""), HandSet.alike(hand), PlannerOptions())
    assert not store.store_folder().exists()


def test_the_seed_picks_among_the_easiest(twins: Assembly, hand: Hand) -> None:
    for seed in range(6):
        plan = make_plan(twins, HandSet.alike(hand), PlannerOptions(seed=seed))
        assert easiest_orders(plan)[picked(seed, 2)] == plan.order
