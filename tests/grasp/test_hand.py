"""The hand's description: exact boxes, one conversion of units, every fault at once."""

import runpy
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from soma_bullet.errors import InputError
from soma_bullet.grasp.hand import load_hand

ROOT = Path(__file__).resolve().parents[2]
HANDS = sorted(ROOT.glob("robots/*/hand.toml"))
FOLDER = ROOT / "robots/ur5e_pair"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return Path(shutil.copytree(FOLDER, tmp_path / "cell"))


def edit(file: Path, *changes: tuple[str, str]) -> Path:
    text = file.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    file.write_text(text)
    return file


@pytest.mark.parametrize("path", HANDS, ids=lambda p: p.parent.name)
def test_every_hand_loads(path: Path) -> None:
    hand = load_hand(path)
    assert 0 < hand.opening < 0.5  # a file in mm read as m would show here
    assert hand.force_range[0] <= hand.grip_force <= hand.force_range[1]
    assert len(hand.boxes(0.0)) == len(hand.palm_boxes) + len(hand.left_boxes) + len(hand.right_boxes)


def test_boxes_are_those_of_the_description() -> None:
    hand = load_hand(FOLDER / "hand.toml")
    (palm,), (left, left_pad), (right, right_pad) = hand.palm_boxes, hand.left_boxes, hand.right_boxes
    np.testing.assert_allclose(hand.T_mount_tcp[:3, 3], (0, 0, 0.143), atol=1e-12)
    np.testing.assert_allclose(palm.half, (0.030, 0.020, 0.035))
    np.testing.assert_allclose(palm.T[:3, 3], (0, 0, -0.108), atol=1e-12)
    np.testing.assert_allclose(left.half, (0.00275, 0.007, 0.040))
    np.testing.assert_allclose(left.T[:3, 3], (0.00525, 0, -0.033), atol=1e-12)
    np.testing.assert_allclose(right.T[:3, 3], (-0.00525, 0, -0.033), atol=1e-12)
    for pad, sign in (
        (left_pad, 1.0),
        (right_pad, -1.0),
    ):  # the pads alone reach the plane in which they meet
        np.testing.assert_allclose(2 * pad.half[1:], hand.pad_size)
        np.testing.assert_allclose(pad.T[:3, 3], (sign * pad.half[0], 0, 0), atol=1e-12)
    assert hand.opening == pytest.approx(0.085)
    np.testing.assert_allclose(hand.pad_size, (0.014, 0.014))


def test_fingers_open_outwards() -> None:
    hand = load_hand(FOLDER / "hand.toml")
    _, left, left_pad, right, right_pad = hand.boxes(0.020)
    assert left_pad.T[0, 3] - left_pad.half[0] == pytest.approx(0.010)
    assert right_pad.T[0, 3] + right_pad.half[0] == pytest.approx(-0.010)
    assert left.T[0, 3] - left.half[0] > 0.010
    assert right.T[0, 3] + right.half[0] < -0.010


def test_arrays_cannot_be_changed() -> None:
    hand = load_hand(FOLDER / "hand.toml")
    with pytest.raises(ValueError):
        hand.T_mount_tcp[0, 3] = 1.0


def test_all_faults_at_once(folder: Path) -> None:
    path = edit(folder / "hand.toml", ('unit = "mm"', ""), ("opening = 85.0", "opening = -1\nwidth = 3"),
                ("\nforce = ", "\nforce = 400.0  # "), ('"hand.urdf"', '"none.urdf"'))  # fmt: skip
    with pytest.raises(InputError) as caught:
        load_hand(path)
    text = "\n".join(caught.value.faults)
    for part in (
        "unit is missing",
        "grip.opening = -1",
        "grip.width is unknown",
        "400 N lies outside",
        "no file",
    ):
        assert part in text
    assert len(caught.value.faults) == 5


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("pad_size = [14.0, 14.0]", "pad_size = [20.0, 14.0]", "exceeds the fingers"),
        ("pad_size = [14.0, 14.0]", "pad_size = [14.0]", "must be an array"),
        ("opening = 85.0", "opening = 90.0", "travel half of it"),
        ('palm = "palm"', 'palm = "plam"', "'plam' is not a link"),
        (
            '["finger_left_joint", "finger_right_joint"]',
            '["finger_right_joint", "finger_left_joint"]',
            "must open towards",
        ),
        ('unit = "mm"', 'unit = "inch"', "must be one of"),
        ("schema = 1", "schema = 2", "reads schema 1"),
        ("[grip]", "[grip", "TOML"),
    ],
)
def test_a_wrong_value_is_named(folder: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_hand(edit(folder / "hand.toml", (old, new)))


def test_a_missing_file_is_an_input_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_hand(tmp_path / "hand.toml")


def test_a_mesh_collision_counts_as_its_bounding_box(folder: Path) -> None:
    edit(folder / "hand.urdf", ('<origin xyz="0 0 0.035"/>\n      <geometry><box size="0.06 0.04 0.07"/>',
                                '<geometry><mesh filename="meshes/palm.obj"/>'))  # fmt: skip
    (palm,) = load_hand(folder / "hand.toml").palm_boxes
    np.testing.assert_allclose(palm.half, (0.030, 0.020, 0.022), atol=1e-6)


def test_visuals_stay_inside_the_collision_boxes_when_closed() -> None:
    import yourdfpy

    hand = load_hand(FOLDER / "hand.toml")
    model = yourdfpy.URDF.load(str(hand.urdf))
    low, high = (np.array([b.T[:3, 3] + sign * b.half for b in hand.boxes(0)]) for sign in (-1, 1))
    shown = model.scene.bounds - hand.T_mount_tcp[:3, 3]
    assert (shown[0] > low.min(0) - 2e-4).all() and (shown[1] < high.max(0) + 2e-4).all()


def test_the_committed_hand_is_what_the_script_writes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["generate_hand.py", str(tmp_path)])
    runpy.run_path(str(ROOT / "scripts/generate_hand.py"), run_name="__main__")
    written = sorted(p.relative_to(tmp_path) for p in tmp_path.rglob("*") if p.is_file())
    assert len(written) == 12
    assert (tmp_path / "hand.urdf").read_text() == (FOLDER / "hand.urdf").read_text()
    for file in written:  # the order of a hull's facets may change with its library, its size not
        assert (FOLDER / file).is_file()


def test_grasp_needs_no_simulator() -> None:
    import subprocess

    code = ("import sys, soma_bullet.grasp.hand as h; h.load_hand(sys.argv[1]); "
            "print([m for m in ('pybullet', 'pinocchio', 'coal', 'ompl') if m in sys.modules])")  # fmt: skip
    command = [sys.executable, "-c", code, str(FOLDER / "hand.toml")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.strip() == "[]"
