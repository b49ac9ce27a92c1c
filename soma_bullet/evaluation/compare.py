"""Which of two: evaluation runs compared seed by seed, as whole episodes and insertion by insertion.

Both runs see the same feeds, so what counts is where they differ: the exact McNemar test asks how likely so
uneven a difference would be if neither run were better (Q. McNemar, 1947)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from soma_bullet.errors import InputError
from soma_bullet.evaluation.folder import LINES, read_lines
from soma_bullet.evaluation.line import Line
from soma_bullet.evaluation.statistics import Contrast, Extremes, Pairs, Rate, contrast, extremes
from soma_bullet.option import flags
from soma_bullet.options import EpisodeOptions

COMPARISON = "comparison.json"
PER_SEED = ("seed", "physics.friction", "physics.mass")  # of an episode's options: drawn, or its number


@dataclass(frozen=True)
class Attempt:
    """One insertion of one run, as its line has it.

    Attributes:
        error_mm: displacement of the centre of mass from the goal at its end [mm].
        went_in, outcome, peak_n, neighbours_mm, error_deg: see InsertionForce.
    """

    went_in: bool
    outcome: str
    error_mm: float
    error_deg: float
    peak_n: float
    neighbours_mm: float


@dataclass(frozen=True)
class InsertionPair:
    """The first insertion of one piece in both episodes of one seed."""

    seed: int
    piece: str
    a: Attempt
    b: Attempt


@dataclass(frozen=True)
class Insertions:
    """Insertions paired by seed and piece, of each episode up to the first that did not go in in A or in B.

    Attributes:
        pairs: how often they went in; rate_a, rate_b: over these pairs; p: see Pairs.
        rescued: of those that did not go in in A, how many did in B; spoilt: the other way round.
        unpaired: insertions that one run reached and the other did not.
        later: reached in both runs, after one that failed in either: nothing is the same from there on.
        peak_a, peak_b: peak force of the paired ones [N]; neighbours_a, neighbours_b: motion of what was in
            place before [mm].
        all_peak_a, all_peak_b, all_neighbours_a, all_neighbours_b: the same of every insertion of the paired
            episodes.
        compared: the pairs themselves.
    """

    pairs: Pairs
    p: float
    rate_a: Rate
    rate_b: Rate
    rescued: Rate
    spoilt: Rate
    unpaired: int
    later: int
    peak_a: Extremes
    peak_b: Extremes
    neighbours_a: Extremes
    neighbours_b: Extremes
    all_peak_a: Extremes
    all_peak_b: Extremes
    all_neighbours_a: Extremes
    all_neighbours_b: Extremes
    compared: tuple[InsertionPair, ...]


@dataclass(frozen=True)
class Difference:
    """An option, a version or the like in which the runs differ, as text."""

    name: str
    a: str
    b: str


@dataclass(frozen=True)
class EpisodePair:
    """Both episodes of one seed; numbers are NaN where nothing was executed.

    Attributes:
        cause_a, cause_b: of failure, empty on success.
        makespan_a, makespan_b: [s]; worst_a, worst_b: displacement of the worst piece's centre of mass at the
            end [mm].
    """

    seed: int
    success_a: bool
    success_b: bool
    cause_a: str
    cause_b: str
    makespan_a: float
    makespan_b: float
    worst_a: float
    worst_b: float


@dataclass(frozen=True)
class Comparison:
    """Two runs, compared.

    Attributes:
        a, b: folders.
        assembly: of A; differences: in what the runs differ.
        unpaired_a, unpaired_b: seeds of one run alone.
        pairs, p, rate_a, rate_b: of whole episodes.
        makespan_s: where both succeeded; worst_mm: where both were executed.
        insertions: None where the lines of either run do not say how insertions went.
        episodes: the pairs, by seed.
    """

    a: str
    b: str
    assembly: str
    differences: tuple[Difference, ...]
    unpaired_a: int
    unpaired_b: int
    pairs: Pairs
    p: float
    rate_a: Rate
    rate_b: Rate
    makespan_s: Contrast
    worst_mm: Contrast
    insertions: Insertions | None
    episodes: tuple[EpisodePair, ...]


def compare(a: Path, b: Path, any_assembly: bool = False) -> Comparison:
    """Compare two runs of soma-evaluate, each a folder or its file of lines.

    Args:
        any_assembly: assemblies may differ, as long as their pieces have the same names.

    Raises:
        InputError: there are no lines, no common seeds, or different assemblies.
    """
    mine, theirs = _lines(a), _lines(b)
    _check_assemblies(a, b, mine.values(), theirs.values(), any_assembly)
    seeds = sorted(mine.keys() & theirs.keys())
    if not seeds:
        ranges = " and ".join(f"{min(lines)} to {max(lines)}" for lines in (mine, theirs))
        raise InputError(f"{a}, {b}", f"have no seed in common: {ranges}")
    paired = [(mine[seed], theirs[seed]) for seed in seeds]
    pairs = Pairs.of((one["success"], other["success"]) for one, other in paired)
    episodes = tuple(_episode(one, other) for one, other in paired)
    return Comparison(
        a=str(a),
        b=str(b),
        assembly=paired[0][0]["assembly"],
        differences=tuple(_differences(paired)),
        unpaired_a=len(mine) - len(seeds),
        unpaired_b=len(theirs) - len(seeds),
        pairs=pairs,
        p=pairs.p,
        rate_a=Rate.of(pairs.both + pairs.only_a, pairs.count),
        rate_b=Rate.of(pairs.both + pairs.only_b, pairs.count),
        makespan_s=contrast([(e.makespan_a, e.makespan_b) for e in episodes if e.success_a and e.success_b]),
        worst_mm=contrast(
            [(e.worst_a, e.worst_b) for e in episodes if np.isfinite([e.worst_a, e.worst_b]).all()]
        ),
        insertions=_insertions(paired),
        episodes=episodes,
    )


# --- reading ------------------------------------------------------------------------------------------------


def _lines(place: Path) -> dict[int, Line]:
    file = place / LINES if place.is_dir() else place
    if not file.is_file():
        raise InputError(str(place), f"is no run of soma-evaluate: there is no {LINES}")
    lines = {line["seed"]: line for line in read_lines(file)}
    if not lines:
        raise InputError(str(file), "has no lines")
    if not all(
        {"assembly", "digest", "options", "versions", "episode", "success"} <= line.keys()
        for line in lines.values()
    ):
        raise InputError(str(file), "is not of this version of the package: its lines lack what is compared")
    return lines


def _check_assemblies(
    a: Path, b: Path, mine: Iterable[Line], theirs: Iterable[Line], any_assembly: bool
) -> None:
    kinds = []
    for place, lines in ((a, list(mine)), (b, list(theirs))):
        digests = {line["digest"] for line in lines}
        if len(digests) > 1:
            raise InputError(str(place), f"holds lines of {len(digests)} different assemblies")
        names = next(
            (tuple(sorted(p["name"] for p in line["pieces"])) for line in lines if line.get("pieces")), None
        )
        kinds.append((lines[0]["assembly"], digests.pop(), names))
    (name_a, digest_a, pieces_a), (name_b, digest_b, pieces_b) = kinds
    if digest_a == digest_b:
        return
    what = f"were made of different assemblies: {name_a} ({digest_a[:12]}) and {name_b} ({digest_b[:12]})"
    if pieces_a is not None and pieces_b is not None and pieces_a != pieces_b:
        raise InputError(f"{a}, {b}", f"{what}, whose pieces have different names")
    if not any_assembly:
        raise InputError(f"{a}, {b}", f"{what}; --any-assembly compares them nevertheless")


def _differences(paired: Sequence[tuple[Line, Line]]) -> Iterator[Difference]:
    """In what the runs differ: options by their names on the command line, then what else of the episodes is
    not the same."""
    parts: tuple[dict[str, Difference], ...] = ({}, {}, {})
    for one, other in paired:
        whole = ({"assembly": one["digest"][:12]}, {"assembly": other["digest"][:12]})
        versions = [
            {f"version of {name}": v for name, v in line["versions"].items()} for line in (one, other)
        ]
        _note(parts[0], one["options"], other["options"])
        _note(parts[1], *(_flat(line["episode"]) for line in (one, other)))
        _note(parts[2], {**whole[0], **versions[0]}, {**whole[1], **versions[1]})
        _note(
            parts[2],
            *({f"drawn {name}": v for name, v in line.get("drawn", {}).items()} for line in (one, other)),
        )
    names = {".".join(flag.path): flag.name for flag in flags(EpisodeOptions)}
    yield from parts[0].values()
    yield from (d for name, d in parts[1].items() if name not in PER_SEED and names.get(name) not in parts[0])
    yield from parts[2].values()


def _note(found: dict[str, Difference], a: Mapping[str, Any], b: Mapping[str, Any]) -> None:
    """Add what differs between two mappings, if it is not there yet."""
    for name in dict.fromkeys([*a, *b]):
        if a.get(name, "not given") != b.get(name, "not given"):
            found.setdefault(
                name, Difference(name, str(a.get(name, "not given")), str(b.get(name, "not given")))
            )


def _flat(tree: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in tree.items():
        flat |= _flat(value, f"{path}{name}.") if isinstance(value, Mapping) else {f"{path}{name}": value}
    return flat


# --- episodes -----------------------------------------------------------------------------------------------


def _episode(a: Line, b: Line) -> EpisodePair:
    makespans = [float(line.get("makespan_s", np.nan)) for line in (a, b)]
    worst = [max((float(p["error_mm"]) for p in line.get("pieces", ())), default=np.nan) for line in (a, b)]
    well = bool(a["success"]), bool(b["success"])
    return EpisodePair(a["seed"], *well, str(a.get("cause", "")), str(b.get("cause", "")), *makespans, *worst)


# --- insertions ---------------------------------------------------------------------------------------------


def _attempts(line: Line) -> dict[str, Attempt]:
    """The first insertion of every piece, in the order of the episode."""
    found: dict[str, Attempt] = {}
    for item in line.get("insertions", ()):
        off = float(np.hypot(item["along_mm"], item["across_mm"]))
        facts = off, item["error_deg"], item["peak_n"], item["neighbours_mm"]
        found.setdefault(item["piece"], Attempt(bool(item["went_in"]), item["outcome"], *map(float, facts)))
    return found


def _insertions(paired: Sequence[tuple[Line, Line]]) -> Insertions | None:
    every = [item for lines in paired for line in lines for item in line.get("insertions", ())]
    if not every or not all("went_in" in item for item in every):
        return None
    compared: list[InsertionPair] = []
    unpaired = later = 0
    for one, other in paired:
        a, b = _attempts(one), _attempts(other)
        unpaired += len(a.keys() ^ b.keys())
        shared, comparable = [piece for piece in a if piece in b], 0
        for piece in shared:
            comparable += 1
            compared.append(InsertionPair(one["seed"], piece, a[piece], b[piece]))
            if not (a[piece].went_in and b[piece].went_in):
                break
        later += len(shared) - comparable
    pairs = Pairs.of((pair.a.went_in, pair.b.went_in) for pair in compared)
    everything = [[attempt for lines in paired for attempt in _attempts(lines[k]).values()] for k in (0, 1)]
    mine, theirs = [pair.a for pair in compared], [pair.b for pair in compared]
    peaks = [extremes([attempt.peak_n for attempt in group]) for group in (mine, theirs, *everything)]
    neighbours = [
        extremes([attempt.neighbours_mm for attempt in group]) for group in (mine, theirs, *everything)
    ]
    return Insertions(
        pairs=pairs,
        p=pairs.p,
        rate_a=Rate.of(pairs.both + pairs.only_a, pairs.count),
        rate_b=Rate.of(pairs.both + pairs.only_b, pairs.count),
        rescued=Rate.of(pairs.only_b, pairs.only_b + pairs.neither),
        spoilt=Rate.of(pairs.only_a, pairs.only_a + pairs.neither),
        unpaired=unpaired,
        later=later,
        peak_a=peaks[0],
        peak_b=peaks[1],
        all_peak_a=peaks[2],
        all_peak_b=peaks[3],
        neighbours_a=neighbours[0],
        neighbours_b=neighbours[1],
        all_neighbours_a=neighbours[2],
        all_neighbours_b=neighbours[3],
        compared=tuple(compared),
    )
