"""The studio: shows what it is told, at the right place, the same each time; captions and videos come out
whole."""

from pathlib import Path

import numpy as np
import pytest

from soma_bullet.errors import InputError
from soma_bullet.frames import make_transform
from soma_bullet.pictures import look
from soma_bullet.pictures import studio as studio_module
from soma_bullet.pictures.camera import CAMERAS, Arrow, Camera, PieceVisual
from soma_bullet.pictures.caption import Caption, draw_caption
from soma_bullet.pictures.sight import Sight
from soma_bullet.pictures.studio import Studio, _cuts, _jitters
from soma_bullet.robot.cell import load_cell
from soma_bullet.robot.compose import compose_urdf

SIZE = (320, 180)
CLOSE = Camera((0.0, 0.0, 0.12), 0.5, 0.0, -20.0)
AT_HOME = make_transform(translation=(0.0, 0.0, 0.12))


def cube(name: str, rgb: look.Colour) -> PieceVisual:
    import trimesh

    mesh = trimesh.creation.box(extents=(0.04, 0.04, 0.04))
    return PieceVisual(name, mesh.vertices, mesh.faces, rgb)


@pytest.fixture(scope="module")
def urdf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compose_urdf(load_cell("ur5e_pair"), (0.05, 0.05), tmp_path_factory.mktemp("look") / "cell.urdf")


@pytest.fixture(scope="module", params=["auto", "tiny"])
def studio(request: pytest.FixtureRequest, urdf: Path):
    with Studio(
        urdf, [cube("red", (0.8, 0.1, 0.1)), cube("blue", (0.1, 0.2, 0.8))], SIZE, request.param
    ) as opened:
        yield opened


@pytest.fixture(scope="module")
def home() -> dict[str, float]:
    cell = load_cell("ur5e_pair")
    return dict(zip(cell.joint_names, cell.q_home.tolist(), strict=True))


def redness(frame: np.ndarray) -> np.ndarray:
    pixels = frame.astype(int)
    return (pixels[..., 0] > 90) & (pixels[..., 1] < 60) & (pixels[..., 2] < 60)


def test_a_piece_is_seen_where_it_is(studio: Studio, home: dict[str, float]) -> None:
    frame = studio.frame(home, {"red": AT_HOME}, CLOSE)
    assert frame.shape == (180, 320, 3) and frame.dtype == np.uint8
    rows, columns = np.nonzero(redness(frame))
    # A 40 mm cube at 0.5 m and 35 deg of view fills about an eighth of the height.
    assert 500 < len(rows) < 4000
    assert abs(columns.mean() - 160) < 6 and abs(rows.mean() - 90) < 12
    moved = studio.frame(home, {"red": make_transform(translation=(0.05, 0.0, 0.12))}, CLOSE)
    assert np.nonzero(redness(moved))[1].mean() > columns.mean() + 15  # yaw 0: +x is to the right


def test_what_has_no_pose_is_not_shown(studio: Studio, home: dict[str, float]) -> None:
    assert not redness(studio.frame(home, {"blue": AT_HOME}, CLOSE)).any()


def test_the_same_picture_twice(studio: Studio, home: dict[str, float]) -> None:
    first = studio.frame(home, {"red": AT_HOME}, CAMERAS["front"])
    studio.frame(
        {name: value + 0.3 for name, value in home.items()},
        {},
        CAMERAS["close"],
        Arrow((0, 0, 0.2), (0, 0, -1)),
    )
    np.testing.assert_array_equal(studio.frame(home, {"red": AT_HOME}, CAMERAS["front"]), first)


def test_the_first_picture_has_its_shadows(urdf: Path, home: dict[str, float]) -> None:
    with Studio(urdf, [], SIZE) as fresh:
        first = fresh.frame(home, {}, CAMERAS["top"])
        fresh.frame(home, {}, CAMERAS["top"])
        np.testing.assert_array_equal(fresh.frame(home, {}, CAMERAS["top"]), first)


def test_an_arrow_appears_and_goes(studio: Studio, home: dict[str, float]) -> None:
    without = studio.frame(home, {}, CLOSE)
    arrow = Arrow((0.03, 0.0, 0.20), (0.0, 0.0, -1.0), 0.08, (0.8, 0.05, 0.05))
    assert redness(studio.frame(home, {}, CLOSE, arrow)).sum() > 50
    np.testing.assert_array_equal(studio.frame(home, {}, CLOSE), without)


def test_joints_by_name_or_in_order(studio: Studio, home: dict[str, float]) -> None:
    by_name = studio.frame({**dict.fromkeys(studio.joint_names, 0.0), **home}, {}, CAMERAS["front"])
    in_order = studio.frame([home.get(name, 0.0) for name in studio.joint_names], {}, CAMERAS["front"])
    np.testing.assert_array_equal(by_name, in_order)
    with pytest.raises(InputError, match="unknown joint 'elbow'"):
        studio.frame({"elbow": 0.0}, {}, CAMERAS["front"])
    with pytest.raises(InputError, match="unknown pieces green"):
        studio.frame(home, {"green": AT_HOME}, CAMERAS["front"])


@pytest.mark.slow
def test_tiles_join_without_a_seam(
    urdf: Path, home: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A picture of several tiles is the picture of one."""
    with Studio(urdf, [], (640, 360)) as one:
        if one.renderer != "egl":
            pytest.skip(one.reason)
        whole = one.frame(home, {}, CAMERAS["front"]).astype(int)
    monkeypatch.setattr(studio_module, "_LARGEST", (250, 200))
    with Studio(urdf, [], (640, 360)) as many:
        assert len(many._tiles) == 6
        tiled = many.frame(home, {}, CAMERAS["front"]).astype(int)
    assert np.abs(whole - tiled).mean() < 0.5


@pytest.mark.slow
def test_more_exposures_soften_and_move_nothing(urdf: Path, home: dict[str, float]) -> None:
    frames = []
    for count in (1, 4):
        with Studio(urdf, [cube("red", (0.8, 0.1, 0.1))], SIZE, supersampling=count) as studio:
            frames.append(studio.frame(home, {"red": AT_HOME}, CLOSE))
    centres = [np.array(np.nonzero(redness(frame))).mean(axis=1) for frame in frames]
    np.testing.assert_allclose(centres[0], centres[1], atol=1.0)
    assert np.abs(frames[0].astype(int) - frames[1]).mean() < 6


@pytest.mark.parametrize("count", [1, 2, 3, 24])
def test_exposures_are_spread_around_the_middle(count: int) -> None:
    offsets = np.array([(jitter.right, jitter.down) for jitter in _jitters(count)])
    assert np.abs(offsets).max() <= 0.5
    assert np.abs(offsets.mean(axis=0)).max() < 0.25


def test_a_camera_projects_as_the_renderer_does(studio: Studio, home: dict[str, float]) -> None:
    camera = Camera((0.02, -0.01, 0.15), 0.6, 35.0, -25.0)
    rows, columns = np.nonzero(redness(studio.frame(home, {"red": AT_HOME}, camera)))
    ((right, up),) = camera.project([AT_HOME[:3, 3]], 320 / 180)
    assert abs(columns.mean() - 160 * (1 + right)) < 4 and abs(rows.mean() - 90 * (1 - up)) < 6


def test_sight_is_blocked_by_what_is_in_between(home: dict[str, float], tmp_path: Path) -> None:
    urdf = compose_urdf(load_cell("ur5e_pair"), (0.05, 0.05), tmp_path / "cell.urdf", visuals=False)
    eye, point = np.array([[0.0, -0.6, 0.3]]), np.array([[0.0, 0.6, 0.3]])
    with Sight(urdf, [cube("red", (1, 0, 0))]) as sight:
        sight.place(home, {"red": make_transform(translation=(0.0, 0.0, 0.3))})
        np.testing.assert_allclose(sight.reach(eye, point), [0.58 / 1.2], atol=1e-3)
        sight.place(home, {"red": make_transform(translation=(0.0, 0.1, 0.5))})
        np.testing.assert_array_equal(sight.reach(eye, point), [1.0])
        corners = sight.robot()
    assert corners[:, 0].min() < -0.4 and corners[:, 0].max() > 0.4 and corners[:, 2].max() > 0.5


def test_cuts_cover() -> None:
    assert _cuts(1280, 1024) == [(0, 640), (640, 1280)] and _cuts(720, 768) == [(0, 720)]


def test_nothing_is_printed(urdf: Path, capfd: pytest.CaptureFixture[str]) -> None:
    Studio(urdf, [], SIZE).close()
    out, err = capfd.readouterr()
    assert out == "" and err == ""


@pytest.mark.parametrize(("size", "renderer"), [((321, 180), "auto"), ((320, 180), "vulkan")])
def test_wrong_arguments(urdf: Path, size: tuple[int, int], renderer: str) -> None:
    with pytest.raises(InputError):
        Studio(urdf, [], size, renderer)


def test_a_caption_keeps_the_picture_above_it() -> None:
    frame = np.full((180, 320, 3), 200, np.uint8)
    marked = draw_caption(frame, Caption("Insert Z", "direction (0, 1, −1)/√2", "4×"))
    assert marked.shape == frame.shape and (frame == 200).all()
    assert (marked[:150] == 200).all() and marked[165:].mean() < 140
    assert marked.max() > 200  # the text


def test_thinning_keeps_the_shape(tmp_path: Path) -> None:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    corners = look.thinned(ball.vertices, ball.faces, 0.004)
    assert len(corners) < 0.5 * len(ball.faces)
    assert np.abs(np.linalg.norm(corners, axis=2) - 0.05).max() < 0.002


def test_a_mesh_is_split_by_its_materials(tmp_path: Path) -> None:
    (tmp_path / "two.mtl").write_text("newmtl a\nKd 1 0 0\nnewmtl b\nKd 0 0 1\n")
    (tmp_path / "two.obj").write_text(
        "mtllib two.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nusemtl a\nf 1 2 3\nusemtl b\nf 1/1/1 2/1/1 "
        "4/1/1\nf -4 -2 -1\n"
    )
    parts = look.split_mesh(tmp_path / "two.obj", tmp_path / "cache")
    assert [rgb for _, rgb in parts] == [(1, 0, 0), (0, 0, 1)]
    assert [part.read_text().count("\nf ") for part, _ in parts] == [1, 2]
    before = [part.stat().st_mtime_ns for part, _ in parts]
    assert [
        part.stat().st_mtime_ns for part, _ in look.split_mesh(tmp_path / "two.obj", tmp_path / "cache")
    ] == before


def test_every_box_of_a_link_is_shown_in_its_own_size(tmp_path: Path) -> None:
    """The fingers of the small hand are made of two boxes each: a finger and its pad."""
    import trimesh
    from lxml import etree

    cell = load_cell(Path(__file__).parents[1] / "data/mixed_pair")
    urdf = compose_urdf(cell, (0.1, 0.1), tmp_path / "cell.urdf")
    lean = etree.parse(str(look.lean_urdf(urdf, tmp_path / "lean.urdf", tmp_path))).getroot()
    for finger in cell.arms[1].finger_links:
        shapes = lean.findall(f"link[@name='{finger}']/visual/geometry/mesh")
        sizes = [trimesh.load_mesh(shape.get("filename")).extents.tolist() for shape in shapes]
        assert sizes == [pytest.approx([0.004, 0.010, 0.060]), pytest.approx([0.002, 0.010, 0.012])]
