"""Assembly files with faults: every kind is named with its piece and its number."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from soma_bullet.assembly.file import load_assembly
from soma_bullet.errors import InputError
from tests.assembly.tower import GOOD, LOWER_GOAL, UPPER_GOAL

QUATERNION = "quat_wxyz = [0.7071, 0, 0, -0.7071]"
MESH = '"upper"\nmesh = "box.obj"'


def faults_of(folder: Path, text: str) -> tuple[str, ...]:
    (folder / "broken.toml").write_text(text)
    with pytest.raises(InputError) as caught:
        load_assembly(folder / "broken.toml")
    assert "broken.toml" in str(caught.value)
    for fault in caught.value.faults:
        assert fault in str(caught.value)
    return caught.value.faults


# what to replace in GOOD (everywhere), by what, and what the one fault must say
BROKEN = {
    "unknown key of a piece": (
        "density = 500",
        "densty = 500",
        r"piece 'upper': unknown key 'densty'; did you mean 'density'\?",
    ),
    "unknown key of a goal": (
        QUATERNION,
        QUATERNION + ", qaut = 1",
        r"piece 'upper': goal: unknown key 'qaut'",
    ),
    "unknown key of the file": (
        'unit = "mm"',
        'unit = "mm"\nauthor = "me"',
        r"unknown key 'author'; there are name, unit",
    ),
    "unknown key of the defaults": (
        "clearance = 0.2",
        "clearence = 0.2",
        r"defaults: unknown key 'clearence'; did you mean 'clear",
    ),
    "missing name": ('name = "upper"', "", r"piece number 2: name is missing"),
    "missing mesh": ('name = "upper"\nmesh = "box.obj"', 'name = "upper"', r"piece 'upper': mesh is missing"),
    "missing position": (UPPER_GOAL + ", ", "", r"piece 'upper': goal: position is missing"),
    "missing rotation": (", " + QUATERNION, "", r"piece 'upper': goal has neither of quat_wxyz and rpy_deg"),
    "two rotations": (
        QUATERNION,
        QUATERNION + ", rpy_deg = [0, 0, 0]",
        r"piece 'upper': goal has both of quat_wxyz and rpy_deg",
    ),
    "text for a number": (
        "density = 500",
        'density = "heavy"',
        r"piece 'upper': density must be a number, not 'heavy'",
    ),
    "truth for a number": (
        "friction = 0.3",
        "friction = true",
        r"piece 'upper': friction must be a number, not True",
    ),
    "number for a text": (
        'name = "upper"',
        "name = 7",
        r"piece number 2: name must be a text in quotes, not 7",
    ),
    "number for a list": (
        UPPER_GOAL,
        "position = 30.0",
        r"piece 'upper': goal: position must be a list of numbers, not 30.0",
    ),
    "two numbers for three": (
        UPPER_GOAL,
        "position = [0, 30]",
        r"piece 'upper': goal.position has 2 numbers; x, y, z are 3",
    ),
    "five numbers for four": (
        QUATERNION,
        "quat_wxyz = [1, 0, 0, 0, 0]",
        r"piece 'upper': goal.quat_wxyz has 5 numbers",
    ),
    "no unit": ('unit = "mm"\n', "", r"unit is missing"),
    "unknown unit": (
        'unit = "mm"',
        'unit = "millimetre"',
        r"unit 'millimetre' is unknown; it is one of m, cm, mm, in",
    ),
    "unknown mesh unit": (
        "density = 500",
        'mesh_unit = "ft"',
        r"piece 'upper': mesh_unit 'ft' is unknown; it is one of m, cm",
    ),
    "name taken": ('"upper"', '"lower"', r"piece 'lower': pieces number 1 and 2 have this name"),
    "name no file can have": ('"upper"', '"up/per"', r"name 'up/per' must be made of letters, digits"),
    "piece in single brackets": (
        GOOD[GOOD.index("[[piece]]") :],
        '[piece]\nname = "a"',
        r"under \[\[piece\]\] in double brackets",
    ),
    "mesh not there": (
        MESH,
        MESH.replace("box.obj", "bx.obj"),
        r"piece 'upper': mesh 'bx.obj' is no file; tried /.*did you mean 'box.obj'\?",
    ),
    "mesh unreadable": (
        MESH,
        MESH.replace("box.obj", "garbage.stl"),
        r"piece 'upper': mesh 'garbage.stl' (cannot be read|has no triangles)",
    ),
    "mesh empty": (
        MESH,
        MESH.replace("box.obj", "empty.obj"),
        r"piece 'upper': mesh 'empty.obj' (cannot be read|has no triangles)",
    ),
    "mesh of unknown kind": (
        MESH,
        MESH.replace("box.obj", "tower.toml"),
        r"piece 'upper': mesh 'tower.toml' cannot be read",
    ),
    "mesh with nan": (
        MESH,
        MESH.replace("box.obj", "nan.stl"),
        r"piece 'upper': mesh 'nan.stl' has 1 corners that are not finite",
    ),
    "mesh open": (
        MESH,
        MESH.replace("box.obj", "open.obj"),
        r"piece 'upper': mesh 'open.obj' is not watertight: of 18 edges 3 are open",
    ),
    "mesh inside out": (
        MESH,
        MESH.replace("box.obj", "inside_out.obj"),
        r"piece 'upper': .* is inside out: its volume is -12000",
    ),
    "mesh wound both ways": (
        MESH,
        MESH.replace("box.obj", "mixed.obj"),
        r"piece 'upper': .* wound both ways",
    ),
    "mesh of two bodies": (
        MESH,
        MESH.replace("box.obj", "two.obj"),
        r"piece 'upper': .* has 2 separate bodies",
    ),
    "mesh curved inwards": (
        MESH,
        MESH.replace("box.obj", "cup.obj"),
        r"piece 'upper': is concave \(its hull has 2.05 x .* stand out by 1.\d+ mm",
    ),
    "zero quaternion": (
        QUATERNION,
        "quat_wxyz = [0, 0, 0, 0]",
        r"piece 'upper': goal.quat_wxyz has norm 0; a rotation has norm 1",
    ),
    "long quaternion": (
        QUATERNION,
        "quat_wxyz = [1, 0, 0, 0.1]",
        r"piece 'upper': goal.quat_wxyz has norm 1.00499",
    ),
    "nan in a quaternion": (
        QUATERNION,
        "quat_wxyz = [nan, 0, 0, 0]",
        r"piece 'upper': goal: quat_wxyz must be finite, not nan",
    ),
    "infinite position": (
        UPPER_GOAL,
        "position = [inf, 0, 0]",
        r"piece 'upper': goal: position must be finite, not inf",
    ),
    "negative density": ("density = 500", "density = -5", r"piece 'upper': density -5 kg/m3 must be above 0"),
    "negative friction": (
        "friction = 0.3",
        "friction = -0.1",
        r"piece 'upper': friction -0.1 must lie in 0 to 2",
    ),
    "friction above 2": (
        "friction = 0.3",
        "friction = 2.5",
        r"piece 'upper': friction 2.5 must lie in 0 to 2",
    ),
    "friction of the support": (
        'unit = "mm"',
        'unit = "mm"\n[support]\nfriction = 3',
        r"\[support\]: friction 3 must lie in 0 to 2",
    ),
    "negative clearance": (
        "clearance = 0.1",
        "clearance = -0.1",
        r"piece 'upper': clearance -0.1 must not be negative",
    ),
    "clearance of the defaults": (
        "clearance = 0.2",
        "clearance = -0.2",
        r"\[defaults\]: clearance -0.2 must not",
    ),
    "clearance too large": (
        "clearance = 0.1",
        "clearance = 6.0",
        r"piece 'upper': clearance 6 mm eats a part that is 20 mm thin; it must be below 5 mm",
    ),
    "colour by name": (
        '"#ff8000"',
        '"orange"',
        r"piece 'upper': color must be \"#rrggbb\" or three numbers from 0 to 1, not 'orange'",
    ),
    "colour above 1": ('"#ff8000"', "[255, 128, 0]", r"piece 'upper': color must be .* not \[255, 128, 0\]"),
    "metres for millimetres": (
        "density = 500",
        'mesh_unit = "m"',
        r"piece 'upper': its size is 2e\+04 x 3e\+04 x 2e\+04 mm, .* is unit, or mesh_unit, right\?",
    ),
    "too small": (
        MESH,
        MESH.replace("box.obj", "metres.obj"),
        r"piece 'upper': its size is 0.02 x 0.03 x 0.02 mm",
    ),
    "goals overlap": (
        UPPER_GOAL,
        "position = [0, 0, 29.0]",
        r"pieces 'lower' and 'upper': their goals overlap by 600 mm3, 30 x 20 x 1 mm \(5.00% of",
    ),
    "below the support": (
        LOWER_GOAL,
        "position = [0, 0, 9.5]",
        r"piece 'lower': its goal reaches 0.5 mm below the support at 0 mm",
    ),
    "floats": (
        UPPER_GOAL,
        "position = [0, 0, 33.0]",
        r"piece 'upper' touches neither the support nor another piece: nearest is 'lower', 3 mm",
    ),
    "touches by an edge only": (
        UPPER_GOAL,
        "position = [30, 0, 30.0]",
        r"piece 'upper' touches neither .*: nearest is 'lower', 0 mm away",
    ),
    "nothing stands": (
        'unit = "mm"',
        'unit = "mm"\n[support]\nheight = -4',
        r"nothing stands on the support: the lowest goal is 4 mm above it",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_fault_is_named_with_its_piece_and_number(folder: Path, case: str) -> None:
    old, new, message = BROKEN[case]
    assert old in GOOD
    faults = faults_of(folder, GOOD.replace(old, new))
    assert len(faults) == 1, faults
    assert re.search(message, faults[0]), faults[0]


def test_all_faults_are_listed_at_once(folder: Path) -> None:
    """One fault in each of the ways a file is read: keys, types, values, meshes, goals."""
    text = GOOD
    for case in (
        "unknown key of the defaults",
        "friction of the support",
        "friction above 2",
        "colour by name",
        "mesh open",
    ):
        text = text.replace(*BROKEN[case][:2])
    third = (
        '\n[[piece]]\nname = "third"\nmesh = "box.obj"\ndensity = 0\ngoal = '
        "{ position = [0, 0, 9], rpy_deg = [0, 0, 90] }"
    )
    fourth = (
        '\n[[piece]]\nname = "fourth"\nmesh = "no.obj"\ngoal = '
        "{ position = [0, 0, 9], quat_wxyz = [2, 0, 0, 0] }"
    )
    faults = faults_of(folder, text + third + fourth)
    expected = [
        "'clearence'",
        r"\[support\]: friction 3",
        "'upper': color",
        "'third': density 0",
        "'fourth': mesh 'no.obj'",
        "'fourth': goal.quat_wxyz has norm 2",
        "'lower' and 'third': their goals overlap",
        "'third': its goal reaches 1 mm",
    ]
    assert len(faults) == len(expected), faults
    for message in expected:
        assert sum(bool(re.search(message, fault)) for fault in faults) == 1, (message, faults)


def test_no_pieces(folder: Path) -> None:
    assert "no [[piece]]" in faults_of(folder, 'name = "none"\nunit = "mm"')[0]


def test_a_group_that_hangs_together_in_the_air(folder: Path) -> None:
    extra = (
        '\n[[piece]]\nname = "{0}"\nmesh = "box.obj"\ngoal = '
        "{{ position = [100, {1}, 30], rpy_deg = [0, 0, 0] }}\n"
    )
    faults = faults_of(folder, GOOD + extra.format("left", 0) + extra.format("right", 30))
    assert len(faults) == 1
    assert re.search(
        "pieces 'left', 'right' hang together but touch neither .*: nearest is the support, 20 mm away",
        faults[0],
    )


def test_not_toml_and_not_text(folder: Path) -> None:
    assert "not valid TOML" in faults_of(folder, "name = ")[0]
    (folder / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not UTF-8"):
        load_assembly(folder / "binary.toml")
