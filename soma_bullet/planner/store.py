"""Plans kept by the content of what they follow from, so that the same input is planned once.

The key covers the assembly (its file and its meshes), the hands and which arm has which, the options, the
excluded orders, the versions of the packages and the source of the planner itself. The seed only picks among
orders of equal score: there is a plan for each pick. What was not asked for the longest makes room for new
plans."""

from __future__ import annotations

import hashlib
import json
import os
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path

from soma_bullet.assembly.model import Assembly
from soma_bullet.errors import InputError
from soma_bullet.grasp.hand_set import HandSet
from soma_bullet.planner.assembly_plan import AssemblyPlan
from soma_bullet.planner.options import PlannerOptions
from soma_bullet.planner.plan import easiest_orders, make_plan, picked
from soma_bullet.records import package_versions, read_json, to_tree, write_json

LARGEST = 200_000_000  # [bytes] of all plans; one of seven pieces has 6 MB


def store_folder() -> Path:
    """Where plans are kept: `$XDG_CACHE_HOME/soma_bullet/plans`, `~/.cache` by default."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "soma_bullet" / "plans"


def kept_plan(
    assembly: Assembly,
    hands: HandSet,
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
    options = (options or PlannerOptions()).with_hands().advised(assembly.advice)
    own = any(":" in name for name in (options.stability, *options.analyzers))
    if own or not assembly.digest:
        return make_plan(assembly, hands, options, excluded)
    key = _key(assembly, hands, options, excluded)
    folder = store_folder()
    try:
        picks = folder / f"{key}.json"
        count = int(json.loads(picks.read_text(encoding="utf-8"))["picks"])
        file = folder / f"{key}_{picked(options.seed, count)}.json"
        plan = read_json(AssemblyPlan, file)
        with suppress(OSError):  # read-only: nothing is deleted there either
            picks.touch()
            file.touch()
        return replace(plan, options=options)
    except (OSError, ValueError, KeyError, InputError):  # not there yet, or damaged: it is made anew
        pass
    plan = make_plan(assembly, hands, options, excluded)
    count = len(easiest_orders(plan))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(plan, folder / f"{key}_{picked(options.seed, count)}.json")
        write_json({"picks": count}, folder / f"{key}.json")
        _make_room(folder)
    except OSError:  # a read-only home is no reason to fail
        pass
    return plan


def _make_room(folder: Path) -> None:
    """Delete the files that were not asked for the longest until all together are no larger than LARGEST."""
    files = []
    for file in folder.glob("*.json"):
        with suppress(OSError):  # another process may make room too
            files.append((file.stat().st_mtime_ns, file.stat().st_size, file))
    excess = sum(size for _, size, _ in files) - LARGEST
    for _, size, file in sorted(files):
        if excess <= 0:
            break
        with suppress(OSError):
            file.unlink()
        excess -= size


def _key(
    assembly: Assembly, hands: HandSet, options: PlannerOptions, excluded: frozenset[tuple[str, ...]]
) -> str:
    told = {
        "assembly": assembly.digest,
        "hands": [hand.figures for hand in hands.kinds],
        "arms": hands.arms,
        "options": to_tree(replace(options, seed=0)),
        "excluded": sorted(excluded),
        "versions": package_versions(),
        "source": _source(),
    }
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:32]


@cache
def _source() -> str:
    """Hash of the source that a plan depends on."""
    package = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for folder in ("assembly", "grasp", "planner", "."):
        for file in sorted((package / folder).glob("*.py")):
            digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()
