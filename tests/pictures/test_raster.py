"""The renderer against what is known without it: areas, what hides what, what shines through."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from soma_bullet.pictures.raster import Body, Caster, Color, body, fit_camera
from soma_bullet.pictures.shade import Look, faded, render

BARE = Look(silhouette=0.0, crease=0.0)
RED: Color = (0.8, 0.1, 0.1)
BLUE: Color = (0.1, 0.1, 0.8)


def cube(centre: tuple[float, float, float], size: float, color: Color, alpha: float = 1.0) -> Body:
    solid = trimesh.creation.box((size, size, size))
    return body(solid.vertices + centre, solid.faces, color, alpha=alpha)


def corners(*bodies: Body) -> np.ndarray:
    return np.concatenate([one.triangles.reshape(-1, 3) for one in bodies])


@pytest.mark.parametrize(("azimuth", "elevation"), [(0.3, 0.4), (2.0, 0.0), (-1.2, 1.0)])
def test_a_cube_covers_the_area_of_its_projection(azimuth: float, elevation: float) -> None:
    block = cube((0.1, -0.2, 0.3), 0.05, RED)
    camera = fit_camera(corners(block), azimuth, elevation, 160, 120)
    outline = ConvexHull(camera.project(corners(block)))
    picture = render((block,), camera, look=BARE)
    assert picture[..., 3].sum() / 255 == pytest.approx(
        outline.volume, rel=2e-3
    )  # the volume of a flat hull is its area


@pytest.mark.parametrize(("width", "height"), [(160, 120), (100, 200)])
def test_a_fitted_camera_fills_the_picture_up_to_the_margin(width: int, height: int) -> None:
    points = np.random.default_rng(0).normal(size=(50, 3))
    seen = fit_camera(points, 0.7, 0.3, width, height, margin=0.1).project(points)
    free = np.array((seen.min(axis=0) / (width, height), 1 - seen.max(axis=0) / (width, height)))
    assert free.min() == pytest.approx(0.1, abs=1e-3)
    assert np.allclose(free[0], free[1], atol=1e-3)


def test_the_ray_of_a_pixel_meets_what_is_projected_there() -> None:
    block = cube((0, 0, 0), 0.1, RED)
    camera = fit_camera(corners(block), 0.5, 0.4, 64, 64)
    hits = Caster((block,)).first(camera.eye, camera.rays(1).reshape(-1, 3))
    number = 30 * 64 + 37
    point = camera.eye + float(hits.distance[number]) * camera.rays(1).reshape(-1, 3)[number]
    assert np.abs(point).max() == pytest.approx(0.05, abs=1e-5)
    assert camera.project(point) == pytest.approx((37.5, 30.5), abs=1e-2)


def test_rays_of_a_window_are_those_of_the_picture() -> None:
    camera = fit_camera(np.eye(3), 0.5, 0.4, 40, 30)
    assert np.array_equal(camera.rays(2, (10, 5, 20, 15)), camera.rays(2)[10:30, 20:40])


def test_the_nearer_body_hides_the_other() -> None:
    near, far = cube((0.2, 0, 0), 0.1, RED), cube((-0.2, 0, 0), 0.1, BLUE)
    camera = fit_camera(corners(near, far), 0.0, 0.0, 60, 60)
    middle = render((near, far), camera, look=BARE)[30, 30]
    assert middle[0] > 2 * middle[2]
    turned = fit_camera(corners(near, far), np.pi, 0.0, 60, 60)
    middle = render((near, far), turned, look=BARE)[30, 30]
    assert middle[2] > 2 * middle[0]


def test_glass_shows_what_is_behind_it() -> None:
    solid, glass = cube((-0.2, 0, 0), 0.1, BLUE), cube((0.2, 0, 0), 0.1, RED, alpha=0.5)
    camera = fit_camera(corners(solid, glass), 0.0, 0.0, 60, 60)
    alone = render((solid,), camera, look=BARE)[30, 30].astype(int)
    through = render((solid, glass), camera, look=BARE)[30, 30].astype(int)
    air = render((glass,), camera, look=BARE)[30, 30].astype(int)
    assert air[3] == pytest.approx(128, abs=2)
    assert through[3] == 255
    assert through[:3] == pytest.approx((alone[:3] + air[:3]) / 2, abs=2)


def test_glass_behind_a_body_is_not_seen_and_a_mark_is() -> None:
    solid, behind = cube((0.2, 0, 0), 0.2, BLUE), cube((-0.2, 0, 0), 0.05, RED, alpha=0.5)
    camera = fit_camera(corners(solid, behind), 0.0, 0.0, 60, 60)
    alone = render((solid,), camera)
    assert np.array_equal(render((solid, behind), camera), alone)
    mark = render((solid, replace(behind, on_top=True)), camera)
    assert not np.array_equal(mark[30, 30], alone[30, 30])


def test_a_body_darkens_the_ground_and_glass_does_not() -> None:
    for alpha, dark in ((1.0, True), (0.5, False)):
        block = cube((0, 0, 0.05), 0.1, RED, alpha=alpha)
        camera = fit_camera(corners(block), 0.4, 0.5, 80, 80, margin=0.3)
        bare, shaded = render((block,), camera, look=BARE), render((block,), camera, ground=0.0, look=BARE)
        assert (shaded[..., 3].sum() > bare[..., 3].sum()) == dark


def test_edges_are_darker_than_faces() -> None:
    block = cube((0, 0, 0), 0.1, (0.9, 0.9, 0.9))
    camera = fit_camera(corners(block), 0.6, 0.4, 80, 80)
    plain, inked = render((block,), camera, look=BARE)[..., 0], render((block,), camera)[..., 0]
    inside = render((block,), camera, look=BARE)[..., 3] == 255
    share = float((plain[inside].astype(int) - inked[inside] > 30).mean())
    assert 0.02 < share < 0.25


def test_a_background_fills_the_picture() -> None:
    block = cube((0, 0, 0), 0.1, RED)
    picture = render(
        (block,),
        fit_camera(corners(block), 0.6, 0.4, 40, 40, margin=0.2),
        look=Look(background=(1.0, 1.0, 1.0)),
    )
    assert (picture[..., 3] == 255).all()
    assert (picture[0, 0] == 255).all()


def test_the_same_scene_gives_the_same_bytes() -> None:
    scene = (cube((0, 0, 0.1), 0.1, RED), cube((0.1, 0, 0.1), 0.1, BLUE, alpha=0.5))
    camera = fit_camera(corners(*scene), 0.6, 0.4, 80, 60)
    assert render(scene, camera, ground=0.0).tobytes() == render(scene, camera, ground=0.0).tobytes()


def test_a_faded_picture_is_grey_and_keeps_what_is_empty() -> None:
    block = cube((0, 0, 0), 0.1, RED)
    picture = render((block,), fit_camera(corners(block), 0.6, 0.4, 40, 40, margin=0.2))
    pale = faded(picture)
    assert (np.ptp(pale[..., :3].astype(int), axis=2) == 0).all()
    assert ((pale[..., 3] == 0) == (picture[..., 3] == 0)).all()
