"""Records: to a file and back without loss, the same bytes for the same value, whole or not at all."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from soma_bullet.errors import InputError
from soma_bullet.frames import Array, readonly
from soma_bullet.records import (
    VERSIONED,
    package_versions,
    read_json,
    read_npz,
    to_tree,
    write_json,
    write_npz,
)


@dataclass(frozen=True, eq=False)
class Leaf:
    name: str
    array: Array
    pair: tuple[float, float] | None


@dataclass(frozen=True, eq=False)
class Tree:
    leaves: tuple[Leaf, ...]
    value: float
    count: dict[str, int]
    held: tuple[tuple[str, ...], ...]


def tree() -> Tree:
    full = Leaf("ä", readonly([[0.1, 1 / 3], [math.inf, -2e-17]]), (1.0, math.inf))
    leaves = (full, Leaf("empty", readonly(np.zeros((0, 7))), None))
    return Tree(leaves, math.inf, {"a": 1}, (("x",), (), ("y", "z")))


def same(a: Tree, b: Tree) -> bool:
    arrays = all(
        np.array_equal(p.array, q.array) for p, q in zip(a.leaves, b.leaves, strict=True) if p.array.size
    )
    return arrays and [(p.name, p.pair) for p in a.leaves] == [(p.name, p.pair) for p in b.leaves] and (
        (a.value, a.count, a.held) == (b.value, b.count, b.held)
    )  # fmt: skip


@pytest.mark.parametrize(("write", "read"), [(write_json, read_json), (write_npz, read_npz)])
def test_round_trip(tmp_path: Path, write: object, read: object) -> None:
    for name in ("one", "two"):
        write(tree(), tmp_path / name)  # type: ignore[operator]
    again = read(Tree, tmp_path / "one")  # type: ignore[operator]
    assert same(again, tree())
    assert not again.leaves[0].array.flags.writeable
    write(again, tmp_path / "three")  # type: ignore[operator]
    assert (
        (tmp_path / "one").read_bytes()
        == (tmp_path / "two").read_bytes()
        == (tmp_path / "three").read_bytes()
    )


def test_npz_keeps_the_shape_of_empty_arrays(tmp_path: Path) -> None:
    write_npz(tree(), tmp_path / "t.npz")
    assert read_npz(Tree, tmp_path / "t.npz").leaves[1].array.shape == (0, 7)


def test_json_is_strict_and_readable(tmp_path: Path) -> None:
    write_json(tree(), tmp_path / "t.json")
    text = (tmp_path / "t.json").read_text(encoding="utf-8")
    content = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert content["value"] == "inf" and content["schema"] == 1
    assert "ä" in text
    assert "[0.1, 0.3333333333333333]" in text


def test_no_half_files(tmp_path: Path) -> None:
    write_json(tree(), tmp_path / "t.json")
    before = (tmp_path / "t.json").read_bytes()
    with pytest.raises(TypeError):
        write_json({"bad": object()}, tmp_path / "t.json")
    assert (tmp_path / "t.json").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["t.json"]


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("{", "cannot be read as JSON"),
        ("[]", "not a schema-1 file"),
        ('{"schema": 2}', "not a schema-1 file"),
        (
            '{"schema": 1, "leaves": [], "value": 1, "count": {}, "held": [], "more": 1}',
            "is not a Tree.*more",
        ),
        ('{"schema": 1, "leaves": [], "value": "x", "count": {}, "held": []}', "is not a Tree.*value"),
        ('{"schema": 1, "leaves": []}', "is not a Tree"),
    ],
)
def test_a_wrong_file_is_an_input_error(tmp_path: Path, text: str, fault: str) -> None:
    (tmp_path / "t.json").write_text(text)
    with pytest.raises(InputError, match=f"(?s){fault}"):
        read_json(Tree, tmp_path / "t.json")
    with pytest.raises(InputError, match="cannot be read"):
        read_npz(Tree, tmp_path / "t.json")
    with pytest.raises(InputError, match="cannot be read"):
        read_json(Tree, tmp_path / "none.json")


def test_numpy_and_paths_become_plain() -> None:
    plain = to_tree({"a": np.float64(1.5), "b": np.arange(2), "c": Path("x"), "d": frozenset({"z", "y"})})
    assert plain == {"a": 1.5, "b": [0, 1], "c": "x", "d": ["y", "z"]}


def test_versions_name_what_numbers_depend_on() -> None:
    versions = package_versions()
    assert tuple(versions) == VERSIONED
    assert versions["numpy"] == np.__version__


def test_a_message_lists_the_first_faults_and_counts_the_rest() -> None:
    error = InputError("file", [f"fault {k}" for k in range(50)])
    lines = str(error).splitlines()
    assert lines[0] == "file: 50 faults" and lines[-1].strip() == "and 30 more" and len(lines) == 22
    assert len(error.faults) == 50
    assert "more" not in str(InputError("file", ["one", "two"]))
