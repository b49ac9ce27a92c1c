"""Drawings: text, JSON and letters, and what is said of those that are none."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from soma_bullet.errors import InputError
from soma_bullet.figure.drawing import drawing_of, read_drawing
from soma_bullet.figure.pieces import PIECES, orientations, shape_of


def written(folder: Path, text: str, name: str = "drawn.txt") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_a_text_has_layers_from_the_bottom_up(tmp_path: Path) -> None:
    drawing = read_drawing(written(tmp_path, "\n##\n# \n\n  \n.#\n\n"))
    assert drawing.name == "drawn" and drawing.packing is None
    assert drawing.cells == ((0, 0, 0), (0, 1, 0), (1, 0, 0), (1, 0, 1))


def test_spaces_in_front_of_a_row_are_empty_cells_and_the_figure_is_moved_to_the_corner(
    tmp_path: Path,
) -> None:
    assert read_drawing(written(tmp_path, "   #\r\n   #\r\n")).cells == ((0, 0, 0), (0, 1, 0))


def test_json_with_one_figure_and_with_several(tmp_path: Path) -> None:
    one = {"layers_bottom_up": [["##"], [".#"]]}
    alone = read_drawing(written(tmp_path, json.dumps(one), "corner.json"))
    assert alone.name == "corner" and alone.cells == ((0, 0, 0), (1, 0, 0), (1, 0, 1))
    several = written(tmp_path, json.dumps({"a": one, "b": {"layers_bottom_up": [["###"]]}}), "many.json")
    for drawing in (read_drawing(several, "b"), read_drawing(f"{several}:b")):
        assert drawing.name == "b" and drawing.cells == ((0, 0, 0), (1, 0, 0), (2, 0, 0))
    with pytest.raises(InputError, match="has several figures; give --name; there are a, b"):
        read_drawing(several)
    with pytest.raises(InputError, match="has no figure 'c'; there are a, b"):
        read_drawing(several, "c")


def test_letters_and_numbers_say_the_packing() -> None:
    layers = [["LLL", "LVV"], ["...", "..V"]]
    numbers = [[row.replace("L", "2").replace("V", "1") for row in rows] for rows in layers]
    wanted = (("V", ((1, 1, 0), (2, 1, 0), (2, 1, 1))), ("L", ((0, 0, 0), (0, 1, 0), (1, 0, 0), (2, 0, 0))))
    assert drawing_of(layers, "x").packing == drawing_of(numbers, "x").packing == wanted


@pytest.mark.parametrize("letter", PIECES)
def test_every_piece_is_known_however_it_is_turned(letter: str) -> None:
    assert {shape_of(cells) for cells in orientations(PIECES[letter])} == {letter}


def test_one_character_is_a_drawing_unless_it_is_that_piece() -> None:
    assert drawing_of([["VVV"]], "x").packing is None
    assert drawing_of([["VV", "V."]], "x").packing is not None


@pytest.mark.parametrize(
    ("layers", "message"),
    [
        ([["TT", "T."], ["VV", "V."]], r"letter 'T': its cells form V, not T|has 3 cells, and T has 4"),
        ([["VVV", "#.."]], r"letter 'V': is no piece .*'#' is the letter of no piece; there are V, L"),
        ([["VV", "V.", "LL", "LL"]], r"letter 'L': is no piece \(cells x 0 y 2 z 0"),
        ([["AAV", "AVV"], ["...", "A.."]], r"letter 'A': its cells form B, which is A mirrored"),
        ([["1V", "11"], ["VV", ".."]], r"1 stands|V stands for two pieces"),
        ([["....", "    "]], r"has no cells: every character but a space and a dot is one"),
        ([["#\t#"]], r"layer 1, row 1, column 2: '\\t' is no character of a drawing"),
    ],
)
def test_what_is_wrong_is_named(layers: list[list[str]], message: str) -> None:
    with pytest.raises(InputError) as refused:
        drawing_of(layers, "x")
    assert re.search(message, " ".join(str(refused.value).split())), refused.value


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"layers_bottom_up": [', "is not valid JSON"),
        ('{"layers_bottom_up": ["##"]}', "a list of layers, each a list of rows"),
        ('{"a": 3}', "a list of layers, each a list of rows"),
    ],
)
def test_json_that_is_no_figure(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        read_drawing(written(tmp_path, text, "bad.json"))


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read: No such file"):
        read_drawing(tmp_path / "none.txt")
    (tmp_path / "bytes").write_bytes(b"\xff\xfe#")
    with pytest.raises(InputError, match="is not UTF-8 text"):
        read_drawing(tmp_path / "bytes")
