"""The program as a value, and the states of the cell along it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from soma_bullet.frames import Array
from soma_bullet.task.feed import Feed
from soma_bullet.task.kinds import as_planned
from soma_bullet.task.schedule import Schedule
from soma_bullet.task.segment import Segment
from soma_bullet.task.state import CellState
from soma_bullet.task.workcell import Workcell

Moment = tuple[CellState, Segment, CellState]  # a segment with the states before and after it


@dataclass(frozen=True, eq=False)
class Program:
    """What the cell executes.

    Attributes:
        cell, assembly, digest: names and content hash of the input.
        seed: of everything random.
        order: of the plan.
        feed: where the pieces are at the start.
        schedule: who does what.
        segments: in an order in which they can be executed one at a time.
        after: for every segment the indices of those that must have ended before it starts.
        T_world_assembly: (4, 4).
        stand: footprint of the stand [m].
        start: what it goes on from; None begins with all pieces in the feed.
        alone: planned duration of the same work with one arm at a time [s], ways home left out or put off
            where that is free; None where that was not asked.
        in_turn: planned duration of the schedule as it was, one segment at a time [s]; None where that was
            not asked.
    """

    cell: str
    assembly: str
    digest: str
    seed: int
    order: tuple[str, ...]
    feed: Feed
    schedule: Schedule
    segments: tuple[Segment, ...]
    after: tuple[tuple[int, ...], ...]
    T_world_assembly: Array
    stand: tuple[float, float]
    start: CellState | None = None
    alone: float | None = None
    in_turn: float | None = None

    @property
    def makespan(self) -> float:
        """Planned duration [s]."""
        ends: list[float] = []
        for segment, before in zip(self.segments, self.after, strict=True):
            ends.append(max((ends[k] for k in before), default=0.0) + segment.seconds)
        return max(ends, default=0.0)


def one_at_a_time(count: int) -> tuple[tuple[int, ...], ...]:
    """`Program.after` of segments that run one after another."""
    return tuple((k - 1,) if k else () for k in range(count))


def beginning(workcell: Workcell, feed: Feed, start: CellState | None = None) -> CellState:
    """All pieces in the feed, the arms at home with empty hands; or as found."""
    if start is None:
        return workcell.idle({name: feed.pose(name) for name in feed.names})
    poses = {n: workcell.stands(n, pose) if n in start.placed else pose for n, pose in start.poses.items()}
    return replace(start, poses=poses)


def moments(workcell: Workcell, program: Program) -> Iterator[Moment]:
    """Every segment of a program with the states before and after it."""
    state = beginning(workcell, program.feed, program.start)
    for segment in program.segments:
        before = segment.kind.before(state, segment.arm, segment.piece)
        state = as_planned(workcell, state, segment)
        yield before, segment, state
