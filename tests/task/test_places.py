"""Where pieces may be put down, and where hands may meet."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from soma_bullet.frames import Array, apply, inverse, translate
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.task.places import YAWS, free_places, meeting_poses
from soma_bullet.task.program.program import Program
from soma_bullet.task.search.scheduler import Scheduler
from soma_bullet.task.workcell import Workcell


def outline(workcell: Workcell, piece: str, pose: Array) -> shapely.Geometry:
    return shapely.multipoints(apply(pose, workcell.body(piece).vertices)[:, :2]).convex_hull


@pytest.mark.parametrize("rest", [0, 1])
def test_a_free_place_has_room_around_it(
    rest: int, workcell: Workcell, plan: AssemblyPlan, program: Program
) -> None:
    """From all pieces and from the stand; every place that has it is found, at all yaws."""
    feed, (piece, *others) = program.feed, plan.order
    lying = {name: feed.pose(name) for name in others}
    pose = Scheduler(workcell, plan, feed).feed_search.planning.graph(piece).resting[rest]
    found = free_places(workcell, workcell.body(piece), pose, feed.pose(piece), lying)
    half, centre = np.array(workcell.robot.stand_size) / 2, workcell.cell.stand_centre
    obstacles = [outline(workcell, name, T) for name, T in lying.items()]
    obstacles.append(shapely.box(*(centre - half), *(centre + half)))
    names = [name for name, _ in found]
    assert len(set(names)) == len(names) > YAWS
    for _, T in found:
        np.testing.assert_allclose(T[2], pose[2], atol=1e-12)
        assert all(outline(workcell, piece, T).distance(o) >= workcell.sizes.room for o in obstacles)
    numbers = {number for number, _ in names}
    alone = free_places(workcell, workcell.body(piece), pose, feed.pose(piece), {})
    assert {number for (number, _), _ in alone} >= numbers and len(alone) > len(found)
    for name, T in alone:
        near = any(outline(workcell, piece, T).distance(o) < workcell.sizes.room for o in obstacles)
        assert (name in names) != near


def test_hands_meet_with_the_piece_in_the_middle_of_the_place(
    workcell: Workcell, plan: AssemblyPlan, program: Program
) -> None:
    """Its centre of mass is at one of few places, on the side that it comes from first; turned any way."""
    piece = plan.order[0]
    graph = Scheduler(workcell, plan, program.feed).feed_search.planning.graph(piece)
    index = int(np.flatnonzero(graph.together(0))[0])
    grasps, com = (graph.poses[0], graph.poses[index]), graph.piece.center_of_mass
    for side in (1.0, -1.0):
        poses = meeting_poses(workcell.robot, (0, 1), grasps, np.array((0.1, side * 0.25, 0.0)), com)
        places = np.round([apply(pose, com) for pose in poses], 9)
        assert len({tuple(place) for place in places.tolist()}) == 8
        assert (places[:, 2] > 0.2).all() and (places[:, 0] == 0.0).all()
        first = places[: len(places) // 4, 1]
        assert (np.sign(first) == side).mean() > 0.5
        shifted = translate(poses[0], -places[0]) @ inverse(translate(poses[0], -places[0]))
        np.testing.assert_allclose(shifted, np.eye(4), atol=1e-12)
