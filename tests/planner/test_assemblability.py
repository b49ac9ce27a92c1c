"""Contact types and insertion directions."""

from __future__ import annotations

import numpy as np
import pytest
from blocks import SIDE, assembly, cells
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import Array
from soma_bullet.planner.assemblability import (
    ORDINAL,
    Assemblability,
    analyse_freedom,
    finite_quality,
    snap_normals,
)
from soma_bullet.planner.ways import Ways

X, Y, Z = np.eye(3)
# type, normals into the piece, t*, best removal direction where there is just one
TYPES = [
    ("free", [], 1.0, None),
    ("plane", [Z], 1.0, Z),
    ("wedge", [Z, X], np.sqrt(1 / 2), (X + Z) / np.sqrt(2)),
    ("corner", [X, Y, Z], np.sqrt(1 / 3), (X + Y + Z) / np.sqrt(3)),
    ("slot", [X, -X], 1.0, None),
    ("slot + bottom", [X, -X, Z], 1.0, Z),
    ("slot + bottom + wall", [X, -X, Y, Z], np.sqrt(1 / 2), (Y + Z) / np.sqrt(2)),
    ("peg through", [X, -X, Y, -Y], 1.0, None),
    ("peg blind", [X, -X, Y, -Y, Z], 1.0, Z),
    ("locked", [X, -X, Y, -Y, Z, -Z], 0.0, None),
]
rotations = st.integers(0, 2**32 - 1).map(
    lambda seed: Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
)


def analyse(whole: Assembly, piece: str, placed: str, scale: str = "finite") -> Assemblability:
    k = whole.index(piece)
    others = frozenset(whole.index(name) for name in placed)
    return next(Ways(whole, scale).into(k, others))


@pytest.mark.parametrize(
    ("kind", "normals", "clearance", "best"), TYPES, ids=lambda v: v if isinstance(v, str) else ""
)
@given(rotation=rotations, data=st.data())
def test_types_turn_with_the_contacts(
    kind: str,
    normals: list[Array],
    clearance: float,
    best: Array | None,
    rotation: Array,
    data: st.DataObject,
) -> None:
    order = data.draw(st.permutations(range(len(normals))))
    turned = np.array([rotation @ normals[k] for k in order]).reshape(-1, 3)
    freedom = analyse_freedom(turned)
    assert freedom.type == kind
    assert freedom.clearance == pytest.approx(clearance, abs=1e-6)
    if kind == "locked":
        assert freedom.best is None
        return
    assert freedom.best is not None
    assert np.linalg.norm(freedom.best) == pytest.approx(1)
    for direction in (freedom.best, *freedom.alternatives):
        assert np.linalg.norm(direction) == pytest.approx(1)
        assert not len(turned) or (turned @ direction).min() > -1e-6
    if best is not None:
        assert freedom.best == pytest.approx(rotation @ best, abs=1e-6)


def test_the_nine_types_are_all_there() -> None:
    assert {kind for kind, *_ in TYPES} == set(ORDINAL)
    assert len(ORDINAL) == 10  # nine, and free


@given(rotation=rotations)
def test_three_normals_of_which_the_mean_is_illegal(rotation: Array) -> None:
    angles = np.deg2rad([0.0, 10.0, 170.0])
    normals = np.stack([np.cos(angles), np.sin(angles), np.zeros(3)], axis=1)
    mean = normals.mean(axis=0)
    assert np.rad2deg(np.arctan2(mean[1], mean[0])) == pytest.approx(19.1, abs=0.1)
    assert (normals @ mean).min() < -0.2
    freedom = analyse_freedom(normals @ rotation.T)
    best = np.deg2rad(85.0)  # legal are 80 to 90 degrees
    assert freedom.best == pytest.approx(rotation @ (np.cos(best), np.sin(best), 0.0), abs=1e-6)
    assert freedom.clearance == pytest.approx(np.cos(best))
    assert freedom.type == "wedge"


@given(rotation=rotations, seed=st.integers(0, 1000))
def test_the_best_direction_has_the_widest_clearance(rotation: Array, seed: int) -> None:
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(rng.integers(2, 6), 3))
    normals += (0.0, 0.0, 2.0)
    normals = snap_normals(normals / np.linalg.norm(normals, axis=1, keepdims=True) @ rotation.T)
    freedom = analyse_freedom(normals)
    tried = rng.normal(size=(4000, 3))
    tried /= np.linalg.norm(tried, axis=1, keepdims=True)
    clearances = (tried @ normals.T).min(axis=1)
    if clearances.max() < 0.05:
        return
    assert freedom.clearance >= clearances.max() - 1e-9
    assert freedom.clearance == pytest.approx((normals @ freedom.best).min(), abs=1e-6)


def test_normals_within_two_degrees_are_one() -> None:
    for angle, count in ((1.9, 1), (2.1, 2)):
        tilted = np.array([0.0, np.sin(np.deg2rad(angle)), np.cos(np.deg2rad(angle))])
        assert len(snap_normals(np.array([Z, tilted]))) == count


def test_a_sliver_of_freedom_counts_as_none() -> None:
    """Walls that open by less than 2 degrees hold like a slot."""
    for half, kind in ((0.5, "slot"), (3.0, "wedge")):
        a = np.deg2rad(half)
        walls = np.array([[np.cos(a), 0.0, np.sin(a)], [-np.cos(a), 0.0, np.sin(a)]])
        assert analyse_freedom(walls).type == kind


@pytest.mark.parametrize(
    ("kind", "clearance", "quality"),
    [
        ("free", 1, 1),
        ("plane", 1, 1),
        ("wedge", 0.5, 0.55),
        ("corner", 0.577, 0.6193),
        ("slot", 1, 0.1),
        ("slot + bottom", 1, 0.1),
        ("slot + bottom + wall", 0.7, 0.07),
        ("peg through", 1, 0.05),
        ("peg blind", 1, 0.05),
        ("locked", 0, 0),
    ],
)
def test_the_finite_scale(kind: str, clearance: float, quality: float) -> None:
    assert finite_quality(kind, clearance) == pytest.approx(quality)


def test_the_ordinal_scale() -> None:
    assert [ORDINAL[kind] for kind, *_ in TYPES] == [np.inf, 10, 10, 10, 9, 3, 3, 2, 1, 0]


def roofed(roof: list[tuple[int, int, int]], gap: float = 0.5) -> Assembly:
    """A square slab on a plate, and a bracket that it does not touch; the bracket's cells are lowered to the
    gap [cells]."""
    plate = cells([(i, j, -1) for i in range(-3, 4) for j in range(-3, 4)], "p")
    slab = cells([(i, j, 0) for i in range(-1, 2) for j in range(-1, 2)], "c")
    return assembly(
        [plate, slab, cells(roof, "r")], [(0, 0, 0), (0, 0, 0), (0, 0, (gap - 1) * SIDE)], height=-1.5 * SIDE
    )


def test_a_roof_blocks_the_way_up_and_leaves_the_way_aside() -> None:
    whole = roofed([(0, 0, 2)])
    up = analyse(whole, "c", "p")
    assert up.direction == pytest.approx(-Z) and up.quality == 1.0
    assert analyse(roofed([(0, 0, 2)], gap=2.0), "c", "pr").direction == pytest.approx(
        -Z
    )  # its own height and the run-in are way enough
    aside = analyse(whole, "c", "pr")
    assert aside.type == "plane" and aside.quality > 0
    assert aside.direction is not None
    assert abs(aside.direction[2]) < 0.9


def test_a_room_without_a_door_is_no_way_in() -> None:
    """Walls and a roof around: nothing of them touches the slab, and nothing lets it out."""
    room = [
        (i, j, k)
        for i in range(-3, 4)
        for j in range(-3, 4)
        for k in range(1, 3)
        if max(abs(i), abs(j)) == 3 or k == 2
    ]
    shut = analyse(roofed(room, gap=0.5), "c", "pr")
    assert shut.quality == 0.0 and shut.direction is None
    assert shut.blockers == (2,)
    assert shut.type == "plane"


def test_a_lower_quality_where_the_best_direction_is_blocked() -> None:
    """Two walls make a wedge; a stopper in the diagonal leaves the way up, which has less clearance."""
    upright, floor = (
        [(0, j, k) for j in range(-2, 3) for k in range(2)],
        [(i, j, -1) for i in range(5) for j in range(-2, 3)],
    )
    walls = cells(upright + floor, "w")
    whole = assembly(
        [walls, cells([(1, 0, 0)], "c"), cells([(2, 0, 1)], "s")], [(0, 0, 0)] * 3, height=-1.5 * SIDE
    )
    free, blocked = analyse(whole, "c", "w"), analyse(whole, "c", "ws")
    assert free.direction == pytest.approx(-(X + Z) / np.sqrt(2))
    assert free.quality == pytest.approx(0.1 + 0.9 * np.sqrt(0.5))
    assert blocked.type == "wedge"
    assert 0 < blocked.quality < free.quality
    assert analyse(whole, "c", "ws", "ordinal").quality == 10.0


def test_the_support_is_in_the_way_as_pieces_are() -> None:
    whole = assembly([cells([(0, 0, 0)], "c")], [(0, 0, SIDE / 2)])
    ways = Ways(whole, "finite")
    assert ways.blockers(0, frozenset(), -Z) == (-1,)
    assert ways.blockers(0, frozenset(), X) == ()
    alone = analyse(whole, "c", "")
    assert alone.type == "plane" and alone.direction == pytest.approx(-Z)


def test_a_peg_goes_in_along_its_axis() -> None:
    ring = [(i, j, 0) for i in range(-1, 2) for j in range(-1, 2) if (i, j) != (0, 0)]
    through = assembly([cells(ring, "r"), cells([(0, 0, 0)], "p")], [(0, 0, 0)] * 2, height=-1.0)
    assert analyse(through, "p", "r").type == "peg through"
    assert abs(analyse(through, "p", "r").direction) == pytest.approx(Z)
    blind = assembly([cells(ring, "r"), cells([(0, 0, 0)], "p")], [(0, 0, 0)] * 2, height=-SIDE / 2)
    assert analyse(blind, "p", "r").type == "peg blind"
    assert analyse(blind, "p", "r").direction == pytest.approx(-Z)
    assert analyse(blind, "p", "r", "ordinal").quality == 1.0
