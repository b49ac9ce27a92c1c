"""Assembly files: TOML and meshes in, a checked `Assembly` out.

    name = "wall"
    unit = "mm"            # m, cm, mm or in: of every length in the file; there is no default

    [support]              # optional, as are both of its keys
    height = 0.0           # z of the plane that the assembly stands on
    friction = 0.5

    [defaults]             # optional, as are its keys: of every piece that does not say otherwise
    density = 700.0        # kg/m3
    friction = 0.5
    clearance = 0.1        # by how much every face of the real piece stands back from its mesh
    chamfer = 0.0          # by how much the edges of the real piece are cut, along both of their faces

    [advice]               # optional, as are its keys: how it is planned and judged, if nobody asks otherwise
    push = 1.0             # N; as --push, --disturbance, --stability, --analyzer and --tolerance-of
    analyzers = ["grounded"]
    tolerance_of = "rest"

    [[piece]]              # one for each; mesh_unit, color, density, friction, clearance, chamfer: optional
    name = "Z"
    mesh = "Z.obj"         # obj, stl, ply or glb; relative to this file
    mesh_unit = "mm"       # where it is not the file's unit
    color = "#f2c14e"      # or [0.95, 0.76, 0.31]
    goal = { position = [0.0, -18.5, 27.75], rpy_deg = [0.0, -90.0, 0.0] }   # or quat_wxyz = [...]

`rpy_deg` turns about the fixed axes x, then y, then z (as in URDF). A goal is the nominal pose, at which
faces that touch coincide: the gaps come from the clearances. All faults of a file are reported at once."""

from __future__ import annotations

import difflib
import hashlib
import json
import tomllib
from dataclasses import asdict
from pathlib import Path
from typing import Any

from soma_bullet.assembly.advice import Advice
from soma_bullet.assembly.checks import goal_faults, piece_faults
from soma_bullet.assembly.entries import UNITS, Faults, PieceEntry, goal_pose, parse_entries
from soma_bullet.assembly.mesh_file import read_mesh
from soma_bullet.assembly.model import Assembly, Support
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.errors import InputError
from soma_bullet.frames import readonly


def load_assembly(path_or_name: str | Path) -> Assembly:
    """The assembly of a file, or of one that comes with the package ("soma3", "soma/soma3").

    Raises:
        InputError: with every fault of the file.
    """
    path = find_assembly_file(path_or_name)
    faults: list[str] = []
    head, entries = parse_entries(_read(path), faults)
    if head is None:
        raise InputError(str(path), faults)
    pieces, goals, hashes = [], [], []
    for entry in entries:
        loaded = _collect(faults, _workpiece, entry, path.parent, UNITS[head.unit])
        goal = _collect(faults, goal_pose, entry, UNITS[head.unit])
        if loaded is not None and goal is not None:
            pieces.append(loaded[0])
            goals.append(goal)
            said = {key: value for key, value in asdict(entry).items() if key != "chamfer" or value}
            hashes.append(said | {"mesh": loaded[1]})
    content = {"name": head.name, "unit": head.unit, "support": asdict(head.support), "pieces": hashes}
    if head.advice != Advice():
        content["advice"] = asdict(head.advice)
    assembly = Assembly(
        name=head.name,
        pieces=tuple(pieces),
        goals=readonly(goals).reshape(-1, 4, 4),
        support=Support(head.support.height * UNITS[head.unit], head.support.friction),
        digest=hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest(),
        advice=head.advice,
    )
    # where a piece is missing, its neighbours would seem to float
    faults += goal_faults(assembly, whole=not faults)
    if faults:
        raise InputError(str(path), faults)
    return assembly


def find_assembly_file(path_or_name: str | Path) -> Path:
    """The path of an assembly file, given as a path or as the name of one in `meshes`.

    Raises:
        InputError: no such file, or several of the name; says where it looked and which names exist.
    """
    given = Path(path_or_name)
    if given.is_file():
        return given
    package = Path(__file__).resolve().parents[1]
    roots = [root for root in (package / "meshes", package.parent / "meshes") if root.is_dir()]
    known = {
        f"{file.parent.name}/{file.stem}": file
        for root in reversed(roots)
        for file in sorted(root.glob("*/*.toml"))
    }
    name = given.as_posix().removesuffix(".toml")
    found = [file for full, file in known.items() if name in (full, file.stem)]
    if len(found) == 1:
        return found[0]
    what = (
        "several have this name"
        if found
        else "is a folder, not a file"
        if given.is_dir()
        else "there is no such assembly"
    )
    tried = [given.absolute(), *(root / f"{name if '/' in name else f'*/{name}'}.toml" for root in roots)]
    near = (
        [] if found else difflib.get_close_matches(name, [*known, *(file.stem for file in known.values())], 1)
    )
    raise InputError(
        str(path_or_name),
        f"{what}; tried {', '.join(map(str, tried))}; names are {', '.join(known)}"
        + "".join(f"; did you mean {word!r}?" for word in near),
    )


def _read(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(str(path), f"cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(
            str(path), f"is not UTF-8 text (byte {error.start}); an assembly file is TOML"
        ) from error
    except tomllib.TOMLDecodeError as error:
        raise InputError(str(path), f"is not valid TOML: {error}") from error


def _collect(faults: list[str], function: Any, *arguments: Any) -> Any:
    """What the function returns; None, with its faults noted, where it raises them."""
    try:
        return function(*arguments)
    except Faults as error:
        faults += error.faults
        return None


def _workpiece(entry: PieceEntry, folder: Path, scale: float) -> tuple[Workpiece, str]:
    """The piece and its mesh file's hash. Raises Faults."""
    vertices, faces, digest = read_mesh(folder, entry.mesh, UNITS[entry.mesh_unit], f"piece {entry.name!r}")
    clearance = entry.clearance * scale
    piece = Workpiece(
        entry.name,
        vertices,
        faces,
        entry.density,
        entry.friction,
        clearance,
        entry.color,
        entry.chamfer * scale,
    )
    faults = tuple(piece_faults(piece))
    if faults:
        raise Faults(*faults)
    return piece, digest
