"""The judge: reads the log and the assembly, nothing else, and says where the pieces ended up and what
touched what."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from soma_bullet.assembly.contacts import SUPPORT
from soma_bullet.assembly.model import Assembly
from soma_bullet.assembly.settling import rest_shifts
from soma_bullet.frames import Array, Indices, apply, inverse, rotation_angle
from soma_bullet.robot.model import Cell
from soma_bullet.task.kinds import KINDS
from soma_bullet.verdict.limits import VELOCITY_EXCESS, Limits, limits_of
from soma_bullet.verdict.options import Tolerance
from soma_bullet.world.log import ExecutionLog, SegmentRecord

STAND, TABLE = "stand", "table"


@dataclass(frozen=True)
class PieceVerdict:
    """Where one piece ended up, against its nominal goal.

    Attributes:
        error_mm: displacement of the centre of mass; error_max_mm: of the worst vertex; error_deg: rotation.
        in_place: within the tolerance.
        rest_mm: displacement of the centre of mass from where the piece should have come to rest.
    """

    name: str
    error_mm: float
    error_max_mm: float
    error_deg: float
    in_place: bool
    rest_mm: float = 0.0


@dataclass(frozen=True)
class GraspSlip:
    """Largest motion of a gripped piece in the hand that carried it."""

    piece: str
    arm: str
    slip_mm: float
    slip_deg: float


@dataclass(frozen=True)
class HoldDrift:
    """Largest motion in the world of a piece while a hand held it in place; seconds: how long."""

    piece: str
    arm: str
    seconds: float
    drift_mm: float
    drift_deg: float
    grip_n: float


@dataclass(frozen=True)
class ForbiddenContact:
    """Two bodies that touched though they never should: first time [s], samples, largest force [N]."""

    body_a: str
    body_b: str
    first_s: float
    samples: int
    force_n: float


@dataclass(frozen=True)
class InsertionForce:
    """One insertion: the slow last part of it, between the start and the end of its `place` segment.

    Attributes:
        peak_n: largest change of the wrist's force [N].
        outcome, remaining_mm: how it ended, and the travel that was left [mm]; see SegmentRecord.
        went_in: whether it was not jammed, and the piece within the tolerance of its goal at the end, still
            in the hand.
        along_mm, across_mm: displacement of its centre of mass from the goal then: along the insertion,
            negative where it fell short, and across it.
        error_deg: its rotation then.
        neighbours_mm: largest motion of any vertex of any piece that was placed before, against the start; 0
            where none was.
    """

    piece: str
    arm: str
    peak_n: float
    outcome: str
    remaining_mm: float
    went_in: bool = False
    along_mm: float = 0.0
    across_mm: float = 0.0
    error_deg: float = 0.0
    neighbours_mm: float = 0.0


@dataclass(frozen=True)
class Judgement:
    """The verdict and every number behind it; `causes` says what is wrong, empty on success."""

    success: bool
    causes: tuple[str, ...]
    pieces: tuple[PieceVerdict, ...]
    slips: tuple[GraspSlip, ...]
    holds: tuple[HoldDrift, ...]
    forbidden: tuple[ForbiddenContact, ...]
    insertions: tuple[InsertionForce, ...]
    dropped: tuple[str, ...]
    limits: Limits
    makespan_s: float


def judge(log: ExecutionLog, assembly: Assembly, cell: Cell, tolerance: Tolerance | None = None) -> Judgement:
    """Judge one episode by what its log says: where every piece ended up, and what touched what on the way.

    Success: the program ended, every piece is in place, nothing was dropped, nothing forbidden was touched,
    and the limits of the arms were kept.

    Args:
        log: of the episode, of these pieces and of this cell.
        tolerance: what counts as in place; within 2 mm and 2 degrees by default.

    Raises:
        InputError: the tolerance is not positive.
    """
    tolerance = tolerance or Tolerance()
    tolerance.check()
    rest = rest_shifts(assembly)
    pieces = tuple(_piece(log, assembly, k, tolerance, rest[k]) for k in range(len(assembly.pieces)))
    forbidden = tuple(_forbidden(log, assembly, cell))
    dropped = tuple(
        sorted(
            {c.body_a if c.body_b == TABLE else c.body_b for c in forbidden if TABLE in (c.body_a, c.body_b)}
            & set(assembly.names)
        )
    )
    limits = limits_of(log, cell)
    causes = [] if log.ended == "done" else [log.ended]
    causes += [
        f"{v.name} is {v.error_mm:.2f} mm and {v.error_deg:.2f} deg from its goal"
        f"{f', {v.rest_mm:.2f} mm from where it should rest' if abs(v.rest_mm - v.error_mm) > 0.5 else ''}"
        for v in pieces
        if not v.in_place
    ]
    causes += [f"{name} was dropped" for name in dropped]
    causes += [
        f"{c.body_a} touched {c.body_b} at {c.first_s:.2f} s ({c.force_n:.1f} N)"
        for c in forbidden
        if not {c.body_a, c.body_b} & set(dropped)
    ]
    if limits.speed > VELOCITY_EXCESS:
        causes.append(f"a joint moved at {limits.speed:.2f} of its speed limit")
    if limits.joint_deg < 0:
        causes.append(f"a joint left its range by {-limits.joint_deg:.2f} deg")
    moving = [s for s in log.segments if s.kind != "final"]
    return Judgement(
        success=not causes,
        causes=tuple(causes),
        pieces=pieces,
        slips=tuple(_slips(log)),
        holds=tuple(_holds(log)),
        forbidden=forbidden,
        insertions=tuple(_insertion(log, assembly, s, tolerance) for s in log.segments if s.kind == "place"),
        dropped=dropped,
        limits=limits,
        makespan_s=max((s.end for s in moving), default=0.0),
    )


def _piece(log: ExecutionLog, assembly: Assembly, k: int, tolerance: Tolerance, rest: Array) -> PieceVerdict:
    piece = assembly.pieces[k]
    final = log.piece_pose(-1, piece.name)
    goal = log.T_world_assembly @ assembly.goals[k]
    com = apply(final, piece.center_of_mass) - apply(goal, piece.center_of_mass)
    vertices = np.linalg.norm(apply(final, piece.vertices) - apply(goal, piece.vertices), axis=1)
    error_mm = float(np.linalg.norm(com)) * 1e3
    error_deg = float(np.rad2deg(rotation_angle(final[:3, :3], goal[:3, :3])))
    rest_mm = float(np.linalg.norm(com - log.T_world_assembly[:3, :3] @ rest)) * 1e3
    of = assembly.advice.tolerance_of if tolerance.of == "file" else tolerance.of
    counts = rest_mm if of == "rest" else error_mm
    in_place = counts <= tolerance.mm and error_deg <= tolerance.deg
    return PieceVerdict(piece.name, error_mm, float(vertices.max()) * 1e3, error_deg, in_place, rest_mm)


def _insertion(
    log: ExecutionLog, assembly: Assembly, record: SegmentRecord, tolerance: Tolerance
) -> InsertionForce:
    samples, k = log.between(record.start, record.end), assembly.index(record.piece)
    facts = record.piece, record.arm, record.peak_force, record.outcome, record.remaining * 1e3
    if not len(samples):
        return InsertionForce(*facts)
    piece, goal = assembly.pieces[k], log.T_world_assembly @ assembly.goals[k]
    end = log.piece_pose(int(samples[-1]), record.piece)
    shift = (apply(end, piece.center_of_mass) - apply(goal, piece.center_of_mass)) * 1e3
    direction = record.offset / max(float(np.linalg.norm(record.offset)), 1e-12)
    along = float(shift @ direction)
    across = float(np.linalg.norm(shift - along * direction))
    turn = float(np.rad2deg(rotation_angle(end[:3, :3], goal[:3, :3])))
    there = float(np.linalg.norm(shift)) <= tolerance.mm and turn <= tolerance.deg
    went_in = there and record.outcome not in ("jammed", "lost")
    placed = {s.piece for s in log.segments if s.kind == "place" and s.end <= record.start} - {record.piece}
    moved = max((_travel(log, assembly, name, samples) for name in placed), default=0.0)
    return InsertionForce(*facts, went_in, along, across, turn, moved)


def _travel(log: ExecutionLog, assembly: Assembly, name: str, samples: Indices) -> float:
    """Largest displacement [mm] of any vertex of a piece against the first of some samples."""
    vertices = assembly.pieces[assembly.index(name)].vertices
    places = np.array([apply(log.piece_pose(int(i), name), vertices) for i in samples])
    return float(np.linalg.norm(places - places[0], axis=2).max()) * 1e3


def _following(log: ExecutionLog, k: int) -> list[SegmentRecord]:
    """What an arm did with a piece after a segment, in order, until it let go of it."""
    record = log.segments[k]
    same = sorted(
        (s for s in log.segments[k + 1 :] if (s.arm, s.piece) == (record.arm, record.piece)),
        key=lambda s: s.start,
    )
    until = next((n for n, s in enumerate(same) if s.kind == "release"), len(same))
    return same[: until + 1]


def _motion(poses: list[Array]) -> tuple[float, float]:
    """Largest displacement [mm] and rotation [deg] of poses against the first."""
    if not poses:
        return 0.0, 0.0
    shift = max(float(np.linalg.norm(pose[:3, 3] - poses[0][:3, 3])) for pose in poses)
    turn = max(rotation_angle(poses[0][:3, :3], pose[:3, :3]) for pose in poses)
    return shift * 1e3, float(np.rad2deg(turn))


def _carries(record: SegmentRecord) -> bool:
    """Whether a piece moves with the hand meanwhile."""
    return record.kind in KINDS and KINDS[record.kind].carries


def _slips(log: ExecutionLog) -> list[GraspSlip]:
    slips = []
    for k, record in enumerate(log.segments):
        carried = [s for s in _following(log, k) if _carries(s)] if record.kind == "grasp" else []
        if not carried:
            continue
        samples = log.between(carried[0].start, carried[-1].end)
        relative = [
            inverse(log.tcp_pose(int(i), record.arm)) @ log.piece_pose(int(i), record.piece) for i in samples
        ]
        slips.append(GraspSlip(record.piece, record.arm, *_motion(relative)))
    return slips


def _holds(log: ExecutionLog) -> list[HoldDrift]:
    holds = []
    for k, record in enumerate(log.segments):
        following = _following(log, k)
        placed = record.kind == "settle" and _before(log, k) == "place"
        taken = record.kind == "grasp" and not any(_carries(s) for s in following)
        if not placed and not taken:
            continue
        end = next((s.start for s in following if s.kind == "release"), float(log.times[-1]))
        if end - record.end < 0.5:
            continue  # let go at once: not a hold
        samples = log.between(record.end, end)
        stays = _stays(record.end, end, [s for s in following if s.kind == "follow"])
        drifts = [
            _motion([log.piece_pose(int(i), record.piece) for i in log.between(*stay)]) for stay in stays
        ]
        drift = max(mm for mm, _ in drifts), max(deg for _, deg in drifts)
        grip = float(log.grips[samples, log.arm_names.index(record.arm)].min()) if len(samples) else 0.0
        holds.append(HoldDrift(record.piece, record.arm, end - record.end, *drift, grip))
    return holds


def _stays(start: float, end: float, moves: list[SegmentRecord]) -> list[tuple[float, float]]:
    """What is left of a span of time without some moves."""
    return list(zip([start, *(s.end for s in moves)], [*(s.start for s in moves), end], strict=True))


def _before(log: ExecutionLog, k: int) -> str:
    """The kind of the arm's segment before."""
    return next((s.kind for s in reversed(log.segments[:k]) if s.arm == log.segments[k].arm), "")


def _forbidden(log: ExecutionLog, assembly: Assembly, cell: Cell) -> list[ForbiddenContact]:
    name = lambda k: STAND if k == SUPPORT else assembly.names[k]  # noqa: E731
    meant = {frozenset(name(k) for k in pair) for pair in assembly.meeting}
    lifted = {s.piece: s.end for s in log.segments if s.kind == "lift"}
    fingers = {link: arm.name for arm in cell.arms for link in arm.finger_links}
    gripping = _gripping_spans(log)
    found: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for sample, a, b, force, _ in log.contacts:
        first, second = sorted((log.bodies[int(a)], log.bodies[int(b)]))
        time = float(log.times[int(sample)])
        pair = frozenset((first, second))
        if pair in meant:
            continue
        piece = next((n for n in (first, second) if n in assembly.names), None)
        other = second if piece == first else first
        if piece is not None and other == TABLE and time <= lifted.get(piece, np.inf):
            continue
        if piece is not None and other in fingers:
            spans = gripping.get((fingers[other], piece), ())
            if any(start <= time <= end for start, end in spans):
                continue
        found.setdefault((first, second), []).append((time, force))
    return [
        ForbiddenContact(a, b, min(t for t, _ in hits), len(hits), max(f for _, f in hits))
        for (a, b), hits in sorted(found.items())
    ]


def _gripping_spans(log: ExecutionLog) -> dict[tuple[str, str], list[tuple[float, float]]]:
    """When each hand may touch each piece: from the approach until it has let go and left."""
    spans: dict[tuple[str, str], list[tuple[float, float]]] = {}
    opened: dict[tuple[str, str], float] = {}
    for record in sorted(log.segments, key=lambda s: s.start):
        key = (record.arm, record.piece)
        if record.kind == "approach":
            if key in opened:  # it had lost the piece, and comes again
                spans.setdefault(key, []).append((opened[key], record.start))
            opened[key] = record.start
        elif record.kind == "retreat" and key in opened:
            spans.setdefault(key, []).append((opened.pop(key), record.end))
    for key, start in opened.items():
        spans.setdefault(key, []).append((start, np.inf))
    return spans
