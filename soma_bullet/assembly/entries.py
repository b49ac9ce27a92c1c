"""What an assembly file may say: its entries, and how one that says something else is reported."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal, NewType, get_args, get_origin

import numpy as np
from cattrs import Converter
from cattrs.errors import BaseValidationError, ClassValidationError, ForbiddenExtraKeysError
from scipy.spatial.transform import Rotation

from soma_bullet.assembly.advice import Advice
from soma_bullet.frames import Array, make_transform

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}  # [m]
QUATERNION_TOLERANCE = 1e-3  # of the norm: rounding in a file is normalised away, a mistake is not
LARGEST_FRICTION = 2.0
VALUES = ("density", "friction", "clearance", "chamfer")  # keys of a piece that `[defaults]` may set
CLEARANCE = 1e-4  # [m] where the file gives none
PALETTE = ("#3a76c4", "#e88fae", "#f2c14e", "#5aa469", "#e07a3f", "#2f9c95", "#8d6ab8")

Color = NewType("Color", tuple[float, float, float])
Numbers = tuple[float, ...]


@dataclass(frozen=True)
class GoalEntry:
    """`goal` of a piece: position in the file's unit and one of the two rotations."""

    position: Numbers
    quat_wxyz: Numbers | None = None
    rpy_deg: Numbers | None = None


@dataclass(frozen=True)
class SupportEntry:
    """`[support]`"""

    height: float = 0.0
    friction: float = 0.5


@dataclass(frozen=True)
class DefaultsEntry:
    """`[defaults]`; clearance and chamfer in the file's unit, clearance None for 0.1 mm."""

    density: float = 700.0
    friction: float = 0.5
    clearance: float | None = None
    chamfer: float = 0.0


@dataclass(frozen=True)
class PieceEntry:
    """`[[piece]]`; the values here stand in only until the file's defaults are known."""

    name: str
    mesh: str
    goal: GoalEntry
    mesh_unit: str = "m"
    density: float = 0.0
    friction: float = 0.0
    clearance: float = 0.0
    chamfer: float = 0.0
    color: Color = Color((0.0, 0.0, 0.0))


@dataclass(frozen=True)
class FileEntry:
    """The file but for its pieces, which are read one by one so that each can fail by itself."""

    name: str
    unit: str
    support: SupportEntry = field(default_factory=SupportEntry)
    defaults: DefaultsEntry = field(default_factory=DefaultsEntry)
    advice: Advice = field(default_factory=Advice)

    def of_every_piece(self, number: int) -> dict[str, Any]:
        """What the piece of that number has where it does not say otherwise."""
        clearance = self.defaults.clearance
        return {
            "mesh_unit": self.unit,
            "density": self.defaults.density,
            "friction": self.defaults.friction,
            "clearance": CLEARANCE / UNITS[self.unit] if clearance is None else clearance,
            "chamfer": self.defaults.chamfer,
            "color": PALETTE[number % len(PALETTE)],
        }


class Faults(ValueError):
    """What is wrong with one entry, on the way to the InputError that carries the faults of all."""

    def __init__(self, *faults: str):
        self.faults = faults
        super().__init__(*faults)


def _number(value: Any, _: Any = None) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"must be a number, not {value!r}")
    if not math.isfinite(value):
        raise ValueError(f"must be finite, not {value}")
    return float(value)


def _text(value: Any, _: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"must be a text in quotes, not {value!r}")
    return value


def _numbers(value: Any, _: Any) -> Numbers:
    if not isinstance(value, list):
        raise TypeError(f"must be a list of numbers, not {value!r}")
    return tuple(_number(item) for item in value)


def _color(value: Any, _: Any) -> Color:
    if isinstance(value, str) and re.fullmatch("#[0-9a-fA-F]{6}", value):
        return Color((int(value[1:3], 16) / 255, int(value[3:5], 16) / 255, int(value[5:7], 16) / 255))
    if isinstance(value, list) and len(value) == 3 and all(0.0 <= _number(item) <= 1.0 for item in value):
        return Color((float(value[0]), float(value[1]), float(value[2])))
    raise ValueError(f'must be "#rrggbb" or three numbers from 0 to 1, not {value!r}')


def _choice(value: Any, kind: Any) -> Any:
    if value not in get_args(kind):
        raise ValueError(f"must be {' or '.join(map(repr, get_args(kind)))}, not {value!r}")
    return value


def _converter(forbid_extra_keys: bool) -> Converter:
    converter = Converter(forbid_extra_keys=forbid_extra_keys)
    converter.register_structure_hook(float, _number)
    converter.register_structure_hook(str, _text)
    converter.register_structure_hook_func(lambda kind: kind == Numbers, _numbers)
    converter.register_structure_hook_func(lambda kind: get_origin(kind) is Literal, _choice)
    converter.register_structure_hook_func(lambda kind: kind is Color, _color)
    return converter


STRICT, LENIENT = _converter(True), _converter(False)


def _structure(raw: Any, kind: type, where: str, faults: list[str]) -> Any:
    """`raw` as a `kind` with what is wrong added to `faults`; None where more is wrong than keys too many."""
    if not isinstance(raw, Mapping):
        faults.append(f"{where}: must be a table, not {raw!r}")
        return None
    try:
        return STRICT.structure(raw, kind)
    except BaseValidationError as error:
        faults += _explain(error, where)
    try:
        return LENIENT.structure(raw, kind)
    except BaseValidationError:
        return None


def _explain(error: BaseException, where: str) -> Iterator[str]:
    if isinstance(error, ClassValidationError):
        with_notes, without_notes = error.group_exceptions()
        for inner, note in with_notes:
            yield from _explain(inner, f"{where}: {note.name}")
        for inner in without_notes:
            yield from _explain(inner, where)
    elif isinstance(error, ForbiddenExtraKeysError):
        known = [entry.name for entry in fields(error.cl)]
        for key in sorted(error.extra_fields):
            yield f"{where}: unknown key {key!r}{_suggest(key, known)}"
    elif isinstance(error, KeyError):
        yield f"{where} is missing"
    else:
        yield f"{where} {error}"


def _suggest(word: str, known: list[str]) -> str:
    near = difflib.get_close_matches(word, known, 1)
    return f"; did you mean {near[0]!r}?" if near else f"; there are {', '.join(known)}"


def parse_entries(raw: Mapping[str, Any], faults: list[str]) -> tuple[FileEntry | None, list[PieceEntry]]:
    """The head of a parsed file (None where it is unusable) and those of its pieces that could be read.

    Adds to `faults` what is wrong with the others.
    """
    tables = raw.get("piece", [])
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        faults.append("piece: each piece is a table of its own, under [[piece]] in double brackets")
        tables = []
    elif not tables:
        faults.append("there is no [[piece]]; an assembly has at least one")
    head = _structure(
        {key: value for key, value in raw.items() if key != "piece"}, FileEntry, "the file", faults
    )
    if head is not None and head.unit not in UNITS:
        faults.append(f"unit {head.unit!r} is unknown; it is one of {', '.join(UNITS)}")
        head = None
    elif head is None:
        head = _stand_in(raw)
    if head is not None:
        faults += _name_faults("the file", head.name)
        faults += _value_faults("[support]", friction=head.support.friction)
        for key in ("push", "disturbance"):
            value = getattr(head.advice, key)
            if value is not None and value < 0.0:
                faults.append(f"[advice]: {key} = {value:g} must not be negative")
        faults += _value_faults("[defaults]", **{key: getattr(head.defaults, key) for key in VALUES})
    names = [table.get("name") for table in tables]
    for name in dict.fromkeys(name for name in names if isinstance(name, str) and names.count(name) > 1):
        numbers = " and ".join(str(number) for number, other in enumerate(names, 1) if other == name)
        faults.append(f"piece {name!r}: pieces number {numbers} have this name; names are unique")
    entries = []
    for number, (name, table) in enumerate(zip(names, tables, strict=True), 1):
        where = f"piece {name!r}" if isinstance(name, str) else f"piece number {number}"
        entry = _structure(
            ({} if head is None else head.of_every_piece(number - 1)) | table, PieceEntry, where, faults
        )
        if entry is None:
            continue
        own = {key: getattr(entry, key) if key in table else None for key in VALUES}
        faults += [*_name_faults(where, entry.name), *_value_faults(where, **own)]
        if entry.mesh_unit in UNITS:
            entries.append(entry)
        else:
            faults.append(
                f"{where}: mesh_unit {entry.mesh_unit!r} is unknown; it is one of {', '.join(UNITS)}"
            )
    return head, entries


def _stand_in(raw: Mapping[str, Any]) -> FileEntry | None:
    """What can be read of a faulty head, so that the pieces can be looked at as well; None without a unit."""
    if not isinstance(raw.get("unit"), str) or raw["unit"] not in UNITS:
        return None
    support = _structure(raw.get("support", {}), SupportEntry, "", [])
    defaults = _structure(raw.get("defaults", {}), DefaultsEntry, "", [])
    return FileEntry(
        "unnamed", raw["unit"], support or SupportEntry(height=-math.inf), defaults or DefaultsEntry()
    )


def goal_pose(entry: PieceEntry, scale: float) -> Array:
    """T_assembly_piece (4, 4) of a piece's goal, whose lengths are in units of `scale` [m].

    Raises:
        Faults: the goal is no pose.
    """
    goal, where = entry.goal, f"piece {entry.name!r}: goal"
    faults = _length_faults(f"{where}.position", goal.position, "x, y, z")
    rotation = Rotation.identity()
    if (goal.quat_wxyz is None) == (goal.rpy_deg is None):
        found = "neither" if goal.rpy_deg is None else "both"
        faults.append(f"{where} has {found} of quat_wxyz and rpy_deg; give one of them")
    elif goal.rpy_deg is not None:
        faults += _length_faults(f"{where}.rpy_deg", goal.rpy_deg, "roll, pitch, yaw")
        if len(goal.rpy_deg) == 3:
            rotation = Rotation.from_euler("xyz", goal.rpy_deg, degrees=True)
    elif goal.quat_wxyz is not None:
        faults += _length_faults(f"{where}.quat_wxyz", goal.quat_wxyz, "w, x, y, z")
        norm = float(np.linalg.norm(goal.quat_wxyz))
        if abs(norm - 1) > QUATERNION_TOLERANCE:
            faults.append(
                f"{where}.quat_wxyz has norm {norm:.6g}; a rotation has norm 1 within "
                f"{QUATERNION_TOLERANCE:g}"
            )
        elif len(goal.quat_wxyz) == 4:
            rotation = Rotation.from_quat(goal.quat_wxyz, scalar_first=True)
    if faults:
        raise Faults(*faults)
    return make_transform(rotation.as_matrix(), np.array(goal.position) * scale)


def _length_faults(where: str, values: Numbers, labels: str) -> list[str]:
    count = len(labels.split(","))
    return [] if len(values) == count else [f"{where} has {len(values)} numbers; {labels} are {count}"]


def _value_faults(
    where: str,
    density: float | None = None,
    friction: float | None = None,
    clearance: float | None = None,
    chamfer: float | None = None,
) -> Iterator[str]:
    if density is not None and density <= 0:
        yield f"{where}: density {density:g} kg/m3 must be above 0"
    if friction is not None and not 0 <= friction <= LARGEST_FRICTION:
        yield f"{where}: friction {friction:g} must lie in 0 to {LARGEST_FRICTION:g}"
    if clearance is not None and clearance < 0:
        yield (
            f"{where}: clearance {clearance:g} must not be negative; it is how far faces stand back from "
            f"the mesh"
        )
    if chamfer is not None and chamfer < 0:
        yield f"{where}: chamfer {chamfer:g} must not be negative; it is how much of the edges is cut"


def _name_faults(where: str, name: str) -> Iterator[str]:
    if not re.fullmatch(r"[\w.-]+", name):  # names become those of folders and files
        yield f"{where}: name {name!r} must be made of letters, digits and _ . -"
