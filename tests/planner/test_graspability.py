"""Grasps lie on the piece, and each further piece around leaves fewer."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
import trimesh
from blocks import box, refined
from hypothesis import given, settings
from hypothesis import strategies as st
from manifold3d import Manifold
from scipy.spatial import KDTree

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.frames import Array, apply
from soma_bullet.grasp.clearance import MARGIN, OPENING, SUPPORT_MARGIN, hand_hulls, sweep_hand
from soma_bullet.grasp.hand import Hand
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.grasp.options import SamplingOptions
from soma_bullet.grasp.sampling import GraspSet, sample_grasps
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.qualities import Qualities
from soma_bullet.planner.ways import way_length

ALL = {name: load_assembly(name) for name in ("soma3", "soma4")}
PIECES = {piece.name: piece for whole in ALL.values() for piece in whole.pieces}


@pytest.fixture(scope="module")
def qualities(hand: Hand) -> dict[str, Qualities]:
    return {name: Qualities(whole, HandSet.alike(hand), PlannerOptions()) for name, whole in ALL.items()}


def surface(piece: Workpiece, points: Array, directions: Array) -> tuple[Array, Array]:
    """Distance (n,) of points from the surface, and how well a face there looks along `directions` (n, 3):
    trimesh's word."""
    triangles = piece.mesh.triangles
    count = len(triangles)
    there = np.repeat(points, count, axis=0)
    closest = trimesh.triangles.closest_point(np.tile(triangles, (len(points), 1, 1)), there)
    distance = np.linalg.norm(closest - there, axis=1).reshape(-1, count)
    facing = directions @ piece.mesh.face_normals.T
    return distance.min(axis=1), np.where(distance < 1e-6, facing, -1.0).max(axis=1)


@pytest.mark.parametrize("name", sorted(PIECES))
def test_pads_lie_on_opposite_faces(name: str, hand: Hand) -> None:
    piece = PIECES[name]
    grasps = sample_grasps(piece, HandSet.alike(hand))
    assert len(grasps) > 100
    closing = grasps.Ts_piece_tcp[:, :3, 0]
    for side in (1, -1):
        pads = grasps.Ts_piece_tcp[:, :3, 3] + side * closing * grasps.widths[:, None] / 2
        distance, facing = surface(piece, pads, side * closing)
        assert distance.max() < 1e-6
        assert facing.min() > 1 - 1e-9


@pytest.mark.parametrize("name", sorted(PIECES))
def test_grasps_fit_the_hand(name: str, hand: Hand) -> None:
    options = SamplingOptions()
    grasps = sample_grasps(PIECES[name], HandSet.alike(hand), options)
    assert grasps.widths.max() <= hand.opening - 2 * options.opening_margin
    assert grasps.widths.min() >= options.smallest_width
    assert (grasps.contact >= options.smallest_contact).all() and (grasps.contact <= 1).all()
    rotations = grasps.Ts_piece_tcp[:, :3, :3]
    np.testing.assert_allclose(
        rotations @ np.swapaxes(rotations, 1, 2), np.tile(np.eye(3), (len(grasps), 1, 1)), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0)


def test_a_box_too_wide_is_gripped_across_its_other_sides(hand: Hand) -> None:
    wide = sample_grasps(box((hand.opening + 0.01, 0.03, 0.03)), HandSet.alike(hand))
    assert len(wide) > 0
    assert np.abs(wide.Ts_piece_tcp[:, 0, 0]).max() < 1e-9
    assert len(sample_grasps(box((0.1, 0.1, 0.1)), HandSet.alike(hand))) == 0


def test_the_fraction_of_the_pad_on_the_piece(hand: Hand) -> None:
    """A plate half as high as the pad carries half of it."""
    grasps = sample_grasps(box((0.02, 0.1, hand.pad_size[1] / 2)), HandSet.alike(hand))
    across = np.abs(grasps.Ts_piece_tcp[:, 0, 0]) > 0.99
    upright = np.abs(grasps.Ts_piece_tcp[:, 2, 2]) > 0.99
    middle = np.abs(grasps.Ts_piece_tcp[:, 1, 3]) < 0.03
    assert grasps.contact[across & upright & middle] == pytest.approx(0.5, abs=1e-6)


@pytest.mark.parametrize("name", sorted(ALL))
def test_each_piece_around_leaves_fewer_grasps(name: str, qualities: dict[str, Qualities]) -> None:
    judge, count = qualities[name], len(ALL[name].pieces)
    for piece in range(count):
        for others in permutations([k for k in range(count) if k != piece]):
            left = [
                set(judge.accessible(piece, frozenset(others[:k])).tolist()) for k in range(len(others) + 1)
            ]
            assert all(after <= before for before, after in zip(left, left[1:], strict=False))
            chosen = judge.candidates(piece, frozenset(others)).tolist()  # clear on the way in too
            assert set(chosen) <= left[-1] and judge.graspability(piece, frozenset(others)) == len(chosen)
            assert left[0] <= set(range(len(judge.grasps(piece))))


def test_accessible_hands_keep_their_distance(qualities: dict[str, Qualities], hand: Hand) -> None:
    """By the vertices of the hand's boxes at the grasp: none in a placed piece, none below the support."""
    judge, whole = qualities["soma3"], ALL["soma3"]
    piece, placed = whole.index("BigL"), frozenset({whole.index("Z")})
    for index in judge.accessible(piece, placed)[::10]:
        T = whole.goals[piece] @ judge.grasps(piece).Ts_piece_tcp[index]
        for hull in hand_hulls(hand, T, judge.grasps(piece).widths[index]):
            assert hull.vertices[:, 2].min() > whole.support.height + SUPPORT_MARGIN - 1e-9
            for part in whole.goal_parts[whole.index("Z")]:
                assert (hull.vertices @ part.normals.T - part.offsets).max(axis=1).min() > MARGIN - 1e-9


def test_the_sweep_holds_the_hand_all_along_the_way_out(hand: Hand) -> None:
    T = np.eye(4)[None]
    sweep = sweep_hand(hand, T, np.array([0.02]))
    for back in np.linspace(0, hand.way_out, 4):
        for opening in (0.0, OPENING):
            shifted = np.eye(4)
            shifted[2, 3] = -back
            hulls = hand_hulls(hand, shifted, 0.02 + 2 * opening)
            (boxes,) = sweep.groups
            for hull, centre, generators in zip(
                hulls, boxes.centres[:, 0], boxes.generators[:, 0], strict=True
            ):
                reach = np.abs(generators).sum(axis=0)
                assert (np.abs(hull.vertices - centre) <= reach + 1e-9).all()


@settings(max_examples=4)
@given(seed=st.integers(0, 1000))
def test_tessellation_changes_no_grasp(seed: int, hand: Hand) -> None:
    whole = ALL["soma3"]
    for coarse, fine in zip(whole.pieces, refined(whole, seed).pieces, strict=True):
        first, second = (sample_grasps(piece, HandSet.alike(hand)) for piece in (coarse, fine))
        assert len(first) == len(second)
        trees = [KDTree(features(grasps)) for grasps in (first, second)]
        for one, other in (trees, trees[::-1]):
            assert one.query(other.data)[0].max() < 1e-6


def features(grasps: GraspSet) -> Array:
    """What tells grasps apart (n, 14); which finger is the first does not."""
    Ts = np.array(grasps.Ts_piece_tcp)
    swapped = Ts[:, :3, 0] @ (0.9, 0.37, 0.23) < 0
    Ts[swapped] = Ts[swapped] @ np.diag((-1.0, -1.0, 1.0, 1.0))
    return np.column_stack([Ts[:, :3].reshape(-1, 12), grasps.widths, grasps.contact])


def test_the_set_is_frozen(hand: Hand) -> None:
    piece = PIECES["Z"]
    first, second = sample_grasps(piece, HandSet.alike(hand)), sample_grasps(piece, HandSet.alike(hand))
    np.testing.assert_array_equal(first.Ts_piece_tcp, second.Ts_piece_tcp)
    with pytest.raises(ValueError):
        first.widths[0] = 1.0
    taken = first.take(np.array([3, 1]))
    np.testing.assert_array_equal(taken.Ts_piece_tcp[1], first.Ts_piece_tcp[1])


def test_assisting_hands_are_clear_of_the_next_piece_all_along(
    qualities: dict[str, Qualities], hand: Hand
) -> None:
    judge, whole = qualities["soma3"], ALL["soma3"]
    z, big = whole.index("Z"), whole.index("BigL")
    placed = frozenset({z})
    direction = judge.assemblability(big, placed).direction
    chosen = judge.assisting(z, placed, big, direction)
    assert 0 < len(chosen) < len(judge.accessible(z, placed))
    way = np.ptp(np.vstack([part.vertices for part in whole.goal_parts[big]]) @ direction)
    for index in chosen[::8]:
        T = whole.goals[z] @ judge.grasps(z).Ts_piece_tcp[index]
        for back in np.linspace(0, way, 9):
            motion = np.eye(4)
            motion[:3, 3] = -direction * back
            for part in whole.goal_parts[big]:
                there = part.moved(motion)
                for hull in hand_hulls(hand, T, judge.grasps(z).widths[index]):
                    assert (hull.vertices @ there.normals.T - there.offsets).max(axis=1).min() > 0
                    assert (there.vertices @ hull.normals.T - hull.offsets).max(axis=1).min() > 0


def test_points_of_a_moved_piece_move_with_it() -> None:
    whole: Assembly = ALL["soma3"]
    for piece, goal, parts in zip(whole.pieces, whole.goals, whole.goal_parts, strict=True):
        corners = apply(goal, piece.vertices)
        assert all((corners @ part.normals.T - part.offsets).max(axis=1).min() < 1e-9 for part in parts)


def test_a_candidate_keeps_clear_all_along_the_insertion(qualities: dict[str, Qualities], hand: Hand) -> None:
    """Checked at a dozen places of the way, pair by pair; and some grasp that is free at the goal is none on
    the way."""
    judge, fewer = qualities["soma4"], 0
    whole = judge.assembly
    for piece in range(4):
        placed = frozenset(range(4)) - {piece}
        way, candidates = judge.assemblability(piece, placed).direction, judge.candidates(piece, placed)
        for other in judge.ways.into(piece, placed):
            along = judge.candidates_along(piece, placed, other.direction)
            fewer += len(judge.accessible(piece, placed)) - len(along)
        if way is None:
            continue
        around = [Manifold.hull_points(hull.vertices * 1e3) for k in placed for hull in whole.goal_parts[k]]
        for index in candidates[::15]:
            for share in np.linspace(0, 1, 12):
                T = np.array(whole.goals[piece] @ judge.grasps(piece).Ts_piece_tcp[index])
                T[:3, 3] -= share * way_length(whole, piece, way) * way
                hulls = hand_hulls(hand, T, float(judge.grasps(piece).widths[index]))
                for box_mm in (Manifold.hull_points(hull.vertices * 1e3) for hull in hulls):
                    assert min(box_mm.min_gap(other, 5.0) for other in around) > MARGIN * 1e3 - 1e-3
    assert fewer > 0
