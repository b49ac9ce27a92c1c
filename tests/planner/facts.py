"""What the planner says of an assembly but for the plan, and that it says the same of another."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import shapely
from scipy.spatial import KDTree

from soma_bullet.assembly.contacts import SUPPORT
from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import Array, apply, tangents
from soma_bullet.grasp.hand import Hand, load_hand
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.planner.assemblability import Assemblability, analyse_freedom
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.qualities import Qualities
from soma_bullet.planner.ways import PENETRATION, Ways

ROOT = Path(__file__).resolve().parents[2]
HAND = load_hand(ROOT / "robots/ur5e_pair/hand.toml")
SAME = 1e-6  # of margins [g] and directions, and of lengths [m]
Subset = frozenset[int]


def subsets(count: int) -> list[Subset]:
    return [frozenset(chosen) for size in range(count + 1) for chosen in combinations(range(count), size)]


class Facts:
    """What the planner says of an assembly, piece by piece and placed set by placed set, but for the plan."""

    def __init__(self, whole: Assembly, paper: bool, hand: Hand | None):
        count = len(whole.pieces)
        self.whole, everything = whole, frozenset(range(count))
        self.hand = hand
        judge = Qualities(whole, HandSet.alike(hand or HAND), PlannerOptions())
        into = [(k, s) for s in subsets(count) for k in range(count) if k not in s]
        held = [(everything, frozenset({k})) for k in range(count)]
        states = [(s, frozenset()) for s in subsets(count) if s]
        self.states = {(s, h): judge.stability(s, h) for s, h in [*states, *held]}
        self.paper = {k: judge.paper_stability(k, everything) for k in everything} if paper else {}
        self.grasps = {(k, s): grasps_of(judge, k, s) for k, s in into} if hand else {}
        ways = Ways(whole, "finite", clear=-PENETRATION, run_in=0.0)
        self.ways = {(k, s): next(ways.into(k, s)) for k, s in into}


def grasps_of(judge: Qualities, piece: int, placed: Subset) -> Array:
    """Accessible grasps at the goal (n, 14): position and frame in the assembly frame, width, fraction of the
    pad on the piece.

    Which of the two fingers is called the first does not tell grasps apart.
    """
    chosen = judge.grasps(piece).take(judge.accessible(piece, placed))
    Ts = np.array(chosen.Ts_piece_tcp)
    swapped = Ts[:, :3, 0] @ (0.9, 0.37, 0.23) < 0
    Ts[swapped] = Ts[swapped] @ np.diag((-1.0, -1.0, 1.0, 1.0))
    Ts = judge.assembly.goals[piece] @ Ts
    return np.column_stack([Ts[:, :3, 3], Ts[:, :3, :3].reshape(-1, 9), chosen.widths, chosen.contact])


def facts(whole: Assembly, hand: Hand | None = HAND) -> Facts:
    # the wrench hull of a hole's many facets takes half a minute
    return Facts(whole, not any(facet.turn for piece in whole.pieces for facet in piece.facets), hand)


def compare(
    found: Facts,
    expected: Facts,
    motion: Array | None = None,
    labels: Sequence[int] | None = None,
    factor: float = 1.0,
    change: float = SAME,
) -> None:
    """`found` is what was expected, of pieces called `labels`, after a motion, `factor` times as large.

    Args:
        change: relative, of margins.
    """
    motion = np.eye(4) if motion is None else motion
    labels = list(range(len(expected.whole.pieces))) if labels is None else list(labels)
    turned = not np.allclose(motion[:3, :3], np.eye(3))

    def of(chosen: Subset) -> Subset:
        return frozenset(labels[k] for k in chosen)

    compare_contacts(found.whole, expected.whole, motion, labels, factor)
    for k, piece in enumerate(expected.whole.pieces):
        assert found.whole.pieces[labels[k]].mass == pytest.approx(piece.mass * factor**3, rel=SAME)
    for (placed, held), state in expected.states.items():
        other = found.states[of(placed), of(held)]
        where = f"{sorted(placed)} holding {sorted(held)}"
        assert other.margin == pytest.approx(state.margin, rel=change, abs=SAME), where
        assert other.margin_sides == pytest.approx(state.margin_sides, rel=change, abs=SAME), where
        assert other.verdict == state.verdict, where
    # a hexagon is itself after half a turn, not after a quarter
    for k, s in expected.paper.items() if abs(motion[0, 0]) > 1 - 1e-9 else ():
        assert found.paper[labels[k]] == pytest.approx(s, rel=SAME, abs=SAME), k
    for (k, placed), way in expected.ways.items():
        other_way, where = found.ways[labels[k], of(placed)], f"{k} into {sorted(placed)}"
        assert other_way.type == way.type, where
        if turned and not freedom_is_one(expected.whole, k, placed, way):
            continue  # see the last tests of test_invariance.py
        assert other_way.quality == pytest.approx(way.quality, abs=SAME), where
        assert set(other_way.blockers) == {SUPPORT if b == SUPPORT else labels[b] for b in way.blockers}, (
            where
        )
        if way.direction is None:
            assert other_way.direction is None, where
        else:
            assert other_way.direction == pytest.approx(motion[:3, :3] @ way.direction, abs=SAME), where
    for (k, placed), grasps in expected.grasps.items() if found.grasps else ():
        turned = [
            apply(motion, grasps[:, :3]),
            (motion[:3, :3] @ grasps[:, 3:12].reshape(-1, 3, 3)).reshape(-1, 9),
            grasps[:, 12:],
        ]
        there, here = found.grasps[labels[k], of(placed)], np.column_stack(turned)
        where = f"grasps of {k} in {sorted(placed)}"
        assert len(there) == len(here), where
        if len(here):
            assert KDTree(there).query(here)[0].max() < SAME, where
            assert KDTree(here).query(there)[0].max() < SAME, where


def freedom_is_one(whole: Assembly, piece: int, placed: Subset, way: Assemblability) -> bool:
    """Whether contacts leave one best direction, and it is not blocked: otherwise the frame has a say in what
    is tried."""
    best = analyse_freedom(np.array([c.normal for c in whole.contacts_of(piece, placed)])).best
    if best is None:
        return True
    return (
        way.type not in ("slot", "peg through")
        and way.direction is not None
        and bool(way.direction @ best < -1 + SAME)
    )


def compare_contacts(
    found: Assembly, expected: Assembly, motion: Array, labels: Sequence[int], factor: float
) -> None:
    left = list(found.contacts)
    for contact in expected.contacts:
        a, b = (SUPPORT if body == SUPPORT else labels[body] for body in (contact.body_a, contact.body_b))
        normal, corners = motion[:3, :3] @ contact.normal, apply(motion, contact.points) * factor
        match = [
            other
            for other in left
            if {other.body_a, other.body_b} == {a, b}
            and other.into(b).normal @ normal > 1 - 1e-9
            and same_outline(other.points, corners, normal, SAME * factor)
        ]
        assert len(match) == 1, (a, b, normal)
        assert match[0].area == pytest.approx(contact.area * factor**2, rel=1e-5)
        left.remove(match[0])
    assert not left
    for k, drop in enumerate(expected.drops):
        assert found.drops[labels[k]] == pytest.approx(drop * factor, abs=1e-9)


def same_outline(first: Array, second: Array, normal: Array, tolerance: float) -> bool:
    """Whether two sets of corners (n, 3) in planes of one normal span the same polygon; points on its edges
    are none."""
    basis = np.stack(tangents(normal))
    hulls = [shapely.multipoints(points @ basis.T).convex_hull for points in (first, second)]
    height = float(np.abs((first.mean(axis=0) - second.mean(axis=0)) @ normal))
    return bool(hulls[0].hausdorff_distance(hulls[1]) < tolerance and height < tolerance)
