"""Where the search of a schedule sets out: what is in place, what hands hold and carry, what is laid down
before all else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from soma_bullet.errors import NoSolutionError
from soma_bullet.frames import inverse, readonly
from soma_bullet.task.assignments import Carried, PutDown, Release, Start, Take, way
from soma_bullet.task.fetch import View
from soma_bullet.task.holding import State
from soma_bullet.task.placing import Placer
from soma_bullet.task.spots import comfort
from soma_bullet.task.tracing import Grip

PLACES = 12  # that are tried for one resting pose of a piece that is laid down


@dataclass(frozen=True, eq=False)
class Outset:
    """What there is before the first step.

    Attributes:
        state: pieces in place, and hands; those that hold nothing in place count as at home.
        takes, releases: of holds, where the state as found asks for them.
        carried: arm and grip of the piece of the first step, if a hand has it.
        stowed: how what else hands carry is laid down, one after the other.
    """

    state: State
    takes: tuple[Take, ...] = ()
    releases: tuple[Release, ...] = ()
    carried: tuple[int, Grip] | None = None
    stowed: tuple[PutDown, ...] = ()


def set_out(placer: Placer, start: Start | None, stowed: bool = False) -> Outset:
    """Where a search sets out, all pieces on the table or from a state as found.

    Args:
        placer: of the search; its fetcher says what is ruled out.
        start: the state as found; None where nothing is in place yet, and hands are empty.
        stowed: what hands carry has been laid down already.

    Raises:
        NoSolutionError: the hands cannot go on from how they hold, or lay down what they have.
    """
    if start is None:
        return Outset(State({}, placer.workcell.idle()))
    state = _as_found(placer, start)
    takes: tuple[Take, ...] = ()
    releases: tuple[Release, ...] = ()
    if start.step:
        changed = placer.holding.settle(start.step - 1, state, placer.lying(start.step - 1))
        if changed is None:
            raise NoSolutionError(
                "schedule", "the hands cannot go on from how they hold", placer.tracer.rejections
            )
        takes, releases, state = changed
    if stowed or not start.carrying:
        return Outset(state, takes, releases)
    return Outset(state, takes, releases, *_in_hands(placer, start, state))


def _as_found(placer: Placer, start: Start) -> State:
    """What is in place and held; arms that hold nothing in place count as at home."""
    hands, robot = start.hands, placer.robot
    grip = {piece: robot.tcp(arm, hands.qs[arm]) for arm, piece in hands.gripped.items()}
    for arm, home in enumerate(robot.home):
        if arm not in hands.gripped:
            hands = hands.with_arm(arm, home, 0.0)
    return State({s.piece: placer.placed_pose(s.piece) for s in placer.plan.steps[: start.step]}, hands, grip)


def _in_hands(
    placer: Placer, start: Start, found: State
) -> tuple[tuple[int, Grip] | None, tuple[PutDown, ...]]:
    """The piece of the first step in its hand, and how the others are laid down."""
    kept: tuple[int, Grip] | None = None
    hands, laid_down = found.hands, list[tuple[Carried, Grip]]()
    for carried in start.carrying:
        grip = _grip(placer, start, carried)
        if carried.piece == placer.plan.steps[start.step].piece:
            kept = carried.arm, grip
        else:
            laid_down.append((carried, grip))
        if len(start.carrying) > 1:  # it stands still with what it has while another lays something down
            hands = hands.with_arm(carried.arm, start.hands.qs[carried.arm], grip.width).gripping(
                carried.arm, carried.piece
            )
    puts: tuple[PutDown, ...] = ()
    poses = {step.piece: start.poses[step.piece] for step in placer.plan.steps[start.step :]}
    for carried, grip in laid_down:
        hands = hands.gripping(carried.arm, None)
        lying = {name: pose for name, pose in poses.items() if name != carried.piece}
        view = View(
            -1,
            carried.piece,
            poses[carried.piece],
            (carried.arm, grip),
            lying,
            found.placed,
            hands,
            (carried.arm,),
        )
        puts = (*puts, _put_down(placer, view, puts))
        poses[carried.piece] = puts[-1].pose_down
        hands = hands.with_arm(carried.arm, placer.robot.home[carried.arm], 0.0)
    return kept, puts


def _grip(placer: Placer, start: Start, carried: Carried) -> Grip:
    """How a hand has what it carries."""
    graph, T_piece_tcp = placer.fetcher.graph(carried.piece), inverse(carried.T_tcp_piece)
    index, _, _ = graph.nearest(T_piece_tcp)
    return Grip(
        index, readonly(T_piece_tcp), float(start.hands.openings[carried.arm]), float(graph.contact[index])
    )


def _put_down(placer: Placer, view: View, before: Sequence[PutDown]) -> PutDown:
    """How an arm lays down what it carries, after others have done so."""
    assert view.carrying is not None
    fetcher, (arm, grip) = placer.fetcher, view.carrying
    for rest in range(len(fetcher.graph(view.piece).resting)):
        poses = fetcher.places(view, rest)
        cost = comfort(placer.robot, arm, poses @ grip.T_piece_tcp)
        for n in np.argsort(np.round(cost, 9), kind="stable")[:PLACES]:
            put = fetcher.put_down(view, arm, grip, poses[n])
            if put is not None and way((*before, put)) not in fetcher.excluded:
                return put
    reason = f"{view.piece} is in a hand and can be put down nowhere"
    raise NoSolutionError("schedule", reason, placer.tracer.rejections)
