"""Reads a cell, `robots/<cell>/cell.toml`, with its arms and hands.

A further cell is a further folder.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from importlib import util
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from soma_bullet.errors import InputError
from soma_bullet.frames import make_transform, readonly, rotation_about
from soma_bullet.grasp.hand import Hand, load_hand
from soma_bullet.robot.model import Arm, ArmModel, Cell, MeshSwap, Slab
from soma_bullet.toml_fields import Fields, read_toml


def cell_folders() -> list[Path]:
    """Where cells are looked for by name: the installed package, then the checkout."""
    spec = util.find_spec(
        "soma_bullet.robots"
    )  # data without an __init__: a namespace package, with a list of places
    folders = [Path(place) for place in (spec.submodule_search_locations or ())] if spec is not None else []
    return [*folders, Path(__file__).resolve().parents[2] / "robots"]


def _find_cell(name_or_path: str | Path) -> Path:
    given = Path(name_or_path)
    tried = [given, given / "cell.toml", *(folder / given / "cell.toml" for folder in cell_folders())]
    for path in tried:
        if path.is_file():
            return path.resolve()
    names = sorted({path.parent.name for folder in cell_folders() for path in folder.glob("*/cell.toml")})
    raise InputError(
        str(name_or_path),
        f"no such cell; tried {', '.join(map(str, tried))}; known cells: {', '.join(names) or 'none'}",
    )


def find_hand(name_or_path: str | Path) -> Hand:
    """The hand of a hand.toml, of a folder that has one, or of a cell's name under `robots/`; nothing else of
    the cell is read.

    Raises:
        InputError: there is none, or with every fault of the file.
    """
    given = Path(name_or_path)
    tried = [given, given / "hand.toml", *(folder / given / "hand.toml" for folder in cell_folders())]
    for path in tried:
        if path.is_file():
            return load_hand(path.resolve())
    names = sorted({path.parent.name for folder in cell_folders() for path in folder.glob("*/hand.toml")})
    raise InputError(
        str(name_or_path),
        f"no such hand; tried {', '.join(map(str, tried))}; known hands: {', '.join(names) or 'none'}",
    )


def load_cell(name_or_path: str | Path) -> Cell:
    """The cell of a name under `robots/`, of a folder, or of a cell.toml.

    Raises:
        InputError: with every fault of the file.
    """
    path = _find_cell(name_or_path)
    faults: list[str] = []
    fields = Fields(read_toml(path), faults)
    fields.schema()
    scale = fields.unit()
    name = fields.text("name")

    models_table = fields.table("arm_models")
    models = {key: _read_model(key, models_table.table(key), path, scale) for key in models_table.keys()}
    arms = []
    for i, item in enumerate(fields.items("arms", "a list of tables, one an arm")):
        if not isinstance(item, dict):
            faults.append(f"arms[{i}] = {item!r}: must be a table")
            continue
        arm = _read_arm(Fields(item, faults, f"arms[{i}]."), models, path, scale)
        arms += [arm] if arm else []
    arm_names = [arm.name for arm in arms]
    faults += [
        f"arms: two of them are called {n!r}" for n in sorted(set(arm_names)) if arm_names.count(n) > 1
    ]

    table, stand, feed, collision = (fields.table(key) for key in ("table", "stand", "feed", "collision"))
    slab = Slab(
        readonly(table.numbers("size", (3,)) * scale),
        readonly(table.numbers("centre", (2,)) * scale),
        _colour(table, "colour"),
    )
    height, centre = stand.number("height") * scale, readonly(stand.numbers("centre", (2,)) * scale)
    stand_colour = _colour(stand, "colour")
    areas = readonly(feed.numbers("areas", (-1, 2, 2)) * scale)
    if (areas[..., 0] >= areas[..., 1]).any():
        faults.append("feed.areas: each is [[x_min, x_max], [y_min, y_max]] with min below max")
    pairs = _read_pairs(collision, arm_names)
    for part in (fields, table, stand, feed, collision):
        part.close()
    if faults:
        raise InputError(str(path), faults)
    return Cell(name, path, tuple(arms), slab, height, centre, stand_colour, areas, pairs)


def _colour(fields: Fields, key: str) -> tuple[float, ...]:
    rgb = fields.numbers(key, (3,))
    if ((rgb < 0) | (rgb > 1)).any():
        fields.faults.append(f"{key} = {rgb.tolist()}: a colour is three numbers from 0 to 1")
    return tuple(float(c) for c in rgb)


def _read_pairs(collision: Fields, arm_names: list[str]) -> tuple[tuple[str, str], ...]:
    pairs: list[tuple[str, str]] = []
    for pair in collision.items("never_checked", "a list of pairs of links"):
        if not (isinstance(pair, list) and len(pair) == 2 and all(isinstance(link, str) for link in pair)):
            collision.faults.append(f"collision.never_checked: {pair!r} is not a pair of links")
            continue
        wild = any("*" in link for link in pair)
        for name in arm_names if wild else [""]:
            pairs.append((pair[0].replace("*", name), pair[1].replace("*", name)))
    return tuple(pairs)


def _read_model(name: str, fields: Fields, path: Path, scale: float) -> ArmModel | None:
    faults = fields.faults
    before = len(faults)
    urdf = _package_file(fields.text("package", ""), fields.text("path"), path, faults)
    base, tool = fields.text("base"), fields.text("tool")
    joints = fields.texts("joints")
    acceleration = fields.numbers("acceleration", (len(joints) or -1,))
    if (acceleration <= 0).any():
        faults.append(f"arm_models.{name}.acceleration must be positive")
    swaps = {}
    for kind in ("collision", "visual"):
        table = fields.table(kind, optional=True)
        swaps[kind] = {link: _read_swap(table.table(link), urdf, scale) for link in table.keys()}
    colours_table = fields.table("colours", optional=True)
    colours = {link: _colour(colours_table, link) for link in colours_table.keys()}
    fields.close()
    if len(faults) > before or urdf is None:
        return None
    robot = parse_urdf(urdf)
    links, joint_map = {link.name for link in robot.links}, {joint.name: joint for joint in robot.joints}
    for link in (base, tool, *swaps["collision"], *swaps["visual"], *colours):
        if link not in links:
            faults.append(
                f"arm_models.{name}: {link!r} is not a link of {urdf.name}; it has {', '.join(sorted(links))}"
            )
    faults += [f"arm_models.{name}.joints: {joint!r} is not a joint with limits in {urdf.name}"
               for joint in joints if joint not in joint_map or joint_map[joint].limit is None]  # fmt: skip
    if len(faults) > before:
        return None
    lower, upper, velocity, effort = (
        readonly([getattr(joint_map[joint].limit, key) for joint in joints])
        for key in ("lower", "upper", "velocity", "effort")
    )
    return ArmModel(
        name, urdf, base, tool, joints, lower, upper, velocity, readonly(acceleration), effort,
        swaps["collision"], swaps["visual"], colours,
    )  # fmt: skip


def _read_swap(fields: Fields, urdf: Path | None, scale: float) -> MeshSwap:
    origin = None
    if "origin" in fields:
        table = fields.table("origin")
        rotation = Rotation.from_euler(
            "xyz", np.nan_to_num(table.numbers("rpy_deg", (3,))), degrees=True
        ).as_matrix()
        origin = readonly(make_transform(rotation, table.numbers("xyz", (3,)) * scale))
        table.close()
    meshes = (
        tuple(mesh_file(mesh, urdf.parent, fields.faults) for mesh in fields.texts("meshes")) if urdf else ()
    )
    fields.close()
    return MeshSwap(meshes, origin)


def _read_arm(fields: Fields, models: Mapping[str, ArmModel | None], path: Path, scale: float) -> Arm | None:
    faults = fields.faults
    name, model_name = fields.text("name"), fields.text("model")
    if model_name and model_name not in models:
        faults.append(
            f"arm {name}: model {model_name!r} is not among arm_models: {', '.join(models) or 'none'}"
        )
    base = fields.table("base")
    xyz, yaw = base.numbers("xyz", (3,)) * scale, np.deg2rad(base.number("yaw_deg", positive=False))
    base.close()
    hand: Hand | None = None
    try:
        hand = load_hand(path.parent / fields.text("hand"))
    except InputError as error:
        faults += [f"arm {name}: hand: {fault} ({error.source})" for fault in error.faults]
    model = models.get(model_name)
    home = np.deg2rad(fields.numbers("home_deg", (len(model.joints) if model else -1,)))
    fields.close()
    if model is None or hand is None:
        return None
    for joint, q, low, high in zip(model.joints, home, model.lower, model.upper, strict=False):
        if not low <= q <= high and not np.isnan(q):
            faults.append(f"arm {name}: home_deg of {joint} = {np.rad2deg(q):g} is outside "
                          f"[{np.rad2deg(low):g}, {np.rad2deg(high):g}]")  # fmt: skip
    T_world_base = make_transform(rotation_about((0, 0, 1), yaw), xyz)
    return Arm(name, model, hand, readonly(T_world_base), readonly(home))


def _package_file(package: str, file: str, path: Path, faults: list[str]) -> Path | None:
    """A file of an installed package, or beside the cell's file."""
    if not package:
        found: Path = path.parent / file
    else:
        spec = util.find_spec(package) if package.isidentifier() else None
        if spec is None or not spec.submodule_search_locations:
            faults.append(f"package {package!r} is not installed")
            return None
        found = Path(next(iter(spec.submodule_search_locations))) / file
    if not found.is_file():
        faults.append(f"path: no file {found}")
        return None
    return found.resolve()


def mesh_file(mesh: str, folder: Path, faults: list[str]) -> Path:
    """The absolute path of a mesh that a URDF in `folder` names; `package://a/b` is looked up as package and
    as folder."""
    tried = [folder / mesh]
    if mesh.startswith("package://"):
        package, _, rest = mesh.removeprefix("package://").partition("/")
        spec = util.find_spec(package) if package.isidentifier() else None
        roots = [Path(p) for p in (spec.submodule_search_locations or ())] if spec else []
        tried = (
            [root / rest for root in roots]
            + [parent / package / rest for parent in folder.parents]
            + [folder / rest]
        )
    for file in tried:
        if file.is_file():
            return file.resolve()
    faults.append(f"mesh {mesh!r} not found; tried {', '.join(map(str, tried))}")
    return tried[0]


def parse_urdf(urdf: Path) -> Any:
    """The yourdfpy `Robot` of a file."""
    import yourdfpy

    # Drake's attributes have no declared namespace, which an XML parser refuses.
    text = re.sub(r'\sdrake:\w+="[^"]*"', "", urdf.read_text(encoding="utf-8"))
    try:
        return yourdfpy.URDF.load(io.BytesIO(text.encode()), build_scene_graph=False, load_meshes=False).robot
    except Exception as error:  # yourdfpy passes on whatever its XML library raises
        raise InputError(str(urdf), f"cannot be read as URDF: {error}") from None
