"""Frozen dataclasses to files and back: JSON for what people read, npz where arrays are large.

Infinity is the string "inf" in JSON. Files are written whole or not at all.
"""

from __future__ import annotations

import json
import math
import os
import re
import tempfile
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar, get_origin

import numpy as np
from cattrs import Converter, transform_error
from cattrs.errors import BaseValidationError
from cattrs.gen import make_dict_structure_fn, make_dict_unstructure_fn

from soma_bullet.errors import InputError

T = TypeVar("T")
SCHEMA = 1  # of every file that this package writes
ALIKE = 0.5  # share of names of fields that a file and what it may hold must have in common
UNREADABLE = (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile)
VERSIONED = (
    "soma_bullet",
    "pybullet",
    "ompl",
    "numpy",
    "scipy",
    "highspy",
    "shapely",
    "pin",
    "coal",
    "eaik",
    "toppra",
    "trimesh",
)

_converter = Converter(forbid_extra_keys=True)
_is_array = lambda kind: kind is np.ndarray or get_origin(kind) is np.ndarray  # noqa: E731
_converter.register_unstructure_hook_func(_is_array, lambda array: array)
_converter.register_structure_hook_func(_is_array, lambda value, _: _frozen(value))
_converter.register_structure_hook(float, lambda value, _: float(value))


def register_family(base: Any, members: Mapping[str, Any]) -> None:
    """Let records hold values of any class of a family where `base` is asked for, each under its class's
    name.

    Args:
        members: the classes by name; more may come later.
    """

    def structure(tree: Any, _: Any) -> Any:
        if not isinstance(tree, dict) or tree.get("class") not in members:
            raise ValueError(f"is none of {', '.join(members)}")
        fields = {key: value for key, value in tree.items() if key != "class"}
        kind: Any = members[tree["class"]]
        return _plain_hook(kind, "structure")(fields, kind)

    def unstructure(value: Any) -> Any:
        kind: Any = type(value)
        return {"class": kind.__name__, **_plain_hook(kind, "unstructure")(value)}

    def belongs(kind: Any) -> bool:
        return isinstance(kind, type) and issubclass(kind, base)

    _converter.register_structure_hook_func(belongs, structure)
    _converter.register_unstructure_hook_func(belongs, unstructure)


def register_names(kind: type, members: Mapping[str, Any]) -> None:
    """Let records hold values of a class by their names alone."""
    _converter.register_unstructure_hook(kind, str)
    _converter.register_structure_hook(kind, lambda name, _: members[name])


@cache
def _plain_hook(kind: Any, way: str) -> Callable[..., Any]:
    """How one class of a family is turned into a tree, or made of one."""
    if way == "structure":
        return make_dict_structure_fn(kind, _converter, _cattrs_forbid_extra_keys=True)
    return make_dict_unstructure_fn(kind, _converter)


def _frozen(value: Any) -> np.ndarray:
    array = np.array(value if isinstance(value, np.ndarray) else _numbers(value))
    array.setflags(write=False)
    return array


def _numbers(value: Any) -> Any:
    if isinstance(value, list):
        return [_numbers(v) for v in value]
    return float(value) if value in ("inf", "-inf", "nan") else value


def to_tree(value: Any) -> Any:
    """Dicts, lists, numbers and strings (no arrays, no infinities) that stand for a dataclass."""
    return _plain(_converter.unstructure(value))


def _plain(node: Any) -> Any:
    if isinstance(node, dict):
        return {str(key): _plain(child) for key, child in node.items()}
    if isinstance(node, list | tuple | frozenset | set):
        return [_plain(child) for child in (sorted(node) if isinstance(node, frozenset | set) else node)]
    if isinstance(node, np.ndarray):
        return _plain(node.tolist())
    if isinstance(node, np.generic):
        return _plain(node.item())
    if isinstance(node, float) and not math.isfinite(node):
        return str(node)
    if isinstance(node, Path):
        return str(node)
    return node


def write_json(value: Any, path: Path) -> None:
    """Write a dataclass (or a tree) as indented JSON, keys in the order of the fields."""
    text = json.dumps({"schema": SCHEMA, **to_tree(value)}, indent=1, ensure_ascii=False, allow_nan=False)
    _replace(path, lambda file: Path(file).write_text(_compact(text) + "\n", encoding="utf-8"))


def write_text(text: str, path: Path) -> None:
    """Write a text."""
    _replace(path, lambda file: Path(file).write_text(text, encoding="utf-8"))


def _compact(text: str) -> str:
    """Innermost lists of numbers on one line."""
    return re.sub(r"\[\s+([^\[\]{}\"]*?)\s+\]", lambda m: "[" + re.sub(r"\s+", " ", m.group(1)) + "]", text)


def read_json(kind: type[T], path: Path) -> T:
    """Read a dataclass of `kind`. Raises InputError."""
    return _structure(kind, _json_tree(path), path)


def _json_tree(path: Path) -> Any:
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(str(path), f"cannot be read as JSON: {error}") from None


def write_npz(value: Any, path: Path) -> None:
    """Write a dataclass with its arrays binary and the rest as one JSON string; the same value gives the same
    bytes."""
    arrays: dict[str, np.ndarray] = {}

    def walk(node: Any) -> Any:
        if isinstance(node, dict):
            return {str(key): walk(child) for key, child in node.items()}
        if isinstance(node, list | tuple):
            return [walk(child) for child in node]
        if isinstance(node, np.ndarray):
            arrays[f"a{len(arrays):05d}"] = node
            return {"$array": f"a{len(arrays) - 1:05d}"}
        return _plain(node)

    tree = {"schema": SCHEMA, **walk(_converter.unstructure(value))}
    header = np.frombuffer(json.dumps(tree, allow_nan=False).encode(), np.uint8)

    def write(file: str) -> None:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=4) as archive:
            for name, array in {"header": header, **arrays}.items():
                info = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
                info.compress_type = zipfile.ZIP_DEFLATED
                with archive.open(info, "w", force_zip64=True) as stream:
                    np.lib.format.write_array(stream, np.ascontiguousarray(array), allow_pickle=False)

    _replace(path, write)


def read_npz(kind: type[T], path: Path) -> T:
    """Read a dataclass of `kind` from an npz of `write_npz`. Raises InputError."""
    return _structure(kind, _npz_tree(path), path)


def read_any(kinds: Sequence[type[Any]], path: Path) -> Any:
    """Read a dataclass of that of several kinds which a file holds, as JSON or npz, whatever its name.

    Raises:
        InputError: it holds none of them, or is damaged.
    """
    kind = kind_in(kinds, path)
    return read_npz(kind, path) if _is_archive(path) else read_json(kind, path)


def kind_in(kinds: Sequence[type[Any]], path: Path) -> type[Any]:
    """Which of several dataclasses a file holds, by the names of its fields. Raises InputError."""
    if _is_archive(path):
        tree = _header(path)
    else:
        tree = _json_tree(path)
    keys = set(tree) - {"schema"} if isinstance(tree, dict) else set()

    def likeness(kind: type[Any]) -> float:
        names = {field.name for field in fields(kind)}
        return len(names & keys) / len(names | keys)

    likely = max(kinds, key=likeness)
    if likeness(likely) < ALIKE:
        raise InputError(str(path), f"is none of {', '.join(kind.__name__ for kind in kinds)}")
    return likely


def _is_archive(path: Path) -> bool:
    try:
        with Path(path).open("rb") as stream:
            return stream.read(2) == b"PK"
    except OSError as error:
        raise InputError(str(path), f"cannot be read: {error.strerror}") from None


def _header(path: Path) -> Any:
    """The JSON of an npz of `write_npz`, without its arrays."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return json.loads(archive["header"].tobytes())
    except UNREADABLE as error:
        raise InputError(str(path), f"cannot be read as a file of this package: {error}") from None


def _npz_tree(path: Path) -> Any:
    """The tree of an npz of `write_npz`, its arrays in place."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        tree = json.loads(arrays.pop("header").tobytes())
    except UNREADABLE as error:
        raise InputError(str(path), f"cannot be read as a file of this package: {error}") from None

    def walk(node: Any) -> Any:
        if isinstance(node, dict):
            return (
                arrays[node["$array"]]
                if "$array" in node
                else {key: walk(child) for key, child in node.items()}
            )
        return [walk(child) for child in node] if isinstance(node, list) else node

    return walk(tree)


def _structure(kind: type[T], tree: Any, path: Path) -> T:
    if not isinstance(tree, dict) or tree.pop("schema", None) != SCHEMA:
        raise InputError(str(path), f"is not a schema-{SCHEMA} file of this package")
    try:
        return _converter.structure(tree, kind)
    except (BaseValidationError, ValueError, TypeError, KeyError) as error:
        raise InputError(
            str(path), [f"is not a {kind.__name__}: {line}" for line in transform_error(error)]
        ) from None


def _replace(path: Path, write: Callable[[str], Any]) -> None:
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    os.close(handle)
    try:
        write(temporary)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def package_versions() -> dict[str, str]:
    """Versions of this package and of those whose numbers a result depends on."""
    found = {}
    for name in VERSIONED:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found
