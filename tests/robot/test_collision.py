"""Collision scenes against all pairs, against hand-made cases, and against PyBullet."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest
from blocks import box

from soma_bullet.assembly.file import load_assembly
from soma_bullet.frames import Array, inverse, make_transform, rotation_about, to_quat_xyzw
from soma_bullet.robot.cell import load_cell
from soma_bullet.robot.collision import HAND_MARGIN, NEAR_MARGIN, CollisionModel, Scene, Situation, _swept
from soma_bullet.robot.compose import compose_urdf
from soma_bullet.robot.kinematics import Robot

STAND = (0.05, 0.05)
DOWN = np.diag((1.0, -1.0, -1.0, 1.0))
BOTH = frozenset({0, 1})


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot(load_cell("ur5e_pair"), STAND)


@pytest.fixture(scope="module")
def model(robot: Robot) -> CollisionModel:
    return CollisionModel(robot, {piece.name: piece.body_parts for piece in load_assembly("soma3").pieces})


@pytest.fixture(scope="module")
def blocks(robot: Robot) -> CollisionModel:
    """Two cubes of 30 mm."""
    return CollisionModel(robot, {name: box((0.03,) * 3).parts for name in ("one", "two")})


def lying() -> dict[str, Array]:
    """The three pieces somewhere on the table."""
    places = {
        "BigL": (0.3, (-0.2, 0.2, 0.08)),
        "smallL": (1.0, (0.2, 0.25, 0.08)),
        "Z": (2.0, (0.1, -0.25, 0.08)),
    }
    return {
        name: make_transform(rotation_about((0, 0, 1), turn), place) for name, (turn, place) in places.items()
    }


def states(robot: Robot, count: int, seed: int) -> Iterator[Array]:
    """Half anywhere within the limits, half about home, where more is free."""
    rng = np.random.default_rng(seed)
    lower, upper = (np.array([getattr(arm, side) for arm in robot.cell.arms]) for side in ("lower", "upper"))
    for k in range(count):
        qs = (
            rng.uniform(lower, upper)
            if k % 2
            else np.array(robot.home) + rng.uniform(-0.8, 0.8, np.shape(robot.home))
        )
        yield robot.configuration(qs, rng.uniform(0.0, 0.08, 2))


def at(robot: Robot, arm: int, T: Array, opening: float) -> Array:
    """A configuration with one arm's TCP at T (4, 4) and the other at home, that is free of the arm
    itself."""
    found = robot.inverse(arm, T, robot.home[arm])
    assert len(found)
    qs = np.array(robot.home)
    qs[arm] = found[0]
    openings = np.zeros(2)
    openings[arm] = opening
    return robot.configuration(qs, openings)


def above(height: float, x: float = 0.0, y: float = 0.25) -> Array:
    T = DOWN.copy()
    T[:3, 3] = (x, y, height)
    return T


def test_broad_phase_equals_all_pairs(robot: Robot, model: CollisionModel) -> None:
    poses = lying()
    carried = (0, make_transform(None, (0, 0, 0.01)))
    scenes = [
        model.scene(Situation(poses, BOTH)),
        model.scene(
            Situation({n: T for n, T in poses.items() if n != "Z"}, frozenset({0}), {"Z": carried}, {"Z": 0})
        ),
    ]
    for scene in scenes:
        hits = 0
        for q in states(robot, 500, 0):
            expected = bool(scene.colliding(q))
            assert scene.collides(q) == expected
            hits += expected
        assert 50 < hits < 450


def test_colliding_names_the_pairs_that_are_too_near(robot: Robot, model: CollisionModel) -> None:
    scene = model.scene(Situation(lying(), BOTH))
    for q in states(robot, 60, 1):
        pairs = scene.colliding(q)
        assert bool(pairs) == scene.collides(q)
        assert not pairs or scene.met in {(a, b) for a, b, _ in pairs}
        assert [d for *_, d in pairs] == sorted(d for *_, d in pairs)


def test_home_is_free_and_through_the_table_is_not(robot: Robot, model: CollisionModel) -> None:
    scene = model.scene(Situation({}, BOTH))
    assert not scene.collides(robot.configuration(robot.home, robot.closed))
    q = at(robot, 0, above(-0.01), 0.0)
    named = {frozenset(pair[:2]) for pair in scene.colliding(q)}
    assert frozenset({"left_finger_left", "table"}) in named


@pytest.mark.parametrize(("other", "margin"), [("table", HAND_MARGIN), ("one", NEAR_MARGIN)])
def test_margins(robot: Robot, blocks: CollisionModel, other: str, margin: float) -> None:
    """A closed hand comes down on the table, and on a cube."""
    top = 0.0 if other == "table" else 0.03
    poses = {} if other == "table" else {"one": make_transform(None, (0, 0.25, 0.015))}
    scene = blocks.scene(Situation(poses, frozenset({0})))
    tip = robot.arm(0).hand.pad_size[1] / 2  # of the fingers below the TCP
    for gap, hit in ((margin - 1e-4, True), (margin + 1e-4, False)):
        q = at(robot, 0, above(top + tip + gap), 0.0)
        assert scene.collides(q) == hit, scene.colliding(q)
        assert any(other in pair[:2] for pair in scene.colliding(q)) == hit


def test_what_is_meant_to_touch_may(robot: Robot, blocks: CollisionModel) -> None:
    """A carried cube on another: forbidden within the margin unless the contact is meant; never deep."""
    lower = make_transform(None, (0, 0.25, 0.015))
    gripped, pair = {"two": 0}, frozenset({frozenset({"one", "two"})})
    for depth, meant, hit in (
        (0.0, False, True),
        (0.0, True, False),
        (2e-4, True, True),
        (-1e-3, False, False),
    ):
        T = above(0.045 - depth)
        T_tcp_piece = inverse(T) @ make_transform(None, (0, 0.25, 0.045 - depth))
        touching = pair if meant else frozenset()
        scene = blocks.scene(
            Situation({"one": lower}, frozenset({0}), {"two": (0, T_tcp_piece)}, gripped, touching)
        )
        q = at(robot, 0, T, 0.03)
        assert scene.collides(q) == hit, (depth, meant, scene.colliding(q))


def test_a_carried_piece_is_checked(robot: Robot, blocks: CollisionModel) -> None:
    """The hand alone is free where the cube that it carries would be in the table, or in the other cube."""
    T = above(0.10)
    q = at(robot, 0, T, 0.03)
    hanging = inverse(T) @ make_transform(None, (0, 0.25, 0.01))
    free = Situation({}, frozenset({0}))
    assert not blocks.scene(free).collides(q)
    carrying = replace(free, carried={"one": (0, hanging)}, gripped={"one": 0})
    assert {frozenset(p[:2]) for p in blocks.scene(carrying).colliding(q)} == {frozenset({"one", "table"})}
    scene = blocks.scene(replace(carrying, poses={"two": make_transform(None, (0.02, 0.25, 0.03))}))
    assert {frozenset(p[:2]) for p in scene.colliding(q)} == {
        frozenset({"one", "table"}),
        frozenset({"one", "two"}),
    }
    # the same scene serves another grasp
    scene.attach("one", 0, inverse(T) @ make_transform(None, (0, 0.25, 0.09)))
    assert not scene.collides(q) and not scene.colliding(q)
    # what nobody grips is hit by the fingers
    higher = (0, inverse(T) @ make_transform(None, (0, 0.25, 0.09)))
    loose = blocks.scene(replace(carrying, gripped={}, carried={"one": higher}))
    assert any("finger" in a + b for a, b, _ in loose.colliding(at(robot, 0, T, 0.02)))


def test_only_what_moves_is_checked(robot: Robot, blocks: CollisionModel) -> None:
    """Two cubes in each other, and an arm at rest in a cube, are no concern of the arm that moves."""
    inside = {name: make_transform(None, (0, 0.25, 0.015)) for name in ("one", "two")}
    q = at(robot, 1, above(0.02), 0.0)
    assert not blocks.scene(Situation(inside, frozenset({0}))).collides(q)
    assert blocks.scene(Situation(inside, frozenset({1}))).collides(q)


def test_an_absent_arm_is_left_out(robot: Robot, blocks: CollisionModel) -> None:
    qs = np.array([robot.inverse(arm, above(0.2, x=0.0, y=0.0), robot.home[arm])[0] for arm in (0, 1)])
    q = robot.configuration(qs, robot.closed)
    situation = Situation({}, frozenset({0}))
    assert blocks.scene(situation).collides(q)
    assert not blocks.scene(replace(situation, absent=frozenset({1}))).collides(q)


# --- PyBullet as the judge ----------------------------------------------------------------------------------


def test_swept_fingers_stand_for_all_widths(robot: Robot, blocks: CollisionModel) -> None:
    """A block beside the hand, between its fingers, or away: the swept fingers hit it if they do at some
    width."""
    rng, seen = np.random.default_rng(4), {True: 0, False: 0}
    configuration = at(robot, 0, above(0.2), 0.01)
    hand = robot.tcp(0, configuration[robot.arm_slots(0)])
    for _ in range(120):
        turn = rotation_about(rng.normal(size=3), rng.uniform(0, 3))
        place = make_transform(turn, rng.uniform((-0.12, -0.05, -0.02), (0.12, 0.05, 0.06)))
        scene = blocks.scene(Situation({"one": hand @ place}, frozenset({0})))
        hits = [scene.collides(at(robot, 0, above(0.2), width)) for width in np.linspace(0.01, 0.08, 36)]
        assert scene.swept(0, 0.035).collides(configuration) == any(hits)
        assert scene.swept(0, 0.0).collides(configuration) == hits[0] == scene.collides(configuration)
        seen[any(hits) and not hits[0]] += 1
    assert min(seen.values()) >= 5, seen


def test_what_a_turned_box_sweeps() -> None:
    """Every corner of it at both ends, and not a larger volume than it must have."""
    half, offset = np.array([0.01, 0.02, 0.03]), np.array([0.02, -0.05, 0.01])
    place = pin.SE3(rotation_about((1, 2, 3), 0.7), np.array([0.1, 0.2, 0.3]))
    corners = half * (2 * np.indices((2, 2, 2)).reshape(3, -1).T - 1.0)
    world = np.array([place.act(corner) for corner in corners])
    along = place.rotation.T @ offset
    for shape in (coal.Box(*(2 * half)), _hull(corners)):
        swept, where = _swept(shape, place, offset)
        found = np.array([where.act(point) for point in np.array(swept.points())])
        ends = np.vstack([world, world + offset])
        for direction in np.random.default_rng(0).normal(size=(50, 3)):
            assert (found @ direction).max() == pytest.approx((ends @ direction).max(), abs=1e-9)
        faces = 4 * np.array([half[1] * half[2], half[2] * half[0], half[0] * half[1]])
        assert swept.computeVolume() == pytest.approx(8 * half.prod() + faces @ np.abs(along), rel=1e-6)
    straight, where = _swept(coal.Box(*(2 * half)), place, place.rotation @ (0.0, 0.04, 0.0))
    assert isinstance(straight, coal.Box)
    np.testing.assert_allclose(straight.halfSide, half + (0, 0.02, 0), atol=1e-12)
    np.testing.assert_allclose(where.translation, place.act(np.array((0, 0.02, 0))), atol=1e-12)


def _hull(points: Array) -> coal.CollisionGeometry:
    listed = coal.StdVec_Vec3s()
    for point in points:
        listed.append(point)
    return coal.Convex.convexHull(listed, True, "Qt")


@pytest.fixture(scope="module")
def bullet(robot: Robot, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[int, int]]:
    import pybullet

    urdf = compose_urdf(robot.cell, STAND, tmp_path_factory.mktemp("cell") / "cell.urdf", visuals=False)
    saved, null = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)  # PyBullet's warnings bypass sys.stdout
    client = pybullet.connect(pybullet.DIRECT)
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE | pybullet.URDF_USE_SELF_COLLISION
    body = pybullet.loadURDF(str(Path(urdf)), useFixedBase=True, flags=flags, physicsClientId=client)
    os.dup2(saved, 1)
    os.close(saved), os.close(null)
    yield client, body
    pybullet.disconnect(client)


def test_what_is_free_here_is_not_hit_in_pybullet(
    robot: Robot, model: CollisionModel, bullet: tuple[int, int]
) -> None:
    import pybullet

    client, body = bullet
    poses = lying()
    soma3 = load_assembly("soma3")
    for name, pose in poses.items():
        for part in soma3.pieces[soma3.index(name)].body_parts:
            assert part.box is not None
            centre, axes, half = part.box
            place = pose @ make_transform((axes * np.sign(np.linalg.det(axes))).T, centre)
            shape = pybullet.createCollisionShape(
                pybullet.GEOM_BOX, halfExtents=half.tolist(), physicsClientId=client
            )
            quat_xyzw = _quat_xyzw(place)
            pybullet.createMultiBody(0.0, shape, -1, place[:3, 3].tolist(), quat_xyzw, physicsClientId=client)
    count = pybullet.getNumJoints(body, physicsClientId=client)
    infos = [pybullet.getJointInfo(body, i, physicsClientId=client) for i in range(count)]
    links = {i[0]: i[12].decode() for i in infos} | {-1: "world"}
    joints = {i[1].decode(): i[0] for i in infos}
    scene = model.scene(Situation(poses, BOTH))
    checked = _checked_links(scene)
    free = 0
    for q in states(robot, 300, 2):
        if scene.collides(q):
            continue
        free += 1
        for name, index in joints.items():
            if robot.model.existJointName(name):
                value = q[robot.model.joints[robot.model.getJointId(name)].idx_q]
                pybullet.resetJointState(body, index, value, physicsClientId=client)
        pybullet.performCollisionDetection(physicsClientId=client)
        for contact in pybullet.getContactPoints(physicsClientId=client):
            sides = zip(contact[1:3], contact[3:5], strict=True)
            names = frozenset(links[link] if which == body else "piece" for which, link in sides)
            assert contact[8] > 0 or names not in checked, (names, contact[8])
    assert free > 80


def _checked_links(scene: Scene) -> set[frozenset[str]]:
    bodies, pieces = scene.collision_model.bodies, set(scene.collision_model.piece_shapes)
    names = ["piece" if body in pieces else body for body in bodies]
    return {frozenset((names[pair.first], names[pair.second])) for pair in scene.geometry.collisionPairs}


def _quat_xyzw(T: Array) -> list[float]:
    return to_quat_xyzw(T)[1].tolist()
