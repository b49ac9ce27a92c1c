"""The world's physics against the textbook: friction, grip, masses, and that nothing but fingers holds a
piece."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from soma_bullet.assembly.file import load_assembly
from soma_bullet.assembly.model import Assembly
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.bullet.quiet import pybullet as p
from soma_bullet.bullet.simulator import LOOKS_EVERY, BulletSimulator
from soma_bullet.bullet.upkeep import EVERY, STALE, STALE_POINTS
from soma_bullet.frames import (
    Array,
    apply,
    from_quat_xyzw,
    inverse,
    make_transform,
    rotation_about,
    rotation_angle,
)
from soma_bullet.robot.cell import load_cell
from soma_bullet.robot.kinematics import Robot
from soma_bullet.robot.model import Cell
from soma_bullet.world.options import Physics
from tests.blocks import SIDE, assembly, box, cells

STAND = (0.03, 0.03)
GRAVITY = 9.81  # [m/s2]
YAWS = (0.0, 30.0, 45.0, 90.0)  # [deg] of blocks against the slope
SLIDES = np.rad2deg(np.arctan(0.5))  # 26.57 deg: the steepest slope that friction 0.5 can hold
GRIP = 20.0  # [N]


@pytest.fixture(scope="module")
def cell() -> Cell:
    return load_cell("ur5e_pair")


@pytest.fixture(scope="module")
def robot(cell: Cell) -> Robot:
    return Robot(cell, STAND)


def home(cell: Cell) -> Array:
    return np.array([arm.q_home for arm in cell.arms])


@contextmanager
def running(
    cell: Cell,
    whole: Assembly,
    poses: dict[str, Array],
    physics: Physics | None = None,
    opening: float = 0.0,
    q: Array | None = None,
) -> Iterator[BulletSimulator]:
    """A world whose left hand stands open from the start."""
    qs = home(cell)
    qs[0] = qs[0] if q is None else q
    world = BulletSimulator(cell, whole, STAND, poses, qs, physics or Physics())
    try:
        for joint in world.finger_joints[0]:
            p.resetJointState(world.robots[0], joint, opening / 2, physicsClientId=world.client)
        world.open_hand(0, opening)
        yield world
    finally:
        world.close()


def run(world: BulletSimulator, seconds: float) -> None:
    for _ in range(round(seconds / world.time_step)):
        world.step()


def grip(world: BulletSimulator, force: float = GRIP) -> None:
    """Close the left hand as the executor does: gently, then harder and harder."""
    world.squeeze(0, 5.0)
    run(world, 0.25)
    for part in np.linspace(5.0, force, 72):
        world.squeeze(0, part)
        world.step()


# --- friction on a slope ------------------------------------------------------------------------------------


def slides(cell: Cell, physics: Physics, slope_deg: float, azimuth_deg: float) -> Array:
    """How far blocks at YAWS get [mm] in half a second after gravity has tilted as if the table were a
    slope."""
    blocks = [cells([(0, 0, 0), (1, 0, 0)], f"block{k}") for k in range(len(YAWS))]
    bottom = blocks[0].vertices[:, 2].min() + blocks[0].clearance
    poses = {
        block.name: make_transform(rotation_about((0, 0, 1), np.deg2rad(yaw)), (0.1 * k - 0.2, 0.25, -bottom))
        for k, (block, yaw) in enumerate(zip(blocks, YAWS, strict=True))
    }
    with running(
        cell, assembly(blocks, [(float(k), 0, 0) for k in range(len(blocks))]), poses, physics
    ) as world:
        run(world, 0.05)
        slope, azimuth = np.deg2rad([slope_deg, azimuth_deg])
        down = np.array([np.sin(slope) * np.cos(azimuth), np.sin(slope) * np.sin(azimuth), -np.cos(slope)])
        p.setGravity(*(GRAVITY * down).tolist(), physicsClientId=world.client)
        start = world.piece_poses()
        run(world, 0.5)
        end = world.piece_poses()
    return np.array([np.linalg.norm(end[b.name][:3, 3] - start[b.name][:3, 3]) for b in blocks]) * 1e3


@pytest.mark.parametrize("azimuth", [0.0, 90.0])
@pytest.mark.parametrize("solver", ["dantzig", "pgs"])
def test_a_block_stays_at_25_deg_and_slides_at_28(cell: Cell, solver: str, azimuth: float) -> None:
    physics = Physics(solver=solver)  # type: ignore[arg-type]
    slope = np.deg2rad(28.0)
    free_run = GRAVITY * (np.sin(slope) - 0.5 * np.cos(slope)) * 0.5**2 / 2 * 1e3  # [mm] by Coulomb's law
    assert slides(cell, physics, 25.0, azimuth).max() < 0.15
    np.testing.assert_allclose(slides(cell, physics, 28.0, azimuth), free_run, rtol=0.03)


@pytest.mark.parametrize("azimuth", [22.5, 45.0, 70.0])
@pytest.mark.parametrize("solver", ["dantzig", "pgs"])
def test_friction_across_the_axes_is_a_pyramid(cell: Cell, solver: str, azimuth: float) -> None:
    """A block at rest stays wherever friction 0.5 holds it, and never where 0.5 * sqrt(2) would not.

    In between the solvers differ. Bullet's friction at rest acts along two axes of the world, each with its
    own bound: down a diagonal dantzig holds a block up to about 35 deg, where a cone would let go at 26.57.
    pgs lets go at 26 to 27 deg."""
    physics = Physics(solver=solver)  # type: ignore[arg-type]
    assert slides(cell, physics, 25.0, azimuth).max() < 0.2
    assert slides(cell, physics, np.rad2deg(np.arctan(0.5 * np.sqrt(2))) + 1.5, azimuth).min() > 10.0
    if solver == "pgs":
        assert slides(cell, physics, SLIDES + 1.5, azimuth).min() > 10.0


@pytest.mark.parametrize(
    ("factor", "slope", "stays"),
    [(0.5, 13.0, True), (0.5, 16.0, False), (2.0, 43.0, True), (2.0, 47.0, False)],
)
def test_the_factor_on_friction_is_the_factor_on_friction(
    cell: Cell, factor: float, slope: float, stays: bool
) -> None:
    """tan 14.0 deg = 0.25, tan 45 deg = 1."""
    assert (slides(cell, Physics(friction=factor), slope, 0.0).max() < 0.2) == stays


@pytest.mark.parametrize(
    ("slope_deg", "seems_to_slide", "renewed"),
    [
        (5.0, "up", False),
        (5.0, "down", False),
        (28.0, "down", False),
        (28.0, "up", True),
        (28.0, "across", False),
    ],
)
def test_contacts_form_anew_where_friction_drives(
    cell: Cell, monkeypatch: pytest.MonkeyPatch, slope_deg: float, seems_to_slide: str, renewed: bool
) -> None:
    """Friction points up the slope, and is at its limit at 28 deg alone: it would drive a block that came
    from below."""
    block = cells([(0, 0, 0), (1, 0, 0)], "block")
    pose = make_transform(translation=(0.0, 0.25, -block.vertices[:, 2].min() - block.clearance))
    with running(cell, assembly([block], [(0, 0, 0)]), {"block": pose}) as world:
        slope = np.deg2rad(slope_deg)
        p.setGravity(GRAVITY * np.sin(slope), 0.0, -GRAVITY * np.cos(slope), physicsClientId=world.client)
        run(world, 0.3)
        forgotten = list[int]()
        monkeypatch.setattr(
            p, "setCollisionFilterGroupMask", lambda body, *args, **named: forgotten.append(body)
        )
        way = {"down": (1e-4, 0.0), "up": (-1e-4, 0.0), "across": (0.0, 1e-4)}[seems_to_slide]
        world.last_looked = world.places_of_pieces() - (*way, *[0.0] * 5)
        world.look()
    assert forgotten == ([world.pieces["block"]] if renewed else [])


def test_a_block_that_slides_keeps_its_contacts(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    block = cells([(0, 0, 0), (1, 0, 0)], "block")
    pose = make_transform(translation=(0.0, 0.25, -block.vertices[:, 2].min() - block.clearance))
    with running(cell, assembly([block], [(0, 0, 0)]), {"block": pose}) as world:
        p.setGravity(GRAVITY * np.sin(0.5), 0.0, -GRAVITY * np.cos(0.5), physicsClientId=world.client)
        monkeypatch.setattr(
            p, "setCollisionFilterGroupMask", lambda *args, **named: pytest.fail("formed anew")
        )
        run(world, 2.5 * LOOKS_EVERY)
        assert world.piece_poses()["block"][0, 3] > 5e-3


def test_friction_is_the_geometric_mean_of_two_bodies(cell: Cell) -> None:
    wood = [cells([(0, 0, 0)], "half"), box((SIDE,) * 3, "slippery", friction=0.125)]
    poses = {piece.name: make_transform(translation=(0.1 * k, 0.25, SIDE)) for k, piece in enumerate(wood)}
    with running(cell, assembly(wood, [(0, 0, 0), (1, 0, 0)]), poses) as world:
        found = {
            name: p.getDynamicsInfo(body, -1, physicsClientId=world.client)[1]
            for name, body in world.pieces.items()
        }
        table = p.getDynamicsInfo(world.fixtures["table"], -1, physicsClientId=world.client)[1]
        pads = [p.getDynamicsInfo(*part, physicsClientId=world.client)[1] for part in world.finger_links[0]]
    assert found["half"] * table == pytest.approx(0.5)
    assert found["slippery"] * table == pytest.approx(np.sqrt(0.125 * 0.5))
    assert [found["half"] * pad for pad in pads] == pytest.approx(
        [np.sqrt(0.5 * cell.arms[0].hand.pad_friction)] * 2
    )


# --- what rests is left alone until it is touched -----------------------------------------------------------


def knocked(cell: Cell, asleep: float) -> tuple[Array, Array]:
    """Where the centres (3, 3) of a low block, of one on top of it and of one beside them are, after a rest
    and at the end.

    The one beside, which never sleeps, is kicked: it knocks the low one out from under the other.
    """
    names = ("low", "top", "beside")
    blocks = [box((SIDE,) * 3, name) for name in names]
    whole = assembly(blocks, [(0, 0, SIDE / 2), (0, 0, SIDE * 1.5), (-4 * SIDE, 0, SIDE / 2)])
    poses = {
        b.name: make_transform(translation=(0, 0.25, 0)) @ goal
        for b, goal in zip(blocks, whole.goals, strict=True)
    }
    with running(cell, whole, poses, Physics(asleep=asleep, substeps=1)) as world:
        kicked = world.pieces["beside"]
        p.changeDynamics(
            kicked, -1, activationState=p.ACTIVATION_STATE_DISABLE_SLEEPING, physicsClientId=world.client
        )  # fmt: skip
        run(world, 3.0)
        before = world.piece_poses()
        run(world, 0.5)
        rested = world.piece_poses()
        if asleep:  # that it has not moved at all is how sleep shows
            assert all(np.array_equal(before[name], rested[name]) for name in names[:2])
        p.resetBaseVelocity(kicked, [2.0, 0, 0], [0, 0, 0], physicsClientId=world.client)
        run(world, 0.5)
        first, last = (
            np.array([poses[name][:3, 3] for name in names]) for poses in (rested, world.piece_poses())
        )
        return first, last


def test_what_sleeps_wakes_when_it_is_touched(cell: Cell) -> None:
    (rested, end), (rested_awake, end_awake) = knocked(cell, Physics().asleep), knocked(cell, 0.0)
    np.testing.assert_allclose(rested, rested_awake, atol=5e-6)
    assert end_awake[0, 0] > 1.5 * SIDE  # as far as it slides from under the one on top
    assert np.ptp(end_awake[:2, 2]) > SIDE / 2
    np.testing.assert_allclose(end, end_awake, atol=3e-3)


def test_what_a_hand_holds_does_not_sleep(cell: Cell, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor does what is stacked on it, unlike blocks on the table: alone, or on each other."""
    names = ("held", "on it", "low", "top")
    blocks = [box((SIDE, SIDE, 3 * SIDE), "held"), *(box((SIDE,) * 3, name) for name in names[1:])]
    T = robot.tcp(0, cell.arms[0].q_home)
    on_it = make_transform(translation=(0, 0, 2 * SIDE)) @ T
    table = [make_transform(translation=(0.0, 0.25, SIDE * (k + 0.5))) for k in range(2)]
    with running(
        cell,
        assembly(blocks, [(0, 0, 0)] * 4),
        dict(zip(names, [T, on_it, *table], strict=True)),
        opening=SIDE + 2e-3,
    ) as world:
        p.setGravity(0, 0, 0, physicsClientId=world.client)
        grip(world)
        p.setGravity(0, 0, -GRAVITY, physicsClientId=world.client)
        told = set[int]()
        real = p.changeDynamics
        monkeypatch.setattr(
            p, "changeDynamics", lambda body, *args, **named: (told.add(body), real(body, *args, **named))
        )
        run(world, 2.0)
        assert world.piece_poses()["on it"][2, 3] > 0.2  # still there
    assert told == {world.pieces["low"], world.pieces["top"]}


# --- a grip is friction -------------------------------------------------------------------------------------


@pytest.mark.parametrize("solver", ["dantzig", "pgs"])
@pytest.mark.parametrize("along", ["down", "out of the hand", "across the hand"])
def test_a_gripped_piece_slips_when_pulled_with_twice_mu_f(
    cell: Cell, robot: Robot, solver: str, along: str
) -> None:
    block = box((SIDE, SIDE, 3 * SIDE), "block")
    T = robot.tcp(0, cell.arms[0].q_home)
    pull = {"down": np.array([0.0, 0.0, -1.0]), "out of the hand": T[:3, 2], "across the hand": T[:3, 1]}[
        along
    ]
    mu = np.sqrt(cell.arms[0].hand.pad_friction * block.friction)
    physics = Physics(solver=solver, grip_force=GRIP)  # type: ignore[arg-type]
    with running(cell, assembly([block], [(0, 0, 0)]), {"block": T}, physics, SIDE + 2e-3) as world:
        p.setGravity(
            0, 0, 0, physicsClientId=world.client
        )  # in the hand by hand: it must not fall before the pads close
        grip(world)
        p.setGravity(0, 0, -GRAVITY, physicsClientId=world.client)
        run(world, 0.1)
        start = inverse(world.tcp_pose(0)) @ world.piece_poses()["block"]
        for force in np.arange(0.0, 3 * mu * GRIP, 0.05):
            place = world.piece_poses()["block"][:3, 3].tolist()
            body = world.pieces["block"]
            p.applyExternalForce(
                body, -1, (pull * force).tolist(), place, p.WORLD_FRAME, physicsClientId=world.client
            )
            world.step()
            now = inverse(world.tcp_pose(0)) @ world.piece_poses()["block"]
            if np.linalg.norm(now[:3, 3] - start[:3, 3]) > 5e-4:
                break
    needed = np.linalg.norm(pull * force - (0.0, 0.0, GRAVITY * block.mass))
    assert needed == pytest.approx(2 * mu * GRIP, rel=0.10)


def wrist_axes(world: BulletSimulator) -> Array:
    """Axes (3, 3) of the first hand's mount frame in the world."""
    quat_xyzw = p.getLinkState(world.robots[0], world.wrists[0], physicsClientId=world.client)[5]
    return Rotation.from_quat(quat_xyzw).as_matrix()


@pytest.mark.parametrize("along", ["closing axis", "across the hand", "out of the hand", "all at once"])
def test_the_wrist_feels_what_pulls_at_a_gripped_piece(cell: Cell, robot: Robot, along: str) -> None:
    block = box((SIDE, SIDE, 3 * SIDE), "block")
    T = robot.tcp(0, cell.arms[0].q_home)
    pull = 4.0 * {"closing axis": T[:3, 0], "across the hand": T[:3, 1], "out of the hand": T[:3, 2]}.get(
        along, T[:3, :3].sum(1) / np.sqrt(3.0)
    )
    with running(
        cell, assembly([block], [(0, 0, 0)]), {"block": T}, Physics(grip_force=GRIP), SIDE + 2e-3
    ) as world:
        p.setGravity(0, 0, 0, physicsClientId=world.client)
        grip(world)
        p.setGravity(0, 0, -GRAVITY, physicsClientId=world.client)
        run(world, 0.3)
        tare, load = world.wrench(0), world.load(0)
        for sign in (1.0, -1.0):
            for _ in range(60):
                place = world.piece_poses()["block"][:3, 3]
                body, push = world.pieces["block"], (sign * pull).tolist()
                p.applyExternalForce(
                    body, -1, push, place.tolist(), p.WORLD_FRAME, physicsClientId=world.client
                )
                world.step()
            axes, change = wrist_axes(world), world.wrench(0) - tare
            arm = place - np.array(
                p.getLinkState(world.robots[0], world.wrists[0], physicsClientId=world.client)[4]
            )
            np.testing.assert_allclose(-axes @ change[:3], sign * pull, atol=0.05)
            np.testing.assert_allclose(-axes @ change[3:], np.cross(arm, sign * pull), atol=0.02)
            centre = world.tcp_place(0)[:3]
            np.testing.assert_allclose(
                world.load(0) - load, (*sign * pull, *np.cross(place - centre, sign * pull)), atol=0.05
            )
            np.testing.assert_allclose(
                (world.load(0) - load)[3:], np.cross(place - centre, sign * pull), atol=0.02
            )
    weight = GRAVITY * (block.mass + sum(world.hand_masses[0]))
    np.testing.assert_allclose(-axes @ tare[:3], (0.0, 0.0, -weight), atol=0.05)


def test_the_wrist_feels_what_a_gripped_piece_stands_on(cell: Cell, robot: Robot) -> None:
    """Pushed onto the table, as much more as the table carries."""
    tall = box((SIDE, SIDE, 3 * SIDE), "block")
    T = make_transform(translation=(-0.1, 0.25, 1.5 * SIDE - tall.clearance))
    over = make_transform(np.diag((1.0, -1.0, -1.0)), (-0.1, 0.25, 2.0 * SIDE))
    q = robot.inverse(0, over, cell.arms[0].q_home)[0]
    with running(
        cell, assembly([tall], [(0, 0, 0)]), {"block": T}, Physics(grip_force=GRIP), SIDE + 2e-3, q
    ) as world:
        grip(world)

        def carried() -> float:
            return sum(
                force for a, b, force, _ in world.contacts() if (world.fixtures["table"], -1) in (a, b)
            )

        tare, before = world.wrench(0), carried()
        pressed = q - np.linalg.pinv(robot.jacobian(0, q)) @ (0.0, 0.0, 2e-4, 0.0, 0.0, 0.0)
        for k in range(240):
            world.command_arm(0, q + (pressed - q) * min(1.0, k / 200))
            world.step()
        more = carried() - before
        felt = -wrist_axes(world) @ (world.wrench(0) - tare)[:3]
    assert more > 1.0
    assert felt[2] == pytest.approx(more, abs=0.1)


def test_what_is_pinched_and_pushed_aside_stays(cell: Cell, robot: Robot) -> None:
    """Between the table and what a hand presses on it with some 2 N and pushes 0.3 mm aside, one corner at
    its limit."""
    lower, upper = box((SIDE, SIDE, 2 * SIDE), "lower"), box((SIDE, SIDE, 3 * SIDE), "upper")
    heights = {"lower": SIDE - lower.clearance, "upper": 3.5 * SIDE - 3 * lower.clearance}
    poses = {name: make_transform(translation=(-0.1, 0.25, height)) for name, height in heights.items()}
    over = make_transform(np.diag((1.0, -1.0, -1.0)), (-0.1, 0.25, 4.2 * SIDE))
    q = robot.inverse(0, over, cell.arms[0].q_home)[0]
    with running(
        cell, assembly([lower, upper], [(0, 0, 0), (0, 0, 2.5)]), poses, None, SIDE + 2e-3, q
    ) as world:
        grip(world)
        offsets = np.array(((0.0, 0.0, -1e-4), (3e-4, 0.0, -1e-4), (3e-4, 0.0, -5e-5)))
        way = np.linalg.pinv(robot.jacobian(0, q))[:, :3] @ offsets.T
        for start, end in ((np.zeros(6), way[:, 0]), (way[:, 0], way[:, 1]), (way[:, 1], way[:, 2])):
            for k in range(1, 97):
                world.command_arm(0, q + start + (end - start) * k / 96)
                world.step()
        run(world, 0.3)
        before = world.piece_poses()["lower"]
        run(world, 2.0)
        after = world.piece_poses()["lower"]
        pressed = sum(
            force for a, b, force, _ in world.contacts() if {a[0], b[0]} == set(world.pieces.values())
        )
    assert pressed > 1.5
    assert np.linalg.norm(after[:3, 3] - before[:3, 3]) < 5e-6
    assert rotation_angle(before[:3, :3], after[:3, :3]) < np.deg2rad(1e-3)


def test_a_gripped_piece_that_is_not_pulled_stays(cell: Cell, robot: Robot) -> None:
    block = box((SIDE, SIDE, 3 * SIDE), "block")
    T = robot.tcp(0, cell.arms[0].q_home)
    with running(
        cell, assembly([block], [(0, 0, 0)]), {"block": T}, Physics(grip_force=GRIP), SIDE + 2e-3
    ) as world:
        p.setGravity(0, 0, 0, physicsClientId=world.client)
        grip(world)
        p.setGravity(0, 0, -GRAVITY, physicsClientId=world.client)
        start = world.piece_poses()["block"]
        run(world, 2.0)
        end = world.piece_poses()["block"]
    assert np.linalg.norm(end[:3, 3] - start[:3, 3]) < 2e-5
    assert np.rad2deg(rotation_angle(start[:3, :3], end[:3, :3])) < 0.02


def test_a_strong_grip_converges_too(cell: Cell, robot: Robot) -> None:
    """The solver must reach the limit of the motors of the fingers within its iterations, however strong the
    hand."""
    block = box((SIDE, SIDE, 3 * SIDE), "block")
    T = robot.tcp(0, cell.arms[0].q_home)
    physics = Physics(grip_force=80.0)
    with running(cell, assembly([block], [(0, 0, 0)]), {"block": T}, physics, SIDE + 2e-3) as world:
        p.setGravity(0, 0, 0, physicsClientId=world.client)
        grip(world, 80.0)
        p.setGravity(0, 0, -GRAVITY, physicsClientId=world.client)
        start = world.piece_poses()["block"]
        run(world, 1.0)
        end = world.piece_poses()["block"]
        forces = [force for a, b, force, _ in world.contacts() if {a, b} & set(world.finger_links[0])]
    assert np.linalg.norm(end[:3, 3] - start[:3, 3]) < 2e-5
    np.testing.assert_allclose(forces, 80.0, rtol=0.02)


@pytest.mark.parametrize("solver", ["dantzig", "pgs"])
def test_arms_touch_each_other_and_themselves(cell: Cell, solver: str) -> None:
    """Arms that reach for the same place meet; one that folds its elbow meets itself; neighbours in an arm
    never do."""
    qs = np.deg2rad([[0.0, -60.0, 60.0, -90.0, -90.0, 0.0]] * 2)
    with running(
        cell,
        assembly([box((SIDE,) * 3, "block")], [(0, 0, 0)]),
        {"block": make_transform(translation=(0, 0.3, 0.1))},
        Physics(solver=solver),
    ) as world:  # type: ignore[arg-type]
        names = world.part_names()

        def touching(q: Array) -> set[frozenset[str]]:
            for arm, angles in enumerate(q):
                for joint, angle in zip(world.arm_joints[arm], angles, strict=True):
                    p.resetJointState(world.robots[arm], joint, float(angle), physicsClientId=world.client)
            p.performCollisionDetection(physicsClientId=world.client)
            return {
                frozenset((names[a], names[b])) for a, b, _, distance in world.contacts() if distance < 0.0
            }

        of = lambda pair: {name.split("_")[0] for name in pair}  # noqa: E731
        assert not [pair for pair in touching(home(cell)) if of(pair) & {"left", "right"}]
        assert [pair for pair in touching(qs) if of(pair) == {"left", "right"}]
        folded = home(cell)
        folded[0] = np.deg2rad([32.0, -90.0, 165.0, 0.0, -90.0, 0.0])
        assert [pair for pair in touching(folded) if of(pair) == {"left"}]


@pytest.mark.parametrize(("loaded", "holds"), [(0.01, True), (0.1, True), (1.15, False)])
def test_renewing_the_contacts_in_flight_lets_nothing_slide(
    cell: Cell, robot: Robot, loaded: float, holds: bool
) -> None:
    """A transfer renews the pads' contacts in turn: a tenth of what the grip could carry hardly moves, the
    fingers not."""
    block = box((SIDE, SIDE, 3 * SIDE), "block")
    T = robot.tcp(0, cell.arms[0].q_home)
    mu = np.sqrt(cell.arms[0].hand.pad_friction * block.friction)
    physics = Physics(grip_force=GRIP, mass=float(loaded * 2 * mu * GRIP / (GRAVITY * block.mass)))
    with running(cell, assembly([block], [(0, 0, 0)]), {"block": T}, physics, SIDE + 2e-3) as world:
        p.setGravity(0, 0, 0, physicsClientId=world.client)
        grip(world)
        p.setGravity(0, 0, -GRAVITY, physicsClientId=world.client)
        run(world, 0.05)
        start, opening = inverse(world.tcp_pose(0)) @ world.piece_poses()["block"], world.openings()[0]
        widths = []
        for k in range(240):
            if k % 50 in (0, 5):
                world.renew_contacts(0, k % 50 // 5)
            world.step()
            widths.append(world.openings()[0])
        moved = inverse(inverse(world.tcp_pose(0)) @ world.piece_poses()["block"]) @ start
    if holds:
        assert np.linalg.norm(moved[:3, 3]) < 2e-4
        assert np.abs(np.array(widths) - opening).max() < 5e-5  # the fingers do not jump
    else:
        assert np.linalg.norm(moved[:3, 3]) > 5e-3


def test_contacts_point_along_the_closing_axis_after_the_hand_has_turned(cell: Cell, robot: Robot) -> None:
    """Bullet keeps anchored contacts with their normals in world axes: after a turn they must have been
    renewed."""
    block = box((SIDE, SIDE, 3 * SIDE), "block")
    T = robot.tcp(0, cell.arms[0].q_home)
    with running(
        cell, assembly([block], [(0, 0, 0)]), {"block": T}, Physics(grip_force=GRIP), SIDE + 2e-3
    ) as world:
        p.setGravity(0, 0, 0, physicsClientId=world.client)
        grip(world)

        def alignment() -> float:
            rows = p.getContactPoints(world.robots[0], world.pieces["block"], physicsClientId=world.client)
            return min(abs(float(np.dot(row[7], world.tcp_pose(0)[:3, 0]))) for row in rows)

        q = np.array(cell.arms[0].q_home)
        for _ in range(240):
            q[5] += np.deg2rad(90) / 240
            world.command_arm(0, q)
            world.step()
        stale = alignment()
        for finger in (0, 1):
            world.renew_contacts(0, finger)
        world.step()
        assert stale < 0.95  # what the renewal is for
        assert alignment() > 0.999


def test_a_round_piece_tilts_less_where_its_contacts_are_renewed_more_often(cell: Cell, robot: Robot) -> None:
    """Each pad presses on a point or two of a cylinder, until it has rolled onto others."""
    mesh = trimesh.creation.cylinder(0.008, 0.05, sections=48)
    peg = Workpiece("peg", np.array(mesh.vertices), np.array(mesh.faces))
    across = make_transform(rotation_about((1, 0, 0), np.pi / 2))

    def tilts(every: float) -> float:
        """[deg] in a hand that turns by 120 deg in a second."""
        T = robot.tcp(0, cell.arms[0].q_home) @ across
        with running(
            cell, assembly([peg], [(0, 0, 0)]), {"peg": T}, Physics(grip_force=GRIP), 18e-3
        ) as world:
            assert not world.touches_flat("peg")
            p.setGravity(0, 0, 0, physicsClientId=world.client)
            grip(world)
            p.setGravity(0, 0, -GRAVITY, physicsClientId=world.client)
            run(world, 0.1)
            start, anchored, stale = (
                inverse(world.tcp_pose(0)) @ world.piece_poses()["peg"],
                world.tcp_pose(0),
                list[int](),
            )
            q = np.array(cell.arms[0].q_home)
            for k in range(480):
                q[5] += np.deg2rad(120) / 480
                world.command_arm(0, q)
                world.step()
                if k % EVERY == 0:
                    here = world.tcp_pose(0)
                    if not stale and rotation_angle(anchored[:3, :3], here[:3, :3]) > every:
                        stale, anchored = [0, 1], here
                    if stale:
                        world.renew_contacts(0, stale.pop())
            end = inverse(world.tcp_pose(0)) @ world.piece_poses()["peg"]
        return float(np.rad2deg(rotation_angle(start[:3, :3], end[:3, :3])))

    assert tilts(STALE_POINTS) < min(0.3, tilts(STALE))


def test_the_only_constraints_are_the_gears_of_the_fingers(cell: Cell, robot: Robot) -> None:
    block = box((SIDE,) * 3, "block")
    expected = [f"gear: {first} - {second}" for first, second in (arm.finger_joints for arm in cell.arms)]
    with running(
        cell, assembly([block], [(0, 0, 0)]), {"block": robot.tcp(0, cell.arms[0].q_home)}, opening=SIDE
    ) as world:
        assert sorted(world.constraints()) == sorted(expected)
        grip(world)
        assert sorted(world.constraints()) == sorted(expected)


def test_a_piece_released_gently_stays(cell: Cell, robot: Robot) -> None:
    """Gripped and let go where it stands: less than 0.1 mm, though the hand need not be centred on it."""
    block = box((SIDE, SIDE, 3 * SIDE), "block")
    stands = make_transform(translation=(-0.1, 0.25, 1.5 * SIDE - block.clearance))
    down = np.diag([1.0, -1.0, -1.0])
    (q, *_) = robot.inverse(0, make_transform(down, (-0.1, 0.25, 2 * SIDE)), cell.arms[0].q_home)
    with running(cell, assembly([block], [(0, 0, 0)]), {"block": stands}, opening=SIDE + 5e-3, q=q) as world:
        run(world, 0.1)
        start = world.piece_poses()["block"]
        grip(world)
        for force in np.linspace(GRIP, 0.5, 72):
            world.squeeze(0, force)
            world.step()
        world.open_hand(0, SIDE + 8e-3, 0.01)
        run(world, 0.05)
        world.open_hand(0, SIDE + 8e-3)
        run(world, 1.0)
        end, touching = world.piece_poses()["block"], world.contacts()
    assert np.linalg.norm(end[:3, 3] - start[:3, 3]) < 1e-4
    assert np.rad2deg(rotation_angle(start[:3, :3], end[:3, :3])) < 0.1
    assert not [
        row for row in touching if (world.pieces["block"], -1) in row[:2] and row[0][0] in world.robots
    ]


# --- masses, determinism ------------------------------------------------------------------------------------


def skewed() -> Workpiece:
    """A body whose inertia has all products: an L in three dimensions."""
    return cells([(0, 0, 0), (1, 0, 0), (2, 0, 0), (2, 1, 0), (2, 1, 1)], "skewed")


@pytest.mark.parametrize("factor", [1.0, 1.7])
def test_masses_and_inertia_are_the_workpieces(cell: Cell, factor: float) -> None:
    pieces = [*load_assembly("soma3").pieces, skewed(), box((0.02, 0.03, 0.05), "heavy", density=7800.0)]
    assert any(np.abs(piece.inertia[np.triu_indices(3, 1)]).min() > 1e-8 for piece in pieces)
    poses = {
        piece.name: make_transform(rotation_about((0, 0, 1), 0.4), (0.1 * k, 0.25, 0.3))
        for k, piece in enumerate(pieces)
    }
    whole = assembly(pieces, [(float(k), 0, 0) for k in range(len(pieces))])
    with running(cell, whole, poses, Physics(mass=factor)) as world:
        placed = world.piece_poses()
        for piece in pieces:
            info = p.getDynamicsInfo(world.pieces[piece.name], -1, physicsClientId=world.client)
            axes = np.array(p.getMatrixFromQuaternion(info[4])).reshape(3, 3)
            assert info[0] == pytest.approx(factor * piece.mass)
            np.testing.assert_allclose(info[3], piece.center_of_mass, atol=1e-9)
            inertia = axes @ np.diag(info[2]) @ axes.T
            np.testing.assert_allclose(
                inertia, factor * piece.inertia, atol=1e-6 * np.abs(piece.inertia).max()
            )
            np.testing.assert_allclose(placed[piece.name], poses[piece.name], atol=1e-7)


def test_collision_shapes_are_the_real_body(cell: Cell) -> None:
    """The boxes of each piece in Bullet span the nominal mesh less the clearance."""
    whole = load_assembly("soma3")
    poses = {
        piece.name: make_transform(translation=(0.1 * k, 0.25, 0.3)) for k, piece in enumerate(whole.pieces)
    }
    unit = np.array(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5])).reshape(3, 8).T
    with running(cell, whole, poses) as world:
        for piece in whole.pieces:
            body = world.pieces[piece.name]
            T_piece_inertial = inverse(world.T_inertial_piece[piece.name])
            corners = []
            for shape in p.getCollisionShapeData(body, -1, physicsClientId=world.client):
                assert shape[2] == p.GEOM_BOX
                T_piece_shape = T_piece_inertial @ from_quat_xyzw(shape[5], shape[6])
                corners.append(apply(T_piece_shape, unit * shape[3]))
            found = np.vstack(corners)
            np.testing.assert_allclose(
                found.min(axis=0), piece.vertices.min(axis=0) + piece.clearance, atol=1e-7
            )
            np.testing.assert_allclose(
                found.max(axis=0), piece.vertices.max(axis=0) - piece.clearance, atol=1e-7
            )


def test_a_piece_rests_where_its_real_body_touches(cell: Cell) -> None:
    block = box((SIDE,) * 3, "block", clearance=5e-4)
    poses = {"block": make_transform(translation=(0.0, 0.25, SIDE / 2))}
    with running(cell, assembly([block], [(0, 0, 0)]), poses) as world:
        run(world, 0.5)
        height = world.piece_poses()["block"][2, 3]
    assert height == pytest.approx(
        SIDE / 2 - 5e-4, abs=2e-5
    )  # Bullet lets resting bodies overlap by about 0.01 mm


@pytest.mark.parametrize("solver", ["dantzig", "pgs"])
def test_the_same_commands_twice_give_the_same_bits(cell: Cell, robot: Robot, solver: str) -> None:
    block = box((SIDE, SIDE, 3 * SIDE), "block")
    T = robot.tcp(0, cell.arms[0].q_home)

    def episode() -> list[bytes]:
        found = []
        physics = Physics(solver=solver)  # type: ignore[arg-type]
        with running(cell, assembly([block], [(0, 0, 0)]), {"block": T}, physics, SIDE + 2e-3) as world:
            world.squeeze(0, GRIP)
            for k in range(200):
                world.command_arm(0, cell.arms[0].q_home + 1e-3 * np.sin(0.05 * k))
                world.step()
                found.append(
                    world.piece_poses()["block"].tobytes()
                    + world.all_joints().tobytes()
                    + world.wrench(0).tobytes()
                )
        return found

    assert episode() == episode()
