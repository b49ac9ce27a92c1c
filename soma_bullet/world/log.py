"""What happened: the record of one execution, and the recorder that fills it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soma_bullet.frames import Array, from_quat_xyzw, readonly
from soma_bullet.world.simulator import Sample

RECORDED = ("joints", "targets", "places", "tcps", "wrenches", "grips")  # of every sample


@dataclass(frozen=True, eq=False)
class SegmentRecord:
    """One segment as it was run.

    Attributes:
        kind, step, piece: of the program's segment; arm: its name.
        start, end: [s].
        outcome: `as planned`, `stopped early` (by its guard), `jammed` (stopped early and far from its end)
            or `lost` (nothing between the fingers).
        offset: straight travel of the hand that was commanded (3,) [m].
        peak_force: largest change of the wrist's force against its start [N].
        remaining: travel that was left when a guard stopped it [m].
    """

    kind: str
    step: int | None
    arm: str
    piece: str
    start: float
    end: float
    outcome: str
    offset: Array
    peak_force: float
    remaining: float


@dataclass(frozen=True)
class Event:
    """Something that the executive noticed or decided: when [s], what kind, about which piece, in words."""

    time: float
    kind: str
    piece: str
    text: str


@dataclass(frozen=True, eq=False)
class ExecutionLog:
    """Record of one episode: m samples, n pieces, a arms.

    Attributes:
        cell, assembly, digest, seed, order: what was executed.
        stand: footprint [m]; T_world_assembly: (4, 4).
        joint_names: all joints of the composed URDF that move (j).
        target_names: joints of the arms, one arm after the other (t).
        arm_names, piece_names.
        times: (m,) [s].
        joints: (m, j); targets: commanded joints of the arms (m, t) [rad].
        poses: T_world_piece as position and quat_xyzw (m, n, 7).
        tcps: T_world_tcp likewise (m, a, 7).
        wrenches: at the wrists, as the sensors report (m, a, 6) [N, N m].
        grips: force on the pads of each hand (m, a) [N].
        contacts: rows (sample, body, body, normal force [N], distance [m]) (k, 5), bodies as indices into
            `bodies`.
        bodies: names: links of the robot, `table`, `stand`, pieces.
        segments: in the order in which they ended.
        events: what the executive noticed and decided on the way.
        constraints: every constraint that was in the world.
        ended: how the executive ended: `done`, or why it stopped.
    """

    cell: str
    assembly: str
    digest: str
    seed: int
    order: tuple[str, ...]
    stand: tuple[float, float]
    T_world_assembly: Array
    joint_names: tuple[str, ...]
    target_names: tuple[str, ...]
    arm_names: tuple[str, ...]
    piece_names: tuple[str, ...]
    times: Array
    joints: Array
    targets: Array
    poses: Array
    tcps: Array
    wrenches: Array
    grips: Array
    contacts: Array
    bodies: tuple[str, ...]
    segments: tuple[SegmentRecord, ...]
    events: tuple[Event, ...]
    constraints: tuple[str, ...]
    ended: str

    def piece_pose(self, sample: int, piece: str) -> Array:
        """T_world_piece (4, 4) at a sample."""
        row = self.poses[sample, self.piece_names.index(piece)]
        return from_quat_xyzw(row[:3], row[3:])

    def tcp_pose(self, sample: int, arm: str) -> Array:
        """T_world_tcp (4, 4) at a sample."""
        row = self.tcps[sample, self.arm_names.index(arm)]
        return from_quat_xyzw(row[:3], row[3:])

    def between(self, start: float, end: float) -> NDArray[np.intp]:
        """Samples with start <= time <= end [s]."""
        return np.flatnonzero((self.times >= start - 1e-9) & (self.times <= end + 1e-9))


class Recorder:
    """Collects samples while a world runs."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self.rows: dict[str, list[Array]] = {name: [] for name in RECORDED}
        self.contacts: list[tuple[int, int, int, float, float]] = []
        self.segments: list[SegmentRecord] = []
        self.events: list[Event] = []

    def __len__(self) -> int:
        return len(self.times)

    def add(self, time: float, sample: Sample) -> None:
        """One moment."""
        self.contacts += [(len(self), *contact) for contact in sample.contacts]
        self.times.append(time)
        for name, rows in self.rows.items():
            rows.append(np.array(getattr(sample, name), float))

    def arrays(self) -> dict[str, Array]:
        """Everything stacked and read-only."""
        stacked = {name: readonly(np.array(rows)) for name, rows in self.rows.items()}
        contacts = readonly(np.array(self.contacts, float).reshape(-1, 5))
        return {"times": readonly(np.array(self.times)), **stacked, "contacts": contacts}
