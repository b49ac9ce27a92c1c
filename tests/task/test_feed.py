"""The feed: uniform over its areas, at any yaw, apart from each other, at rest, and the same for the same
seed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import shapely

from soma_bullet.assembly.model import Assembly
from soma_bullet.assembly.resting import STEADY_MARGIN, STEADY_TILT, steady_poses
from soma_bullet.errors import NoSolutionError
from soma_bullet.frames import Array, apply, readonly
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.robot.model import Cell
from soma_bullet.sizes import Sizes
from soma_bullet.task.feed import (
    Feed,
    draw_feed,
    misplace,
    preferred_resting_pose,
    serving_grasps,
)
from soma_bullet.task.feed_options import FeedOptions

SEEDS = range(50)
ALL = FeedOptions(poses="all")

APART = Sizes(1.0).apart  # [m]


@pytest.fixture(scope="module")
def feeds(soma3: Assembly, plan: AssemblyPlan, cell: Cell) -> list[Feed]:
    return [draw_feed(soma3, plan, cell, seed, ALL) for seed in SEEDS]


@pytest.fixture(scope="module")
def centres(soma3: Assembly, feeds: list[Feed]) -> Array:
    """Centres of mass (seeds, pieces, 3)."""
    return np.array([[apply(f.pose(p.name), p.center_of_mass) for p in soma3.pieces] for f in feeds])


def outline(feed: Feed, assembly: Assembly, name: str) -> shapely.Geometry:
    vertices = apply(feed.pose(name), assembly.pieces[assembly.index(name)].vertices)
    return shapely.multipoints(vertices[:, :2]).convex_hull


def yaw_of(pose: Array, rest: Array) -> float:
    turn = pose[:3, :3] @ rest[:3, :3].T
    np.testing.assert_allclose(turn[2], (0, 0, 1), atol=1e-12)
    return float(np.arctan2(turn[1, 0], turn[0, 0]))


def test_places_are_in_the_areas_and_spread_over_all_of_them(centres: Array, cell: Cell) -> None:
    places = centres[..., :2].reshape(-1, 2)
    areas = cell.feed_areas
    inside = np.array([((places >= area[:, 0]) & (places <= area[:, 1])).all(axis=1) for area in areas])
    assert (inside.sum(axis=0) == 1).all()
    for area, mine in zip(areas, inside, strict=True):
        assert mine.mean() == pytest.approx(1 / len(areas), abs=0.15)
        scaled = (places[mine] - area[:, 0]) / (area[:, 1] - area[:, 0])
        quarters = np.histogram2d(*scaled.T, bins=2)[0] / mine.sum()
        np.testing.assert_allclose(quarters, 0.25, atol=0.15)
        assert scaled.min() < 0.05 and scaled.max() > 0.95


def test_yaws_are_all_around(feeds: list[Feed], soma3: Assembly, plan: AssemblyPlan, cell: Cell) -> None:
    preferred = [draw_feed(soma3, plan, cell, seed, FeedOptions(poses="preferred")) for seed in SEEDS]
    for name in soma3.names:
        rest = preferred_resting_pose(soma3, plan, cell.hands, name)
        yaws = np.array([yaw_of(feed.pose(name), rest) for feed in preferred])
        assert yaws.min() < -2.6 and yaws.max() > 2.6
        assert np.histogram(yaws, bins=4, range=(-np.pi, np.pi))[0].min() > len(feeds) / 15
        assert np.hypot(np.cos(yaws).mean(), np.sin(yaws).mean()) < 0.3


def resting_index(pose: Array, poses: Array) -> int:
    """Which resting pose a pose is, up to place and yaw."""
    return int(np.argmin([np.abs(pose[2, :3] - rest[2, :3]).max() for rest in poses]))


def test_every_steady_pose_is_drawn_about_as_often(feeds: list[Feed], soma3: Assembly) -> None:
    for piece in soma3.pieces:
        poses = steady_poses(piece)
        drawn = np.bincount(
            [resting_index(feed.pose(piece.name), poses) for feed in feeds], minlength=len(poses)
        )
        expected = len(feeds) / len(poses)
        assert (drawn > 0).all() and (
            (drawn - expected) ** 2 / expected
        ).sum() < 18.5  # chi-square, 5 dof, 0.25 %


def test_steady_poses_fall_back(soma3: Assembly) -> None:
    """Tilted by STEADY_TILT about any edge of what it stands on, the piece's centre of mass is still inside
    of that edge."""
    for piece in soma3.pieces:
        for pose in steady_poses(piece):
            vertices, com = apply(pose, piece.vertices), apply(pose, piece.center_of_mass)
            feet = vertices[vertices[:, 2] < vertices[:, 2].min() + 1e-6][:, :2]
            corners = np.array(shapely.multipoints(feet).convex_hull.exterior.coords)
            height = com[2] - vertices[:, 2].min()
            for a, b in zip(corners[:-1], corners[1:], strict=True):
                along = (b - a) / np.linalg.norm(b - a)
                inside = abs(along[0] * (com[1] - a[1]) - along[1] * (com[0] - a[0]))
                assert inside > STEADY_MARGIN and inside > height * np.tan(STEADY_TILT)


def test_pieces_that_need_a_regrasp_are_counted(
    feeds: list[Feed], soma3: Assembly, plan: AssemblyPlan, cell: Cell
) -> None:
    for feed in feeds[:10]:
        served = [len(serving_grasps(soma3, plan, cell.hands, name, feed.pose(name))) for name in feed.names]
        assert feed.regrasps_needed == served.count(0)


def test_pieces_keep_apart(feeds: list[Feed], soma3: Assembly) -> None:
    for feed in feeds:
        outlines = [outline(feed, soma3, name) for name in soma3.names]
        gaps = [a.distance(b) for k, a in enumerate(outlines) for b in outlines[k + 1 :]]
        assert min(gaps) >= APART
    assert sum(feed.overlaps for feed in feeds) > 0
    assert all(0 <= feed.rejected < 1 for feed in feeds)


def test_pieces_lie_at_rest(feeds: list[Feed], soma3: Assembly) -> None:
    """The real body's lowest points are on the table, and the centre of mass is well above the inside of what
    they span."""
    for feed in feeds[:10]:
        for piece in soma3.pieces:
            vertices = apply(feed.pose(piece.name), piece.vertices)
            assert vertices[:, 2].min() == pytest.approx(-piece.clearance, abs=1e-9)
            feet = vertices[vertices[:, 2] < vertices[:, 2].min() + 1e-6]
            centre = shapely.Point(apply(feed.pose(piece.name), piece.center_of_mass)[:2])
            base = shapely.multipoints(feet[:, :2]).convex_hull
            assert base.contains(centre) and base.exterior.distance(centre) > 2e-3


def test_every_piece_can_be_gripped_where_it_lies(soma3: Assembly, plan: AssemblyPlan, cell: Cell) -> None:
    hands = cell.hands
    for name in soma3.names:
        rest = preferred_resting_pose(soma3, plan, hands, name)
        found = serving_grasps(soma3, plan, hands, name, rest)
        step = next(step for step in plan.steps if step.piece == name)
        assert len(found) and set(found) <= set(step.grasps)


def test_the_seed_decides(soma3: Assembly, plan: AssemblyPlan, cell: Cell, feeds: list[Feed]) -> None:
    again = draw_feed(soma3, plan, cell, 7, ALL)
    assert again.poses.tobytes() == feeds[7].poses.tobytes()
    assert (again.names, again.overlaps, again.seed) == (feeds[7].names, feeds[7].overlaps, 7)
    assert len({feed.poses.tobytes() for feed in feeds}) == len(feeds)
    assert not again.poses.flags.writeable


def test_rows(soma3: Assembly, plan: AssemblyPlan, cell: Cell) -> None:
    feed = draw_feed(soma3, plan, cell, 3, FeedOptions(layout="rows"))
    assert feed.poses.tobytes() == draw_feed(soma3, plan, cell, 4, FeedOptions(layout="rows")).poses.tobytes()
    areas = cell.feed_areas
    for k, name in enumerate(plan.order):
        pose, rest = feed.pose(name), preferred_resting_pose(soma3, plan, cell.hands, name)
        np.testing.assert_allclose(pose[:3, :3], rest[:3, :3], atol=1e-12)
        piece, area = soma3.pieces[soma3.index(name)], areas[k % len(areas)]
        centre = apply(pose, piece.center_of_mass)
        assert (centre[:2] > area[:, 0]).all() and (centre[:2] < area[:, 1]).all()
        assert centre[1] == pytest.approx(area[1].mean())
    outlines = [outline(feed, soma3, name) for name in soma3.names]
    assert min(a.distance(b) for k, a in enumerate(outlines) for b in outlines[k + 1 :]) > APART


def test_feed_areas_that_are_too_small(
    soma3: Assembly, plan: AssemblyPlan, cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("soma_bullet.task.feed.DRAWS", 200)
    tiny = replace(cell, feed_areas=readonly([[[0.1, 0.11], [0.2, 0.21]]]))
    with pytest.raises(NoSolutionError, match=r"(BigL|smallL|Z) does not fit into the feed areas"):
        draw_feed(soma3, plan, tiny, 0)


# --- what is perceived and what is there --------------------------------------------------------------------


def test_noise_has_the_sigma_that_was_asked_for(soma3: Assembly, feed: Feed) -> None:
    options = FeedOptions(noise_mm=3.0, noise_deg=2.0)
    real = [misplace(soma3, feed, options, seed) for seed in range(400)]

    def centres(f: Feed) -> np.ndarray:
        return np.array([apply(T, p.center_of_mass) for T, p in zip(f.poses, soma3.pieces, strict=True)])

    shifts = np.array([centres(r) - centres(feed) for r in real]).reshape(-1, 3)
    yaws = np.rad2deg(
        [[yaw_of(a, b) for a, b in zip(r.poses, feed.poses, strict=True)] for r in real]
    ).ravel()
    np.testing.assert_allclose(shifts[:, :2].std(axis=0), 3e-3, rtol=0.08)
    np.testing.assert_allclose(shifts[:, :2].mean(axis=0), 0.0, atol=4e-4)
    assert np.abs(shifts[:, 2]).max() < 1e-15
    assert yaws.std() == pytest.approx(2.0, rel=0.08)
    assert yaws.mean() == pytest.approx(0.0, abs=0.25)
    assert abs(np.corrcoef(np.column_stack([shifts[:, :2], yaws]).T)[np.triu_indices(3, 1)]).max() < 0.12


def test_uniform_errors_fill_the_disc_and_end_at_its_rim(soma3: Assembly, feed: Feed) -> None:
    options = FeedOptions(noise_mm=1.0, noise_deg=2.0, errors="uniform")
    real = [misplace(soma3, feed, options, seed) for seed in range(400)]

    def centres(f: Feed) -> np.ndarray:
        return np.array([apply(T, p.center_of_mass) for T, p in zip(f.poses, soma3.pieces, strict=True)])

    radii = np.linalg.norm([centres(r) - centres(feed) for r in real], axis=2).ravel()
    yaws = np.rad2deg(
        [[yaw_of(a, b) for a, b in zip(r.poses, feed.poses, strict=True)] for r in real]
    ).ravel()
    assert 0.97e-3 < radii.max() <= 1e-3 and 1.95 < np.abs(yaws).max() <= 2.0
    np.testing.assert_allclose(np.mean(radii < 0.5e-3), 0.25, atol=0.05)  # a quarter of the area
    assert yaws.std() == pytest.approx(2.0 / np.sqrt(3.0), rel=0.05)


def test_a_hand_makes_room_for_the_largest_uniform_error(
    soma3: Assembly, plan: AssemblyPlan, cell: Cell
) -> None:
    options = FeedOptions(noise_mm=1.0, noise_deg=2.0, errors="uniform")
    uniform = draw_feed(soma3, plan, cell, 0, options)
    for piece in soma3.pieces:
        assert uniform.off(piece) == pytest.approx(1e-3 + np.deg2rad(2.0) * piece.radius)
    assert uniform.poses.tobytes() == draw_feed(soma3, plan, cell, 0).poses.tobytes()


def test_noise_follows_the_seed_and_none_is_none(soma3: Assembly, feed: Feed) -> None:
    options = FeedOptions(noise_mm=1.0)
    assert misplace(soma3, feed, FeedOptions(), 5) is feed
    first, again, other = (misplace(soma3, feed, options, seed) for seed in (5, 5, 6))
    assert first.poses.tobytes() == again.poses.tobytes() != other.poses.tobytes()
    np.testing.assert_allclose(first.poses[:, :3, :3], feed.poses[:, :3, :3], atol=1e-12)
