"""The exploded view: pieces apart, moved back along their ways, each named."""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.pictures import exploded
from soma_bullet.pictures.exploded import APART, draw_exploded, explode, place_labels
from soma_bullet.pictures.raster import Camera, fit_camera
from soma_bullet.pictures.shapes import assembly_size, piece_body
from soma_bullet.planner.assembly_plan import AssemblyPlan


@pytest.fixture
def blank(monkeypatch: pytest.MonkeyPatch) -> None:
    def render(bodies: object, camera: Camera, **_: object) -> np.ndarray:
        return np.full((camera.height, camera.width, 4), 255, np.uint8)

    monkeypatch.setattr(exploded, "render", render)


def test_pieces_go_back_along_their_ways_until_they_are_apart(soma3: Assembly, plan: AssemblyPlan) -> None:
    order = [soma3.index(step.piece) for step in plan.steps]
    directions = np.array([step.direction for step in plan.steps])
    shifts = explode(soma3, order, directions)
    assert not shifts[0].any()
    for shift, direction in zip(shifts[1:], directions[1:], strict=True):
        assert shift / np.linalg.norm(shift) == pytest.approx(-direction)
    boxes = [
        [
            (part.vertices.min(axis=0) + shift, part.vertices.max(axis=0) + shift)
            for part in soma3.goal_parts[k]
        ]
        for k, shift in zip(order, shifts, strict=True)
    ]
    for first, second in itertools.combinations(boxes, 2):
        for (low, high), (other_low, other_high) in itertools.product(first, second):
            assert max((low - other_high).max(), (other_low - high).max()) > APART * assembly_size(soma3)


def test_of_pieces_that_come_the_same_way_later_ones_are_farther() -> None:
    cube = load_assembly("cube")
    order = list(range(len(cube.pieces)))
    shifts = explode(cube, order, np.tile((0.0, 0.0, -1.0), (len(order), 1)))
    assert (np.diff([shift[2] for shift in shifts]) >= 0).all()


def test_a_piece_never_goes_below_the_support(soma3: Assembly) -> None:
    order = list(range(len(soma3.pieces)))
    shifts = explode(soma3, order, np.tile((0.0, 0.0, 1.0), (len(order), 1)))
    for k, shift in zip(order, shifts, strict=True):
        lowest = min(part.vertices[:, 2].min() for part in soma3.goal_parts[k])
        assert lowest + shift[2] > -1e-9


def test_labels_lie_on_the_sheet_and_beside_each_other(soma3: Assembly) -> None:
    bodies = tuple(piece_body(soma3, k) for k in range(3))
    points = np.concatenate([one.triangles.reshape(-1, 3) for one in bodies])
    camera = fit_camera(points, 0.4, 0.4, 1500, 1200, 0.2)
    places = place_labels(bodies, list(soma3.names), camera)
    for place in places:
        assert 0 <= place.left <= 7.5 - place.width
        assert 0 <= place.top <= 6.0 - 0.22
    for a, b in itertools.combinations(places, 2):
        beside = a.left + a.width <= b.left or b.left + b.width <= a.left
        assert beside or abs(a.top - b.top) >= 0.22


@pytest.mark.usefixtures("blank")
def test_every_piece_is_numbered_and_named(soma3: Assembly, plan: AssemblyPlan, tmp_path: Path) -> None:
    root = ElementTree.parse(draw_exploded(soma3, plan, tmp_path / "exploded.svg")).getroot()
    texts = [" ".join("".join(e.itertext()).split()) for e in root.iter("{http://www.w3.org/2000/svg}text")]
    assert texts == [f"{k + 1} {name}" for k, name in enumerate(plan.order)]


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["png", "svg", "pdf"])
def test_the_picture_is_deterministic_and_small(
    ending: str, soma3: Assembly, plan: AssemblyPlan, tmp_path: Path
) -> None:
    first, second = (draw_exploded(soma3, plan, tmp_path / f"{k}.{ending}").read_bytes() for k in "ab")
    assert first == second
    assert len(first) < 600_000
