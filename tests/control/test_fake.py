"""Control on a world without physics: the same programs run, and the same judge judges them.

What the cut between control and simulator promises: whatever has the members of the protocol will do."""

from __future__ import annotations

import inspect
from pathlib import Path

import numpy as np
import pytest

from soma_bullet.control.options import ExecutionOptions
from soma_bullet.records import read_npz, write_npz
from soma_bullet.world.log import ExecutionLog
from soma_bullet.world.simulator import Simulator
from tests.control.episodes import judged, ran, world_of
from tests.soma3 import loosened, planned

ADDED = 2.0  # [s] that feeling and settling may take beyond what was planned


# --- the protocol -------------------------------------------------------------------------------------------


def members() -> dict[str, object]:
    """Those of the protocol, its bases included."""
    bases = [base for base in Simulator.__mro__ if getattr(base, "_is_protocol", False)]
    return {n: m for base in reversed(bases) for n, m in vars(base).items() if not n.startswith("_")}


@pytest.mark.parametrize("name", sorted(members()))
def test_it_has_what_the_protocol_asks_for(name: str) -> None:
    found, asked = getattr(world_of(planned()[2]), name), members()[name]
    if inspect.isfunction(asked):
        assert list(inspect.signature(found).parameters) == list(inspect.signature(asked).parameters)[1:]
    else:
        assert not callable(found)


# --- whole programs -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def episode() -> ExecutionLog:
    return ran(loosened(), world_of(loosened()))


def test_a_program_is_run_and_judged_a_success(episode: ExecutionLog) -> None:
    workcell, plan, _ = planned()
    verdict = judged(episode)
    assert verdict.success, verdict.causes
    assert {piece.name for piece in verdict.pieces if piece.in_place} == set(workcell.assembly.names)
    assert all(insertion.went_in for insertion in verdict.insertions)
    assert [insertion.piece for insertion in verdict.insertions] == list(plan.order)
    assert {event.kind for event in episode.events} == {"looked"}


def test_every_segment_is_run_once_and_as_planned(episode: ExecutionLog) -> None:
    program, names = loosened(), [arm.name for arm in planned()[0].cell.arms]
    run = [(s.arm, s.kind, s.piece, s.step) for s in episode.segments if s.kind != "final"]
    for arm, name in enumerate(names):
        meant = [(name, s.kind.name, s.piece, s.step) for s in program.segments if s.arm == arm]
        assert [entry for entry in run if entry[0] == name] == meant
    assert {s.outcome for s in episode.segments} == {"as planned"}


def test_it_takes_as_long_as_planned_with_both_arms_at_once(episode: ExecutionLog) -> None:
    program = loosened()
    assert program.makespan <= judged(episode).makespan_s + 1e-6 <= program.makespan + ADDED
    left, right = ([(s.start, s.end) for s in episode.segments if s.arm == a] for a in ("left", "right"))
    together = sum(max(0.0, min(b, d) - max(a, c)) for a, b in left for c, d in right)
    assert together > 0.1 * program.makespan


def test_nothing_starts_before_what_it_waits_for_has_ended(episode: ExecutionLog) -> None:
    program, names = loosened(), [arm.name for arm in planned()[0].cell.arms]
    records = {name: [s for s in episode.segments if s.arm == name] for name in names}
    spans, seen = [], dict.fromkeys(names, 0)
    for segment in program.segments:
        name = names[segment.arm]
        spans.append(records[name][seen[name]])
        seen[name] += 1
    for span, waits in zip(spans, program.after, strict=True):
        assert all(spans[k].end <= span.start + 1e-9 for k in waits)


def test_what_is_placed_is_felt_but_not_pushed(episode: ExecutionLog) -> None:
    """A guarded motion goes on until it touches, and goes back until the piece only just rests."""
    workcell, _, _ = planned()
    sizes = workcell.sizes
    placings = [s for s in episode.segments if s.kind == "place"]
    assert all(sizes.touch < s.peak_force < sizes.guard for s in placings)
    for record in placings:
        after = int(episode.between(record.end, np.inf)[0])
        settled = workcell.settled[record.piece]
        assert np.linalg.norm(episode.piece_pose(after, record.piece)[:3, 3] - settled[:3, 3]) < 0.1e-3
        force = episode.wrenches[after, episode.arm_names.index(record.arm)]  # as the world has it
        assert 0.0 <= force[2] < sizes.resting


def test_the_log_is_read_back(episode: ExecutionLog, tmp_path: Path) -> None:
    file = tmp_path / "log.npz"
    write_npz(episode, file)
    assert judged(read_npz(ExecutionLog, file)) == judged(episode)


@pytest.mark.parametrize(
    "options", [ExecutionOptions(compliant=False), ExecutionOptions(recover=False)], ids=["stiff", "as is"]
)
def test_it_runs_otherwise_too(options: ExecutionOptions) -> None:
    _, _, program = planned()
    verdict = judged(ran(program, world_of(program), options))
    assert verdict.success, verdict.causes


def test_an_episode_that_takes_too_long_is_ended() -> None:
    log = ran(loosened(), world_of(loosened()), ExecutionOptions(longest=3.0))
    assert log.ended == "not done after 3 s" and log.times[-1] < 3.0 + 2.0 + 0.1
    assert judged(log).causes[0] == log.ended


# --- what goes wrong ----------------------------------------------------------------------------------------


def kinds(log: ExecutionLog) -> list[str]:
    return [event.kind for event in log.events]


def test_a_hand_that_closes_on_nothing_stops_where_nothing_is_recovered() -> None:
    piece = planned()[1].order[0]
    off = {piece: np.array((0.03, 0.03, 0.0))}
    log = ran(loosened(), world_of(loosened(), off=off), ExecutionOptions(recover=False))
    assert log.ended == f"{piece} lost in grasp" and "planned anew" not in kinds(log)
    assert not judged(log).success


@pytest.mark.parametrize("which", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_a_piece_that_is_not_there_is_looked_for(which: int) -> None:
    piece = planned()[1].order[which]
    log = ran(loosened(), world_of(loosened(), off={piece: np.array((0.03, 0.03, 0.0))}))
    assert judged(log).success, judged(log).causes
    assert kinds(log)[:3] == ["trouble", "looked", "planned anew"]
    assert log.events[0].piece == piece and "lost in grasp" in log.events[0].text
    grasps = [s.outcome for s in log.segments if (s.kind, s.piece) == ("grasp", piece)]
    assert grasps[0] == "lost" and grasps[-1] == "as planned"
