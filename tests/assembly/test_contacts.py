"""Contact patches: the figures of the Soma assemblies, and what must not change them."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from soma_bullet.assembly.contacts import GAP_TOLERANCE, SUPPORT, Contact, find_contacts
from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.frames import Array, apply, inverse, make_transform, readonly

SQUARE = 0.0185**2  # [m2] the face of a cell
MESHES = Path(__file__).resolve().parents[2] / "meshes"
ASSEMBLIES = {path.stem: load_assembly(path) for path in sorted((MESHES / "soma").glob("*.toml"))}

rotations = st.integers(0, 2**32 - 1).map(
    lambda seed: Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
)
offsets = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array)
names = st.sampled_from(sorted(ASSEMBLIES))


def box(size: tuple[float, float, float], name: str = "box", clearance: float = 1e-4) -> Workpiece:
    mesh = trimesh.creation.box(size)
    return Workpiece(name, readonly(mesh.vertices), readonly(mesh.faces, int), clearance=clearance)


def assert_same(
    found: tuple[Contact, ...], expected: tuple[Contact, ...], labels: list[int], motion: Array
) -> None:
    """`found` is `expected` after a motion, with piece i called labels[i]; corners agree within a
    micrometre."""
    assert len(found) == len(expected)
    left = list(found)
    for contact in expected:
        a, b = (SUPPORT if body == SUPPORT else labels[body] for body in (contact.body_a, contact.body_b))
        normal = motion[:3, :3] @ contact.normal
        corners = apply(motion, contact.points)
        match = [
            other
            for other in left
            if {other.body_a, other.body_b} == {a, b}
            and other.into(b).normal @ normal > 1 - 1e-9
            and len(other.points) == len(corners)
            and np.linalg.norm(other.points[:, None] - corners[None], axis=2).min(axis=1).max() < 1e-6
        ]
        assert len(match) == 1, (a, b, normal)
        assert match[0].area == pytest.approx(contact.area, rel=1e-6)
        left.remove(match[0])


def areas(assembly: Assembly) -> dict[tuple[int, int], float]:
    """Contact area by pair, in faces of a cell."""
    total: dict[tuple[int, int], float] = defaultdict(float)
    for contact in assembly.contacts:
        total[contact.body_a, contact.body_b] += contact.area / SQUARE
    return total


@pytest.mark.parametrize(
    ("name", "squares", "pairs", "standing"), [("cube", 34, 14, 9), ("soma3", 5, 3, 1), ("soma4", 10, 4, 3)]
)
def test_contact_area_of_the_soma_assemblies(name: str, squares: int, pairs: int, standing: int) -> None:
    found = areas(ASSEMBLIES[name])
    between = {pair: area for pair, area in found.items() if pair[0] != SUPPORT}
    assert sum(between.values()) == pytest.approx(squares)
    assert len(between) == pairs
    assert all(area == pytest.approx(round(area)) for area in found.values())
    assert sum(found.values()) - squares == pytest.approx(standing)


def test_contacts_of_soma3_by_pair() -> None:
    soma3 = ASSEMBLIES["soma3"]
    big, small, z = (soma3.index(name) for name in ("BigL", "smallL", "Z"))
    found = {pair: round(area, 6) for pair, area in areas(soma3).items()}
    assert found == {(SUPPORT, z): 1, (big, z): 2, (big, small): 2, (small, z): 1}
    from_z = {
        tuple(np.round(contact.normal).astype(int)) for contact in soma3.contacts_of(big, frozenset({z}))
    }
    assert from_z == {(0, 0, 1), (0, -1, 0)}
    assert soma3.contacts_of(big, frozenset()) == ()
    assert [contact.body_a for contact in soma3.contacts_of(z, frozenset())] == [SUPPORT]


@pytest.mark.parametrize("name", sorted(ASSEMBLIES))
def test_patches_lie_where_the_pieces_touch(name: str) -> None:
    assembly = ASSEMBLIES[name]
    for contact in assembly.contacts:
        assert np.linalg.norm(contact.normal) == pytest.approx(1)
        assert np.ptp(contact.points @ contact.normal) < 1e-9
        assert contact.into(contact.body_a).into(contact.body_b).normal == pytest.approx(contact.normal)
        middle = contact.points.mean(axis=0)
        if contact.body_a == SUPPORT:
            assert middle[2] == pytest.approx(assembly.support.height)
            assert contact.normal == pytest.approx((0, 0, 1))
            continue
        # the normal points out of a and into b, whatever the corners' convex hull spans
        for body, sign in ((contact.body_a, -1), (contact.body_b, 1)):
            inside = [
                middle_of_square + sign * 1e-3 * contact.normal
                for middle_of_square in _square_middles(contact)
            ]
            parts = assembly.goal_parts[body]
            assert any(np.all(part.normals @ point < part.offsets) for part in parts for point in inside)


def _square_middles(contact: Contact) -> list[Array]:
    """Middles of the cell faces within the hull of a patch on the cells' grid."""
    low = contact.points.min(axis=0)
    spans = [max(1, round(extent / 0.0185)) for extent in np.ptp(contact.points, axis=0)]
    flat = np.abs(contact.normal) > 0.5
    return [
        low + np.where(flat, 0.0, (np.array(index) + 0.5) * 0.0185)
        for index in np.ndindex(*np.where(flat, 1, spans))
    ]


@given(name=names, rotation=rotations, offset=offsets)
def test_contacts_between_pieces_move_with_the_assembly(name: str, rotation: Array, offset: Array) -> None:
    assembly = ASSEMBLIES[name]
    motion = make_transform(rotation, offset)
    moved = find_contacts(assembly.pieces, motion @ assembly.goals, support_height=-10.0)
    fixed = tuple(contact for contact in assembly.contacts if contact.body_a != SUPPORT)
    assert_same(moved, fixed, list(range(len(assembly.pieces))), motion)


@given(name=names, yaw=st.floats(-np.pi, np.pi), offset=offsets)
def test_contacts_and_drops_move_with_the_assembly_and_its_support(
    name: str, yaw: float, offset: Array
) -> None:
    assembly = ASSEMBLIES[name]
    motion = make_transform(Rotation.from_rotvec((0, 0, yaw)).as_matrix(), offset)
    support = replace(assembly.support, height=assembly.support.height + offset[2])
    moved = replace(assembly, goals=motion @ assembly.goals, support=support)
    assert_same(moved.contacts, assembly.contacts, list(range(len(assembly.pieces))), motion)
    assert moved.drops == pytest.approx(assembly.drops)
    assert moved.goal_centres == pytest.approx(apply(motion, assembly.goal_centres))


@given(name=names, data=st.data())
def test_order_and_names_do_not_matter(name: str, data: st.DataObject) -> None:
    assembly = ASSEMBLIES[name]
    order = data.draw(st.permutations(range(len(assembly.pieces))))
    pieces = tuple(replace(assembly.pieces[piece], name=f"piece{piece}") for piece in order)
    shuffled = replace(assembly, pieces=pieces, goals=assembly.goals[list(order)])
    labels = [order.index(piece) for piece in range(len(order))]
    assert_same(shuffled.contacts, assembly.contacts, labels, np.eye(4))
    assert shuffled.drops == pytest.approx(assembly.drops[list(order)])


@given(name=names, rotation=rotations, offset=offsets)
def test_the_frame_of_a_mesh_does_not_matter(name: str, rotation: Array, offset: Array) -> None:
    """A piece exported about another origin, its goal adapted, is the same piece."""
    assembly = ASSEMBLIES[name]
    frame = make_transform(rotation, offset)
    pieces = tuple(
        replace(piece, vertices=apply(inverse(frame), piece.vertices)) for piece in assembly.pieces
    )
    other = replace(assembly, pieces=pieces, goals=assembly.goals @ frame)
    assert_same(other.contacts, assembly.contacts, list(range(len(pieces))), np.eye(4))
    assert other.drops == pytest.approx(assembly.drops)
    for a, b in zip(other.pieces, assembly.pieces, strict=True):
        assert a.mass == pytest.approx(b.mass)
        assert a.radius == pytest.approx(b.radius)
    assert other.goal_centres == pytest.approx(assembly.goal_centres, abs=1e-9)


@pytest.mark.slow
@given(name=names, seed=st.integers(0, 1000))
def test_the_tessellation_does_not_matter(name: str, seed: int) -> None:
    assembly = ASSEMBLIES[name]
    rng = np.random.default_rng(seed)
    pieces = []
    for piece in assembly.pieces:
        chosen = np.flatnonzero(rng.random(len(piece.faces)) < 0.6)
        vertices, faces = trimesh.remesh.subdivide(piece.vertices, piece.faces, face_index=chosen)
        pieces.append(replace(piece, vertices=vertices, faces=faces))
    other = replace(assembly, pieces=tuple(pieces))
    assert_same(other.contacts, assembly.contacts, list(range(len(pieces))), np.eye(4))
    assert [len(parts) for parts in other.goal_parts] == [len(parts) for parts in assembly.goal_parts]


@pytest.mark.parametrize("unit", [("m", 1.0), ("cm", 1e-2), ("in", 0.0254)], ids=lambda unit: unit[0])
def test_the_unit_of_the_file_does_not_matter(tmp_path: Path, unit: tuple[str, float]) -> None:
    cube = ASSEMBLIES["cube"]
    name, size = unit
    lines = ['name = "cube"', f'unit = "{name}"']
    for piece, goal in zip(cube.pieces, cube.goals, strict=True):
        trimesh.Trimesh(piece.vertices / size, piece.faces, process=False).export(
            tmp_path / f"{piece.name}.ply"
        )
        quaternion = Rotation.from_matrix(goal[:3, :3]).as_quat(scalar_first=True).tolist()
        lines += ["[[piece]]", f'name = "{piece.name}"', f'mesh = "{piece.name}.ply"']
        lines += [f"goal = {{ position = {(goal[:3, 3] / size).tolist()}, quat_wxyz = {quaternion} }}"]
    (tmp_path / "cube.toml").write_text("\n".join(lines))
    other = load_assembly(tmp_path / "cube.toml")
    assert_same(other.contacts, cube.contacts, list(range(7)), np.eye(4))
    assert other.drops == pytest.approx(cube.drops)


@given(gap=st.floats(-4e-4, 4e-4), clearance=st.floats(0, 2e-4))
def test_a_gap_within_the_fit_is_a_contact_on_the_middle_plane(gap: float, clearance: float) -> None:
    limit = 2 * clearance + GAP_TOLERANCE
    if abs(abs(gap) - limit) < 1e-9:
        return
    pieces = [box((0.02, 0.02, 0.02), "a", clearance), box((0.01, 0.01, 0.01), "b", clearance)]
    goals = np.array([make_transform(), make_transform(None, (0, 0, 0.015 + gap))])
    contacts = find_contacts(pieces, goals, support_height=-1.0)
    assert len(contacts) == (abs(gap) < limit)
    for contact in contacts:
        assert contact.normal == pytest.approx((0, 0, 1))
        assert contact.area == pytest.approx(1e-4)
        assert contact.points[:, 2] == pytest.approx(0.01 + gap / 2, abs=1e-9)


def test_faces_that_share_less_than_a_square_millimetre_do_not_touch() -> None:
    pieces = [box((0.02, 0.02, 0.02), "a"), box((0.02, 0.02, 0.02), "b")]
    for overlap, count in ((4e-5, 0), (6e-5, 1)):
        goals = np.array([make_transform(), make_transform(None, (0.02 - overlap, 0, 0.02))])
        assert len(find_contacts(pieces, goals, support_height=-1.0)) == count


def test_two_feet_on_one_body_are_one_patch() -> None:
    """A bridge on a plate: its contact spans both feet, the area is that of the feet alone."""
    bridge = trimesh.util.concatenate(
        trimesh.boolean.difference(
            [trimesh.creation.box((0.06, 0.02, 0.02)), _moved_box((0.02, 0.04, 0.02), (0, 0, -0.01))]
        )
    )
    pieces = [
        box((0.08, 0.08, 0.01), "plate"),
        Workpiece("bridge", readonly(bridge.vertices), readonly(bridge.faces, int)),
    ]
    goals = np.array([make_transform(None, (0, 0, 0.005)), make_transform(None, (0, 0, 0.02))])
    between = [contact for contact in find_contacts(pieces, goals, 0.0) if contact.body_a == 0]
    assert len(between) == 1
    assert between[0].area == pytest.approx(2 * 4e-4)
    assert np.ptp(between[0].points, axis=0) == pytest.approx((0.06, 0.02, 0))


def _moved_box(size: tuple[float, float, float], offset: tuple[float, float, float]) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(size)
    mesh.apply_translation(offset)
    return mesh


def test_drops_add_up_along_the_pieces_that_carry() -> None:
    """Each face stands back by the clearance, so a piece on the support drops by one and each one above by
    two more."""
    assert ASSEMBLIES["soma3"].drops * 1e3 == pytest.approx(
        [0.3, 0.3, 0.1]
    )  # smallL lies on Z and BigL: Z is the higher
    pieces = tuple(
        box((0.02, 0.02, 0.02), str(c), clearance) for c, clearance in enumerate((1e-4, 2e-4, 0.0))
    )
    goals = np.array([make_transform(None, (0, 0, 0.01 + 0.02 * level)) for level in range(3)])
    assert replace(ASSEMBLIES["soma3"], pieces=pieces, goals=goals).drops == pytest.approx([1e-4, 4e-4, 6e-4])
