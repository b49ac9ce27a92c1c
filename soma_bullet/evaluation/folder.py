"""The folder of an evaluation: a line for each episode, in the order of seeds, and the summary."""

from __future__ import annotations

import fcntl
import json
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from soma_bullet.errors import InputError
from soma_bullet.evaluation.line import FIXED_VERSIONS, Line
from soma_bullet.evaluation.options import EvaluationOptions
from soma_bullet.records import package_versions

LINES, SUMMARY = "episodes.jsonl", "summary.json"


@contextmanager
def alone(out: Path) -> Iterator[None]:
    """Keep a second evaluation out of the folder while the block runs."""
    folder = os.open(out, os.O_RDONLY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError("--out", f"another evaluation is writing into {out}") from None
        yield
    finally:
        os.close(folder)


def check_lines(lines: Iterable[Line], options: EvaluationOptions, digest: str, out: Path) -> None:
    """Refuse a folder whose lines were made under other conditions; says which, and both values."""
    here, versions = options.conditions(), package_versions()
    for line in lines:
        there = line.get("options", {})
        if not {"digest", "options", "versions"} <= line.keys():
            raise InputError(
                str(out / LINES), "was written by an older version of this package; choose another --out"
            )
        faults = []
        if line["digest"] != digest:
            before, now = f"{line['assembly']} ({line['digest'][:12]})", f"{options.assembly} ({digest[:12]})"
            faults.append(f"assembly: {before} there, {now} here")
        faults += [
            f"{name}: {there.get(name, 'not given')} there, {here.get(name, 'not given')} here"
            for name in dict.fromkeys([*here, *there])
            if there.get(name) != here.get(name) and (name in here) is (name in there)
        ]
        faults += [
            f"version of {name}: {line['versions'].get(name)} there, {versions[name]} here"
            for name in FIXED_VERSIONS
            if line["versions"].get(name) != versions[name]
        ]
        if faults:
            raise InputError(str(out), [f"{fault}; choose another --out" for fault in faults])


def make_folder(out: Path) -> None:
    """Make the folder, and see that it can be written. Raises InputError."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise InputError("--out", f"{out} cannot be written: {error.strerror}") from None


def read_lines(file: Path) -> list[Line]:
    """The lines of an evaluation, the later one where a seed has two; what an interruption cut off is left
    out."""
    if not file.is_file():
        return []
    found: dict[int, Line] = {}
    for text in file.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            line = json.loads(text)
        except json.JSONDecodeError:
            continue
        if isinstance(line, dict) and isinstance(line.get("seed"), int):
            found[line["seed"]] = line
    return [found[seed] for seed in sorted(found)]


def _text(line: Line) -> str:
    return json.dumps(line, ensure_ascii=False) + "\n"


def write_lines(file: Path, lines: dict[int, Line]) -> None:
    """All lines, in the order of seeds; no file where there are none."""
    if lines:
        _write_text(file, "".join(_text(lines[seed]) for seed in sorted(lines)))


def append_line(stream: TextIO, line: Line) -> None:
    """One more, at once."""
    stream.write(_text(line))
    stream.flush()


def write_summary(out: Path, summary: dict[str, Any]) -> None:
    """The summary, in its folder."""
    _write_text(out / SUMMARY, json.dumps(summary, indent=1, ensure_ascii=False) + "\n")


def _write_text(file: Path, text: str) -> None:
    """Whole or not at all."""
    scratch = file.with_name(f".{file.name}.{os.getpid()}")
    try:
        scratch.write_text(text, encoding="utf-8")
        os.replace(scratch, file)
    finally:
        scratch.unlink(missing_ok=True)
