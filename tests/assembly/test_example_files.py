"""The example assemblies: each loads, is made of exact parts, and comes from its script byte for byte."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from soma_bullet.assembly.contacts import SUPPORT
from soma_bullet.assembly.file import load_assembly

ROOT = Path(__file__).resolve().parents[2]
MESHES = ROOT / "meshes"
FILES = sorted(MESHES.glob("*/*.toml"))
FORMATS = {".obj", ".stl", ".ply", ".glb"}
# total volume [cm3]; round pieces have that of their prisms
VOLUMES = {
    "arch": 83.11,
    "bracket": 59.92,
    "burr": 110.81,
    "crate": 134.62,
    "dominoes": 148.80,
    "dovetail": 90.91,
    "dowel": 66.36,
    "gears": 82.84,
    "hinge": 76.32,
    "leaning_bridge": 85.80,
    "leonardo": 68.26,
    "sliding_lid": 125.94,
    "stool": 80.40,
    "tower": 114.89,
    "wedge_clamp": 190.35,
    "soma3": 69.65,
    "soma4": 94.97,
    "cube": 170.95,
}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_example_loads_and_is_made_of_exact_parts(path: Path) -> None:
    assembly = load_assembly(path)
    assert assembly.name == path.stem
    for piece in assembly.pieces:
        assert piece.decomposition.kind != "approximate", piece.name
        assert piece.decomposition.volume_ratio == pytest.approx(1.0, abs=1e-6)
        assert piece.decomposition.deviation == 0.0
    volume = sum(float(piece.mesh.volume) for piece in assembly.pieces) * 1e6
    assert volume == pytest.approx(VOLUMES[path.stem], rel=1e-3)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_piece_of_an_example_touches_what_carries_it(path: Path) -> None:
    assembly = load_assembly(path)
    touched = {body for contact in assembly.contacts for body in (contact.body_a, contact.body_b)}
    assert touched == {SUPPORT, *range(len(assembly.pieces))}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_examples_are_sized_for_the_hand(path: Path) -> None:
    """Each piece has a side that a hand of 77 mm can take, and none is larger than two arms can turn over a
    table."""
    for piece in load_assembly(path).pieces:
        extents = np.sort(np.ptp(piece.vertices, axis=0))
        assert extents[0] < 0.077 and extents[2] < 0.12


def test_the_examples_use_every_format_and_every_unit() -> None:
    assert {path.suffix for path in MESHES.rglob("*.*")} - {".toml"} == FORMATS
    units = {
        line.split('"')[1]
        for path in FILES
        for line in path.read_text().splitlines()
        if line.startswith("unit = ")
    }
    assert units == {"m", "cm", "mm", "in"}


def test_the_script_writes_the_same_bytes(tmp_path: Path) -> None:
    spec = importlib.util.spec_from_file_location(
        "generate_examples", ROOT / "scripts" / "generate_examples.py"
    )
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    script.main(tmp_path)
    kept = {
        path.relative_to(MESHES): path.read_bytes() for path in MESHES.rglob("*.*") if path.suffix in FORMATS
    }
    kept = {name: content for name, content in kept.items() if name.parts[0] != "soma"}
    written = {path.relative_to(tmp_path): path.read_bytes() for path in tmp_path.rglob("*.*")}
    assert sorted(written) == sorted(kept)
    assert [str(name) for name in written if written[name] != kept[name]] == []
