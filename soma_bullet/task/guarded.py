"""How much of an insertion is slow and guided by the wrist's force: from where the piece comes near what
stands there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from soma_bullet.assembly.hulls import Hull, box_hull
from soma_bullet.frames import Array
from soma_bullet.task.workcell import Workcell

FREE = 2e-3  # [m] of insertion that is never slow: what runs in starts clear


def guarded_length(
    workcell: Workcell, piece: str, direction: Array, length: float, standing: Mapping[str, Array]
) -> float:
    """How long the slow part of an insertion is [m].

    Args:
        direction: unit vector of the insertion (3,); length: of all of it [m].
        standing: T_world_piece (4, 4) of the pieces that stand there.
    """
    names, sizes = workcell.assembly.names, workcell.sizes
    moving = _body(workcell, piece, workcell.settled[piece])
    fixed = [part for name in names if name in standing for part in _body(workcell, name, standing[name])]
    fixed.append(_stand(workcell))
    last = last_near(moving, -np.asarray(direction), length, fixed, sizes.near)
    return max(sizes.place, min(last + sizes.before_near, length - FREE))


def _body(workcell: Workcell, piece: str, pose: Array) -> list[Hull]:
    return [part.moved(pose) for part in workcell.body(piece).body_parts]


def _stand(workcell: Workcell) -> Hull:
    half = (
        np.array((*workcell.robot.stand_size, max(workcell.cell.stand_height, 2 * workcell.sizes.near))) / 2
    )
    centre = np.array((*workcell.cell.stand_centre, workcell.cell.stand_height - half[2]))
    return box_hull(centre, np.eye(3), half)


def last_near(
    moving: Sequence[Hull], away: Array, length: float, fixed: Sequence[Hull], near: float
) -> float:
    """How far polytopes can move along a unit vector (3,), at most `length` [m], and still be nearer than
    NEAR to others.

    Along every separating axis two polytopes are near over one interval of the way, and near at all over what
    these have in common; what is apart along no axis counts as near. Returns 0 where they never are."""
    last = 0.0
    sweep = away * length
    for body in moving:
        low, high = (
            body.bounds[0] + np.minimum(sweep, 0.0) - near,
            body.bounds[1] + np.maximum(sweep, 0.0) + near,
        )
        for other in fixed:
            if (other.bounds[0] > high).any() or (other.bounds[1] < low).any():
                continue
            crossed = np.cross(body.edges[:, None], other.edges[None]).reshape(-1, 3)
            norms = np.linalg.norm(crossed, axis=1)
            axes = np.vstack([body.axes, other.axes, crossed[norms > 1e-9] / norms[norms > 1e-9, None]])
            mine, theirs = axes @ body.vertices.T, axes @ other.vertices.T
            first = (
                theirs.min(1) - mine.max(1) - near
            )  # along the axis the body must have come farther than this
            beyond = theirs.max(1) - mine.min(1) + near  # and less far than that
            speed = axes @ away
            moves = np.abs(speed) > 1e-9
            if ((first >= 0) | (beyond <= 0))[~moves].any():
                continue
            ends = np.sort(np.column_stack([first[moves], beyond[moves]]) / speed[moves, None], axis=1)
            start, end = max(0.0, float(ends[:, 0].max())), min(length, float(ends[:, 1].min()))
            if start < end:
                last = max(last, end)
    return last
