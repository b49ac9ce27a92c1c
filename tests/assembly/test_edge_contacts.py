"""Contacts along edges and at corners: where they are, and where there are none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import manifold3d
import numpy as np
import pytest
import trimesh
from blocks import SIDE, assembly, box, cells, moved, refined, solid
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from soma_bullet.assembly.contact import proportions
from soma_bullet.assembly.contacts import SUPPORT, Contact
from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly, Support
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.frames import Array, make_transform, readonly

EXAMPLES = {name: load_assembly(name) for name in ("dominoes", "leonardo")}


def ridge(length: float = 40.0, name: str = "ridge") -> Workpiece:
    """A roof on z = 0 with its ridge along y at z = 10 mm, 20 mm wide."""
    corners = [[(-10, 0), (10, 0), (0, 10)]]
    prism = manifold3d.Manifold.extrude(manifold3d.CrossSection(corners), length)
    return solid(prism.translate([0, 0, -length / 2]).rotate([90, 0, 0]), name)


def posed(pieces: list[Workpiece], goals: list[Array], height: float = 0.0) -> Assembly:
    return Assembly("posed", tuple(pieces), readonly(goals), Support(height))


def turned(axis: str, degrees: float, place: tuple[float, float, float]) -> Array:
    return make_transform(Rotation.from_euler(axis, degrees, degrees=True).as_matrix(), place)


def leaning(lean: float, yaw: float = 0.0, height: float = 0.1, width: float = 0.01) -> Assembly:
    """A board against a wall, `lean` degrees from upright: the foot of the wall at 0, the board beyond x."""
    angle = np.deg2rad(lean)
    foot = np.array([height * np.sin(angle), 0.0, 0.0])
    rotation = Rotation.from_euler("y", -lean, degrees=True).as_matrix()
    board = make_transform(rotation, foot + rotation @ (width / 2, 0, height / 2))
    whole = posed(
        [box((0.1, 0.06, 0.2), "wall", density=5000.0), box((width, 0.04, height), "board")],
        [make_transform(None, (-0.05, 0, 0.1)), board],
    )
    return moved(whole, turned("z", yaw, (0, 0, 0)))


def kinds(whole: Assembly) -> list[tuple[int, int, int, bool]]:
    """Of every contact both bodies, the number of points, and whether it has an area."""
    return sorted((c.body_a, c.body_b, len(c.points), c.area > 0) for c in whole.contacts)


def between(whole: Assembly, a: int, b: int) -> Contact:
    (found,) = [c for c in whole.contacts if {c.body_a, c.body_b} == {a, b}]
    return found.into(b)


def test_a_board_leans_on_two_edges() -> None:
    whole = leaning(25.0)
    assert kinds(whole) == [(SUPPORT, 0, 4, True), (SUPPORT, 1, 2, False), (0, 1, 2, False)]
    top, foot = between(whole, 0, 1), between(whole, SUPPORT, 1)
    assert top.normal == pytest.approx((1, 0, 0))
    assert foot.normal == pytest.approx((0, 0, 1))
    assert np.sort(top.points[:, 1]) == pytest.approx((-0.02, 0.02))
    assert top.points[:, 2] == pytest.approx(0.1 * np.cos(np.deg2rad(25)))
    # the real edges stand back by more than the clearance, and the board drops by that
    back = np.cos(np.deg2rad(25)) + np.sin(np.deg2rad(25))
    assert (foot.recess_b, top.recess_b, top.recess_a) == pytest.approx((back, back, 1.0))
    assert whole.drops == pytest.approx((1e-4, back * 1e-4))
    assert frozenset((0, 1)) in whole.meeting


@pytest.mark.parametrize("upright", [True, False])
def test_a_cube_on_a_corner(upright: bool) -> None:
    """On the table, and on another cube."""
    rotation = Rotation.align_vectors([(0, 0, 1)], [(1, 1, 1)])[0].as_matrix()
    high = SIDE * np.sqrt(3) / 2
    cube = make_transform(rotation, (0, 0, high if upright else high + SIDE))
    below = [] if upright else [make_transform(None, (0, 0, SIDE / 2))]
    whole = posed([box((SIDE,) * 3, str(k)) for k in range(len(below) + 1)], [*below, cube])
    found = between(whole, SUPPORT if upright else 0, len(below))
    assert found.normal == pytest.approx((0, 0, 1))
    assert found.points[0] == pytest.approx((0, 0, 0 if upright else SIDE), abs=1e-9)
    assert (len(found.points), found.area, found.recess_b) == (1, 0.0, pytest.approx(np.sqrt(3)))


@pytest.mark.parametrize("degrees", [90.0, 60.0, 10.0, -35.0])
def test_edges_that_cross_touch_at_one_point(degrees: float) -> None:
    upper = turned("z", degrees, (0, 0, 0.02)) @ turned("x", 180.0, (0, 0, 0))
    whole = posed([ridge(), ridge(name="upper")], [np.eye(4), upper])
    found = between(whole, 0, 1)
    assert found.points == pytest.approx(np.array([[0, 0, 0.01]]), abs=1e-9)
    assert found.normal == pytest.approx((0, 0, 1), abs=1e-9)


def test_boards_that_lean_against_each_other_touch_along_their_edges() -> None:
    left, right = leaning(25.0), leaning(-25.0)
    shift = 0.1 * np.sin(np.deg2rad(25))
    other = make_transform(Rotation.from_euler("z", 180, degrees=True).as_matrix(), (0, 0, 0))
    pair = posed([left.pieces[1], right.pieces[1]], [left.goals[1], other @ left.goals[1]])
    assert kinds(pair) == [(SUPPORT, 0, 2, False), (SUPPORT, 1, 2, False), (0, 1, 2, False)]
    assert between(pair, 0, 1).normal == pytest.approx((-1, 0, 0), abs=1e-9)
    assert np.abs(between(pair, SUPPORT, 0).points[:, 0]) == pytest.approx(shift)


@given(st.integers(0, 2**32 - 1))
def test_neighbours_across_an_edge_or_a_corner_do_not_touch(seed: int) -> None:
    """Also where they overlap or are apart a little, or are turned a little."""
    rng = np.random.default_rng(seed)
    for step in ((1, 0, 1), (1, 1, 0), (1, 1, 1), (-1, 0, 1), (1, -0.5, 1)):
        motion = turned("z", rng.uniform(-180, 180), (0, 0, 0))
        off = rng.uniform(-2e-5, 2e-5, 3)
        tilt = turned("xyz", rng.uniform(-0.1, 0.1, 3), SIDE * np.array(step) + (0, 0, SIDE / 2) + off)
        goals = [motion @ make_transform(None, (0, 0, SIDE / 2)), motion @ tilt]
        whole = posed([box((SIDE,) * 3, "a"), box((SIDE,) * 3, "b")], goals)
        assert [c for c in whole.contacts if c.body_a != SUPPORT] == []
        assert all(c.area > 0 for c in whole.contacts)


@given(st.integers(0, 2**32 - 1))
def test_polycubes_touch_by_faces_alone(seed: int) -> None:
    """Random cells in two bodies on a grid: no edge counts, whatever the motion."""
    rng = np.random.default_rng(seed)
    grid = [(i, j, k) for i in range(3) for j in range(2) for k in range(2)]
    rng.shuffle(grid)
    bodies = [cells([tuple(cell)], str(n)) for n, cell in enumerate(grid[: rng.integers(2, 7)])]
    whole = assembly(bodies, [(0, 0, SIDE / 2)] * len(bodies))
    whole = moved(whole, turned("z", rng.uniform(-180, 180), tuple(rng.uniform(-1, 1, 3))))
    assert all(c.area == pytest.approx(SIDE**2) for c in whole.contacts)


def test_an_edge_that_a_notch_hides_is_none() -> None:
    """Two parts of an L meet along a concave edge, and convex parts overlap inside it: neither touches."""
    bracket = cells([(0, 0, 0), (1, 0, 0), (0, 0, 1)], "bracket")
    slab = box((SIDE, SIDE, 0.002), "slab")
    tilted = turned("y", 45.0, (SIDE * 1.2, 0, SIDE * 1.2))
    whole = posed([bracket, slab], [make_transform(None, (0, 0, SIDE / 2)), tilted])
    ends = np.vstack([c.points for c in whole.contacts if c.body_a != SUPPORT] or [np.zeros((0, 3))])
    notch = np.array([SIDE / 2, SIDE])
    assert (np.linalg.norm(ends[:, [0, 2]] - notch, axis=1) > 1e-3).all()
    edges, corners = bracket.edges
    assert (np.linalg.norm(edges.ends.mean(axis=1)[:, [0, 2]] - (SIDE / 2, SIDE / 2), axis=1) > 1e-6).all()
    # twelve outer corners of an L; the two on the concave edge do not count
    assert (len(edges.ends), len(corners.points)) == (17, 10)


@pytest.mark.parametrize("name", sorted(EXAMPLES))
@pytest.mark.parametrize("seed", range(3))
def test_contacts_turn_with_everything_and_do_not_depend_on_order(name: str, seed: int) -> None:
    whole, rng = EXAMPLES[name], np.random.default_rng(seed)
    order = rng.permutation(len(whole.pieces))
    motion = turned("z", rng.uniform(-180, 180), (0.3, -0.2, 0.5))
    other = moved(
        replace(whole, pieces=tuple(whole.pieces[k] for k in order), goals=readonly(whole.goals[order])),
        motion,
    )
    if seed == 2:
        other = refined(other, seed)
    assert len(other.contacts) == len(whole.contacts)
    label = {SUPPORT: SUPPORT, **{int(k): n for n, k in enumerate(order)}}
    for contact in whole.contacts:
        a, b = label[contact.body_a], label[contact.body_b]
        twin = between(other, a, b)
        assert twin.normal == pytest.approx(motion[:3, :3] @ contact.normal, abs=1e-9)
        points = contact.points @ motion[:3, :3].T + motion[:3, 3]
        apart = np.linalg.norm(twin.points[:, None] - points, axis=2)
        assert len(twin.points) == len(points)
        assert apart.min(axis=1).max() < 1e-6
        assert twin.area == pytest.approx(contact.area)
    assert other.drops == pytest.approx(whole.drops[order])


def write(folder: Path, whole: Assembly) -> Path:
    """The file of an assembly, goals and meshes with nine digits."""
    lines = ['name = "written"\nunit = "m"\n[support]\nheight = 0.0\nfriction = 0.5\n[defaults]']
    lines.append("density = 700.0\nfriction = 0.5\nclearance = 0.0")
    for piece, goal in zip(whole.pieces, whole.goals, strict=True):
        trimesh.Trimesh(piece.vertices, piece.faces).export(folder / f"{piece.name}.obj", digits=9)
        x, y, z = (f"{v + 0.0:.9g}" for v in np.round(goal[:3, 3], 12))
        turns = ", ".join(
            f"{v:.9g}" for v in Rotation.from_matrix(goal[:3, :3]).as_euler("xyz", degrees=True) + 0.0
        )
        lines.append(
            f'[[piece]]\nname = "{piece.name}"\nmesh = "{piece.name}.obj"\n'
            f"goal = {{ position = [{x}, {y}, {z}], rpy_deg = [{turns}] }}"
        )
    (folder / "written.toml").write_text("\n".join(lines).replace("= [-0,", "= [0,") + "\n")
    return folder / "written.toml"


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_gaps_of_rounding_are_contacts(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    """Stacks and leaning boards at any yaw, written with nine digits: all that touched still does."""
    rng = np.random.default_rng(seed)
    sizes, pieces, goals, z = rng.uniform(0.02, 0.06, (3, 3)), [], [], 0.0
    for k, size in enumerate(sizes):
        place = (*rng.uniform(-0.003, 0.003, 2), z + size[2] / 2)
        pieces.append(box(size, f"level{k}", clearance=0.0))
        goals.append(turned("z", rng.uniform(-180, 180), place))
        z += size[2]
    stack = posed(pieces, goals)
    board = leaning(rng.uniform(8, 70), rng.uniform(-180, 180))
    for whole in (stack, board):
        read = load_assembly(write(tmp_path_factory.mktemp("written"), whole))
        assert kinds(read) == kinds(whole)
        assert {(c.body_a, c.body_b) for c in read.contacts} >= {(SUPPORT, 0), (0, 1)}


@pytest.mark.parametrize("gap", [-9e-7, -1e-9, 1e-9, 9e-7])
def test_edges_apart_or_sunk_by_less_than_a_micrometre_touch(gap: float) -> None:
    whole = leaning(25.0)
    pieces = tuple(replace(piece, clearance=0.0) for piece in whole.pieces)
    goals = np.array(whole.goals)
    goals[1, :3, 3] += (gap, 0, gap)
    assert kinds(replace(whole, pieces=pieces, goals=readonly(goals))) == kinds(whole)
    goals[1, :3, 3] += (2e-3, 0, 0)
    assert len(replace(whole, pieces=pieces, goals=readonly(goals)).contacts) == 2


def test_a_force_is_shared_by_area_by_length_or_by_number() -> None:
    def contact(points: list[tuple[float, float, float]], area: float = 0.0) -> Contact:
        return Contact(0, 1, np.array((0, 0, 1.0)), np.array(points, float), area)

    patch = contact([(0, 0, 0), (3, 0, 0), (3, 4, 0), (0, 4, 0)], 12.0)
    line, point = contact([(0, 0, 0), (0, 2, 0)]), contact([(0, 0, 0)])
    assert proportions([patch, patch]) == [12.0, 12.0]
    assert proportions([patch, line]) == [5.0, 2.0]
    assert proportions([patch, line, point]) == [1.0, 1.0, 1.0]
    assert [c.width for c in (patch, line, point)] == pytest.approx([np.sqrt(12), 2.0, 0.0])
