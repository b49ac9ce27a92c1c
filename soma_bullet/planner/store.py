"""Plans kept by the content of what they follow from, so that the same input is planned once.

The key covers the assembly (its file and its meshes), the hand, the options, the excluded orders, the
versions of the packages and the source of the planner itself. The seed only picks among orders of equal
score: there is a plan for each pick."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from soma_bullet.assembly.model import Assembly
from soma_bullet.errors import InputError
from soma_bullet.grasp.hand import Hand
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.plan import easiest_orders, make_plan, picked
from soma_bullet.records import package_versions, read_json, to_tree, write_json


def store_folder() -> Path:
    """Where plans are kept: `$XDG_CACHE_HOME/soma_bullet/plans`, `~/.cache` by default."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "soma_bullet" / "plans"


def kept_plan(
    assembly: Assembly,
    hand: Hand,
    options: PlannerOptions | None = None,
    excluded: frozenset[tuple[str, ...]] = frozenset(),
) -> AssemblyPlan:
    """What `make_plan` returns, from the store where it is there; a plan that could not be written is made
    all the same.

    Assemblies without a digest, and analyzers of one's own, whose source the key cannot cover, are planned
    each time.

    Raises:
        InputError, NoPlanError: as `make_plan`.
    """
    options = (options or PlannerOptions()).with_hands()
    own = any(":" in name for name in (options.stability, *options.analyzers))
    if own or not assembly.digest:
        return make_plan(assembly, hand, options, excluded)
    key = _key(assembly, hand, options, excluded)
    folder = store_folder()
    try:
        count = int(json.loads((folder / f"{key}.json").read_text(encoding="utf-8"))["picks"])
        plan = read_json(AssemblyPlan, folder / f"{key}_{picked(options.seed, count)}.json")
        return replace(plan, options=options)
    except (OSError, ValueError, KeyError, InputError):  # not there yet, or damaged: it is made anew
        pass
    plan = make_plan(assembly, hand, options, excluded)
    count = len(easiest_orders(plan))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(plan, folder / f"{key}_{picked(options.seed, count)}.json")
        write_json({"picks": count}, folder / f"{key}.json")
    except OSError:  # a read-only home is no reason to fail
        pass
    return plan


def _key(
    assembly: Assembly, hand: Hand, options: PlannerOptions, excluded: frozenset[tuple[str, ...]]
) -> str:
    told = {
        "assembly": assembly.digest,
        "hand": {name: _plain(value) for name, value in vars(hand).items() if name != "urdf"},
        "options": to_tree(replace(options, seed=0)),
        "excluded": sorted(excluded),
        "versions": package_versions(),
        "source": _source(),
    }
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:32]


def _plain(value: object) -> object:
    """A field of the hand as text; its boxes by their numbers."""
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "half"):
        return [np.asarray(value.T).tolist(), np.asarray(value.half).tolist()]  # type: ignore[attr-defined]
    return np.asarray(value).tolist()


@cache
def _source() -> str:
    """Hash of the source that a plan depends on."""
    package = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for folder in ("assembly", "grasp", "planner", "."):
        for file in sorted((package / folder).glob("*.py")):
            digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()
