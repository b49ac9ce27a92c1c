"""Collision boxes of pieces in the simulator: the same body, of boxes that overlap little."""

from __future__ import annotations

import numpy as np
import pytest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.hulls import Hull
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.bullet.bodies import sparing
from soma_bullet.frames import Array
from tests.blocks import cells

PIECES = load_assembly("cube").pieces
RING = cells([(x, y, 0) for x in (0, 1, 2) for y in (0, 1, 2) if (x, y) != (1, 1)], "ring")
SLAB = cells([(x, y, 0) for x in (0, 1, 2) for y in (0, 1)] + [(0, 0, 1)], "slab")


def covered(parts: tuple[Hull, ...], points: Array) -> Array:
    """In how many of the parts each point lies."""
    return np.sum([np.all(points @ part.normals.T < part.offsets, axis=1) for part in parts], axis=0)


@pytest.mark.parametrize("piece", [*PIECES, RING, SLAB], ids=lambda piece: piece.name)
def test_the_union_is_the_same_and_overlaps_little(piece: Workpiece) -> None:
    points = np.random.default_rng(0).uniform(
        piece.vertices.min(axis=0), piece.vertices.max(axis=0), (20_000, 3)
    )
    before, after = covered(piece.body_parts, points), covered(sparing(piece.body_parts), points)
    np.testing.assert_array_equal(before > 0, after > 0)
    assert (after > 1).mean() < 0.1
    assert len(sparing(piece.body_parts)) <= len(piece.body_parts)


def test_the_boxes_reach_into_each_other() -> None:
    """Else a face that ends where two boxes meet has its edge on another edge."""
    bar, rest = sparing(cells([(0, 0, 0), (1, 0, 0), (2, 0, 0), (2, 1, 0)], "L").body_parts)
    assert 2e-4 < bar.bounds[1][1] - rest.bounds[0][1] < 3e-3


def test_other_bodies_keep_their_parts() -> None:
    single = cells([(0, 0, 0)], "single").body_parts
    assert sparing(single) == tuple(single)
    turned = next(part for part in RING.body_parts if part.box is not None)
    plain = Hull(turned.vertices, turned.normals, turned.offsets, turned.edges)
    assert sparing((*RING.body_parts, plain)) == (*RING.body_parts, plain)
