"""Drawings of figures: text or JSON, in which every character but a space and a dot is a cell.

A drawing has layers from the bottom up, with blank lines between them in a text; rows go along y, and the
characters of a row along x. Where every cell carries the letter (or the number, 1 to 7) of a piece, and the
cells of each letter form that piece, the drawing is a packing too."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from soma_bullet.errors import InputError
from soma_bullet.figure.pieces import PIECES, Cells, at_origin, shape_of

EMPTY = " ."
NUMBERS = dict(zip("1234567", PIECES, strict=True))  # as the pieces of the Soma cube are numbered
LAYERS = "layers_bottom_up"
MIRRORED = {"A": "B", "B": "A"}
MOST_CELLS = 4096  # of a drawing; no box of seven pieces comes near


@dataclass(frozen=True)
class Drawing:
    """A figure as it was drawn.

    Attributes:
        name: for people and folders.
        cells: that are to be filled, sorted, with the lowest corner at the origin.
        packing: letter of each piece, with its cells, where the drawing says so.
    """

    name: str
    cells: Cells
    packing: tuple[tuple[str, Cells], ...] | None = None


def read_drawing(source: str | Path, name: str | None = None) -> Drawing:
    """The figure of a file.

    Args:
        source: a text, or JSON as `{"layers_bottom_up": [["##", ...], ...]}` or `{"name": {...}, ...}`; as
            FILE:NAME one figure of several.
        name: the same as a NAME.

    Raises:
        InputError: with every fault of the drawing.
    """
    path, chosen = Path(source), name
    if not path.is_file() and ":" in str(source):
        file, _, last = str(source).rpartition(":")
        if Path(file).is_file():
            path, chosen = Path(file), last
            if name not in (None, last):
                raise InputError(str(source), f"names the figure {last!r}, and --name {name!r}")
    text = _text(path)
    if text.lstrip().startswith("{"):
        called, layers = _of_json(text, path, chosen)
    else:
        called, layers = chosen or path.stem, _layers(text)
    return drawing_of(layers, chosen or called, str(source))


def drawing_of(layers: list[list[str]], name: str, source: str = "drawing") -> Drawing:
    """The figure of layers from the bottom up, each a list of rows. Raises InputError; `source` is what its
    message begins with."""
    if not name or not name.isprintable() or "/" in name or name in (".", ".."):
        raise InputError(source, f"the figure's name {name!r} must be one of a folder")
    marks = {
        (x, y, z): mark
        for z, rows in enumerate(layers)
        for y, row in enumerate(rows)
        for x, mark in enumerate(row)
        if mark not in EMPTY
    }
    faults = [
        f"layer {z + 1}, row {y + 1}, column {x + 1}: {mark!r} is no character of a drawing; a cell is any "
        "that can be seen, and empty are a space and a dot"
        for (x, y, z), mark in marks.items()
        if not mark.isprintable()
    ]
    if not marks:
        faults = ["has no cells: every character but a space and a dot is one"]
    if len(marks) > MOST_CELLS:
        faults = [f"has {len(marks)} cells, and must have at most {MOST_CELLS}"]
    if faults:
        raise InputError(source, faults)
    cells = tuple(sorted(marks))
    corner = [min(cell[axis] for cell in cells) for axis in range(3)]
    place = {cell: (cell[0] - corner[0], cell[1] - corner[1], cell[2] - corner[2]) for cell in cells}
    groups: dict[str, list[Any]] = {}
    for cell in cells:
        groups.setdefault(marks[cell], []).append(place[cell])
    found = {mark: tuple(sorted(group)) for mark, group in groups.items()}
    wrong = [fault for mark, group in found.items() if (fault := _letter_fault(mark, group))]
    packing = None
    if not wrong:
        pieces = [(_letter(mark), group) for mark, group in found.items()]
        letters = [letter for letter, _ in pieces]
        wrong = [
            f"{letter} stands for two pieces" for letter in sorted(set(letters)) if letters.count(letter) > 1
        ]
        packing = tuple(sorted(pieces, key=lambda piece: (list(PIECES).index(piece[0]), piece[1])))
    if wrong and len(found) > 1:
        hint = f"a drawing without letters has one character for every cell, this one has {len(found)}"
        raise InputError(source, [*wrong, hint])
    return Drawing(re.sub(r"[^\w.-]+", "_", name), at_origin(cells), packing)  # as assemblies are called


def _letter(mark: str) -> str:
    """The piece that a character stands for; empty where it stands for none."""
    letter = NUMBERS.get(mark, mark.upper())
    return letter if letter in PIECES else ""


def _letter_fault(mark: str, cells: Cells) -> str:
    """What is wrong with the cells of a character, if it is to be the letter of a piece."""
    letter, shape = _letter(mark), shape_of(cells)
    if not letter:
        return f"{mark!r} is the letter of no piece; there are {', '.join(PIECES)}, or 1 to 7"
    if shape == letter:
        return ""
    called = f"letter {mark!r}" if mark == letter else f"{mark!r}, which is {letter}"
    if shape is None:
        size = len(PIECES[letter])
        what = f"has {len(cells)} cells, and {letter} has {size}" if len(cells) != size else "is no piece"
        return f"{called}: {what} ({_listed(cells)})"
    if MIRRORED.get(letter) == shape:
        return f"{called}: its cells form {shape}, which is {letter} mirrored; pieces are turned only"
    return f"{called}: its cells form {shape}, not {letter}"


def _listed(cells: Cells) -> str:
    shown = ", ".join(f"x {x} y {y} z {z}" for x, y, z in cells[:6])
    return f"cells {shown}" + (" ..." if len(cells) > 6 else "")


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(str(path), f"cannot be read: {error.strerror}; a drawing is a file") from error
    except UnicodeDecodeError as error:
        raise InputError(str(path), f"is not UTF-8 text (byte {error.start})") from error


def _layers(text: str) -> list[list[str]]:
    """Layers of a text: runs of lines that are not blank."""
    layers: list[list[str]] = [[]]
    for line in text.split("\n"):
        row = line.rstrip("\r")
        if row.strip(" "):
            layers[-1].append(row)
        elif layers[-1]:
            layers.append([])
    return [layer for layer in layers if layer]


def _of_json(text: str, path: Path, chosen: str | None) -> tuple[str, list[list[str]]]:
    """Name and layers of the figure of a JSON file. Raises InputError."""
    try:
        tree = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputError(str(path), f"is not valid JSON: {error}") from error
    figures = {path.stem: tree} if LAYERS in tree else tree
    name = chosen
    if LAYERS in tree:
        name = path.stem
    elif name is None and len(figures) == 1:
        name = next(iter(figures))
    if name is None or name not in figures:
        said = "has several figures; give --name" if name is None else f"has no figure {name!r}"
        raise InputError(str(path), f"{said}; there are {', '.join(figures) or 'none'}")
    figure = figures[name]
    layers = figure.get(LAYERS) if isinstance(figure, Mapping) else None
    rows = isinstance(layers, list) and all(
        isinstance(layer, list) and all(isinstance(row, str) for row in layer) for layer in layers
    )
    if not rows or layers is None:
        raise InputError(str(path), f'{name}: must have "{LAYERS}", a list of layers, each a list of rows')
    return name, layers
