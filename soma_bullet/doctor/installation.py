"""Checks of the installation: the interpreter, and every package that is needed."""

from __future__ import annotations

import importlib
import platform
import re
import sys
import time
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

from soma_bullet.doctor.finding import AGAIN, Finding, said

PACKAGE = "soma_bullet"
PYTHON = (3, 11)
# what is imported of a distribution, where that is not its name
MODULES = {
    "eaik": "eaik.IK_HP",
    "embreex": "embreex.mesh_construction",
    "ompl": "ompl.geometric",
    "pillow": "PIL",
    "pin": "pinocchio",
    "pybullet": "soma_bullet.bullet.quiet",  # which keeps it from talking
}


def check_python() -> Iterator[Finding]:
    """The interpreter."""
    good = sys.version_info[:2] == PYTHON and platform.python_implementation() == "CPython"
    says = f"{platform.python_implementation()} {platform.python_version()}, {sys.prefix}"
    advice = (
        "" if good else "pybullet has wheels for CPython 3.11 alone: make a virtual environment with that"
    )
    yield Finding("python", "good" if good else "bad", says, advice)


def check_packages() -> Iterator[Finding]:
    """Every dependency: is it there, of a version that serves, and does it load?"""
    try:
        wanted = metadata.requires(PACKAGE) or []
        yield Finding(PACKAGE, "good", f"{metadata.version(PACKAGE)}, {Path(__file__).parents[1]}")
    except metadata.PackageNotFoundError:
        yield Finding(PACKAGE, "bad", "is not installed", "in the checkout: pip install --editable .")
        return
    for requirement in wanted:
        if "extra ==" in requirement.replace('"', "'").replace("extra==", "extra =="):
            continue
        name = re.match(r"[\w.-]+", requirement)
        if name is not None:
            yield _package(name.group(), requirement)


def _package(name: str, requirement: str) -> Finding:
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        return Finding(name, "bad", "is not installed", f"pip install '{requirement}'")
    if not serves(version, requirement):
        return Finding(
            name, "bad", f"{version} does not serve: {requirement} is needed", f"pip install '{requirement}'"
        )
    start = time.perf_counter()
    try:
        importlib.import_module(MODULES.get(name, name.replace("-", "_")))
    except Exception as error:
        return Finding(name, "bad", f"{version} does not load: {said(error)}", f"{AGAIN} '{requirement}'")
    return Finding(name, "good", f"{version}, loads in {time.perf_counter() - start:.1f} s")


def serves(version: str, requirement: str) -> bool:
    """Whether a version keeps the bounds (>=, >, <=, <) of a requirement; bounds of other kinds are taken as
    kept."""
    has = _numbers(version)
    tests = {">=": has.__ge__, ">": has.__gt__, "<=": has.__le__, "<": has.__lt__}
    bounds = re.findall(r"(>=|<=|<|>)\s*([\d.]+)", requirement.split(";")[0])
    return all(tests[sign](_numbers(bound)) for sign, bound in bounds)


def _numbers(version: str) -> tuple[int, ...]:
    found = re.match(r"[\d.]+", version)
    numbers = [int(part) for part in found.group().split(".") if part] if found else []
    return (*numbers, *[0] * (6 - len(numbers)))
