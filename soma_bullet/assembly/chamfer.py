"""Chamfers: the outer edges of a real body cut off at equal distances from the edge along both faces (45 deg
at a right angle).

A body of maximal boxes is the union of its boxes with all their edges cut: an edge of one box that is no edge
of the body lies inside another box. Only a dent of the chamfer's size remains at the ends of inner corners.
Of other bodies those edges of the parts are cut whose faces both bound the body, that turn by SHARP at least,
and beside which no other part goes on; an edge that is one of the body's over a part of its length only stays
as it is."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from soma_bullet.assembly.decomposition import Decomposition
from soma_bullet.assembly.hulls import Hull
from soma_bullet.frames import Array, Indices

SHARP = np.deg2rad(45.0)  # [rad] an edge that turns by less is one of a round side, or rounds itself
ON = 1e-7  # [m] from a corner to the planes that meet there
BESIDE = 1e-5  # [m] beside an edge it is looked for other parts
SAMPLES = np.linspace(0.05, 0.95, 10)  # along an edge


def edge_cuts(decomposition: Decomposition, clearance: float, chamfer: float) -> tuple[Array, ...]:
    """Half-spaces (k, 4) normal . x + offset <= 0 that cut the edges of each part, its faces `clearance` [m]
    further in."""
    parts, cuts = decomposition.parts, []
    for k, (part, solid) in enumerate(zip(parts, decomposition.solid_faces, strict=True)):
        others = () if decomposition.kind == "boxes" else parts[:k] + parts[k + 1 :]
        planes = [_cut(part, pair, clearance, chamfer) for pair in _edges(part, solid, others)]
        cuts.append(np.array(planes).reshape(-1, 4))
    return tuple(cuts)


def chamfered(decomposition: Decomposition, clearance: float, chamfer: float) -> tuple[Hull, ...]:
    """The parts of a body with every face moved inwards by `clearance` [m] and the outer edges cut by
    `chamfer` [m]."""
    found = []
    for part, faces, cuts in zip(
        decomposition.parts,
        decomposition.solid_faces,
        edge_cuts(decomposition, clearance, chamfer),
        strict=True,
    ):
        try:
            found.append(part.inset(clearance, faces).cut(cuts))
        except ValueError:  # as in Decomposition.inset
            continue
    return tuple(found)


def _edges(part: Hull, solid: Indices, others: tuple[Hull, ...]) -> list[tuple[int, int]]:
    """Pairs of faces of a part that meet in an edge of the body."""
    on = np.abs(part.vertices @ part.normals.T - part.offsets) < ON
    found = []
    for i, j in combinations(sorted(int(face) for face in solid), 2):
        ends = part.vertices[on[:, i] & on[:, j]]
        if len(ends) < 2 or part.normals[i] @ part.normals[j] > np.cos(SHARP) + 1e-9:
            continue
        along = ends[1:] - ends[0]
        far = along[int(np.argmax(np.linalg.norm(along, axis=1)))]
        line = ends[0] + SAMPLES[:, None] * far
        outward = (part.normals[i], part.normals[j], part.normals[i] + part.normals[j])
        beside = np.vstack([line + BESIDE * step for step in outward])
        if not any(
            (other.normals @ beside.T < other.offsets[:, None] + ON).all(axis=0).any() for other in others
        ):
            found.append((i, j))
    return found


def _cut(part: Hull, pair: tuple[int, int], clearance: float, chamfer: float) -> Array:
    """The half-space (4,) that cuts the edge between two faces."""
    first, second = part.normals[list(pair)]
    offsets = part.offsets[list(pair)] - clearance
    edge = np.linalg.lstsq(np.array([first, second]), offsets, rcond=None)[0]
    inward = (first @ second) * first - second  # in the first face, off the edge
    normal = (first + second) / np.linalg.norm(first + second)
    corner = edge + chamfer * inward / np.linalg.norm(inward)
    return np.array([*normal, -float(normal @ corner)])
