"""The cell: one URDF that planner and simulator read alike, composed from a description alone."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from soma_bullet.errors import InputError
from soma_bullet.robot.cell import load_cell
from soma_bullet.robot.compose import compose_urdf
from soma_bullet.robot.model import Cell

ROOT = Path(__file__).resolve().parents[2]
CELLS = sorted(path.parent.name for path in ROOT.glob("robots/*/cell.toml"))
STAND = (0.055, 0.030)


@pytest.fixture(scope="module", params=CELLS)
def cell(request: pytest.FixtureRequest) -> Cell:
    return load_cell(request.param)


@pytest.fixture(scope="module")
def urdf(cell: Cell, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compose_urdf(cell, STAND, tmp_path_factory.mktemp("cell") / "cell.urdf")


@pytest.fixture(scope="module")
def bullet(urdf: Path):
    """(client, body, joint index by name, link index by name); the planner's flags."""
    import pybullet

    saved, null = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)  # PyBullet's warnings bypass sys.stdout
    client = pybullet.connect(pybullet.DIRECT)
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE | pybullet.URDF_USE_SELF_COLLISION
    body = pybullet.loadURDF(str(urdf), useFixedBase=True, flags=flags, physicsClientId=client)
    os.dup2(saved, 1)
    os.close(saved), os.close(null)
    count = pybullet.getNumJoints(body, physicsClientId=client)
    infos = [pybullet.getJointInfo(body, i, physicsClientId=client) for i in range(count)]
    yield client, body, {i[1].decode(): i[0] for i in infos}, {i[12].decode(): i[0] for i in infos}
    pybullet.disconnect(client)


def sample(cell: Cell, seed: int) -> dict[str, float]:
    """Random joint values in the limits, fingers included; home for seed 0."""
    rng = np.random.default_rng(seed)
    q: dict[str, float] = {}
    for arm in cell.arms:
        values = arm.q_home if seed == 0 else rng.uniform(arm.lower, arm.upper)
        q |= dict(zip(arm.joint_names, values, strict=True))
        q |= {
            joint: 0.0 if seed == 0 else rng.uniform(0, arm.hand.opening / 2) for joint in arm.finger_joints
        }
    return q


def pin_model(urdf: Path):
    import pinocchio as pin

    model = pin.buildModelFromUrdf(str(urdf))
    return pin, model, model.createData()


def pin_q(model, values: dict[str, float]) -> np.ndarray:
    q = np.zeros(model.nq)
    for name, value in values.items():
        q[model.joints[model.getJointId(name)].idx_q] = value
    return q


@pytest.mark.parametrize("seed", range(4))
def test_forward_kinematics_agree(cell: Cell, urdf: Path, bullet, seed: int) -> None:
    import pybullet
    import yourdfpy

    client, body, joints, links = bullet
    values = sample(cell, seed)
    pin, model, data = pin_model(urdf)
    pin.framesForwardKinematics(model, data, pin_q(model, values))
    tree = yourdfpy.URDF.load(str(urdf), load_meshes=False)
    tree.update_cfg(values)
    for name, value in values.items():
        pybullet.resetJointState(body, joints[name], value, physicsClientId=client)
    for arm in cell.arms:
        for link in (arm.tcp_link, arm.tool_link, *arm.finger_links):
            T_pin = data.oMf[model.getFrameId(link)].homogeneous
            np.testing.assert_allclose(tree.get_transform(link, "world"), T_pin, atol=1e-6)
            state = pybullet.getLinkState(
                body, links[link], computeForwardKinematics=1, physicsClientId=client
            )
            np.testing.assert_allclose(state[4], T_pin[:3, 3], atol=1e-6)
            rotation = np.reshape(pybullet.getMatrixFromQuaternion(state[5]), (3, 3))
            np.testing.assert_allclose(rotation, T_pin[:3, :3], atol=1e-6)


def test_the_hand_sits_on_the_tool(cell: Cell, urdf: Path) -> None:
    pin, model, data = pin_model(urdf)
    pin.framesForwardKinematics(model, data, pin_q(model, sample(cell, 1)))
    for arm in cell.arms:
        T_tool_tcp = data.oMf[model.getFrameId(arm.tool_link)].actInv(
            data.oMf[model.getFrameId(arm.tcp_link)]
        )
        np.testing.assert_allclose(T_tool_tcp.homogeneous, arm.hand.T_mount_tcp, atol=1e-9)


def test_home_points_the_hands_down_and_leaves_the_centre(cell: Cell, urdf: Path) -> None:
    pin, model, data = pin_model(urdf)
    pin.framesForwardKinematics(model, data, pin_q(model, sample(cell, 0)))
    for arm in cell.arms:
        T = data.oMf[model.getFrameId(arm.tcp_link)].homogeneous
        np.testing.assert_allclose(T[:3, 2], (0, 0, -1), atol=1e-6)
        assert np.linalg.norm(T[:2, 3] - cell.stand_centre) > 0.25 and T[2, 3] > cell.stand_height + 0.1


def add_wanted_pairs(cell: Cell, pin, model, geometry) -> None:
    """All pairs but joint neighbours and those that the cell excludes."""
    geometry.addAllCollisionPairs()
    never = {frozenset(pair) for pair in cell.never_checked}
    for first, second in [(pair.first, pair.second) for pair in geometry.collisionPairs]:
        a, b = geometry.geometryObjects[first], geometry.geometryObjects[second]
        links = frozenset(model.frames[o.parentFrame].name for o in (a, b))
        i, j = a.parentJoint, b.parentJoint
        neighbours = i == j or i == model.parents[j] or j == model.parents[i]
        # The world is no neighbour: a shoulder hangs from it, but may not touch table, stand or the other
        # arm's base.
        arms = {link.split("_")[0] for link in links}
        if links in never or (neighbours and (i == j or 0 not in (i, j) or len(arms) == 1)):
            geometry.removeCollisionPair(pin.CollisionPair(first, second))


def test_home_is_free_of_collision(cell: Cell, urdf: Path) -> None:
    pin, model, data = pin_model(urdf)
    geometry = pin.buildGeomFromUrdf(model, str(urdf), pin.GeometryType.COLLISION)
    for shape in geometry.geometryObjects:
        if hasattr(shape.geometry, "buildConvexRepresentation"):
            shape.geometry.buildConvexRepresentation(True)
            shape.geometry = shape.geometry.convex
    add_wanted_pairs(cell, pin, model, geometry)
    assert len(geometry.collisionPairs) > 200
    geometry_data = geometry.createData()
    pin.computeDistances(model, data, geometry, geometry_data, pin_q(model, sample(cell, 0)))
    distances = np.array([result.min_distance for result in geometry_data.distanceResults])
    worst = geometry.collisionPairs[int(distances.argmin())]
    names = [geometry.geometryObjects[i].name for i in (worst.first, worst.second)]
    assert distances.min() > 0.005, f"{names} are {distances.min() * 1e3:.1f} mm apart"
    through = pin_q(model, {**sample(cell, 0), cell.joint_names[1]: 0.6})
    assert pin.computeCollisions(
        model, data, geometry, geometry_data, through, True
    )  # reaches through the table


def test_collision_hulls_are_the_shapes(urdf: Path) -> None:
    import trimesh
    import yourdfpy

    for link in yourdfpy.URDF.load(str(urdf), load_meshes=False).robot.links:
        for collision in link.collisions:
            if collision.geometry.mesh is not None:
                mesh = trimesh.load(collision.geometry.mesh.filename, force="mesh")
                assert abs(mesh.convex_hull.volume / mesh.volume - 1) < 0.02, collision.geometry.mesh.filename


def test_every_link_has_a_mass_of_its_own(cell: Cell, urdf: Path, bullet) -> None:
    import pybullet

    client, body, _, links = bullet
    masses = {name: pybullet.getDynamicsInfo(body, i, physicsClientId=client)[0] for name, i in links.items()}
    assert not [name for name, mass in masses.items() if mass == 1.0]
    assert masses["left_palm"] == pytest.approx(0.6) and masses["left_tool0"] == pytest.approx(1e-3)
    assert "<mimic" not in urdf.read_text() and "drake" not in urdf.read_text()


def test_composing_repeats_byte_for_byte(cell: Cell, urdf: Path, tmp_path: Path) -> None:
    again = compose_urdf(load_cell(cell.name), STAND, tmp_path / "again" / "cell.urdf")
    assert again.read_bytes() == urdf.read_bytes()
    bare = compose_urdf(cell, STAND, tmp_path / "bare.urdf", visuals=False)
    assert bare.read_text().count("<visual") == 2


def test_limits(cell: Cell) -> None:
    for arm in cell.arms:
        n = len(arm.joint_names)
        for array in (arm.q_home, arm.lower, arm.upper, arm.velocity, arm.acceleration, arm.effort):
            assert array.shape == (n,) and not array.flags.writeable
        assert (arm.lower < arm.q_home).all() and (arm.q_home < arm.upper).all()
        assert all(name.startswith(f"{arm.name}_") for name in arm.joint_names)
    assert cell.feed_areas.shape[1:] == (2, 2)


def edited(tmp_path: Path, *changes: tuple[str, str]) -> Path:
    folder = Path(shutil.copytree(ROOT / "robots/ur5e_pair", tmp_path / "cell"))
    text = (folder / "cell.toml").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    (folder / "cell.toml").write_text(text)
    return folder


def test_a_copied_folder_is_a_cell(tmp_path: Path) -> None:
    cell = load_cell(edited(tmp_path, ("yaw_deg = 180.0", "yaw_deg = 170.0")))
    assert cell.arms[1].T_world_base[0, 0] == pytest.approx(np.cos(np.deg2rad(170)))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('unit = "m"', "", "unit is missing"),
        ("schema = 1", "schema = 7", "reads schema 1"),
        ('package = "airo_models"', 'package = "airo_model"', "'airo_model' is not installed"),
        ("arms/ur5e/ur5e.urdf", "arms/ur5e/ur6e.urdf", "no file"),
        ('tool = "tool0"', 'tool = "tool1"', "'tool1' is not a link"),
        ('"shoulder_pan_joint"', '"pan"', "'pan' is not a joint"),
        ("acceleration = [4.0,", "acceleration = [", "acceleration"),
        ("collision/forearm_link_part_1.obj", "collision/none.obj", "not found; tried"),
        ('model = "ur5e"', 'model = "ur6e"', "not among arm_models"),
        ('hand = "hand.toml"', 'hand = "claw.toml"', "claw.toml"),
        ("114.0", "190.0", "elbow_joint = 190 is outside"),
        ('name = "right"', 'name = "left"', "two of them"),
        ("[-0.30, 0.30], [0.15", "[0.30, -0.30], [0.15", "min below max"),
        ("centre = [0.0, 0.0]", "center = [0.0, 0.0]", "table.center is unknown"),
        ("height = 0.10", "height = -0.10", "stand.height"),
        ("colour = [0.93", "colour = [93", "0 to 1"),
        ('["table", "stand"]', '["table"]', "not a pair"),
    ],
)
def test_a_wrong_value_is_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_cell(edited(tmp_path, (old, new)))


def test_an_excluded_link_must_exist(tmp_path: Path) -> None:
    cell = load_cell(edited(tmp_path, ('"*_palm"', '"*_plam"')))
    with pytest.raises(InputError, match="'left_plam' is not a link"):
        compose_urdf(cell, STAND, tmp_path / "cell.urdf")


def test_an_unknown_cell_lists_the_known_ones() -> None:
    with pytest.raises(InputError, match="ur5e_pair") as caught:
        load_cell("ur6e_pair")
    assert "tried" in str(caught.value)
