"""What a segment waits for once the arms move at the same time: the assembly, its piece, other arms in its
way."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from soma_bullet.task.segment import Segment
from soma_bullet.task.state import CellState


def assembles(before: CellState, segment: Segment) -> bool:
    """Whether a segment changes the assembly or what holds it: those keep their order."""
    kind = segment.kind
    return kind.assembles or (kind.at_piece and segment.piece in before.placed)


def awaited(
    j: int,
    segments: Sequence[Segment],
    assembling: Sequence[bool],
    known: Sequence[dict[int, int]],
    arms: int,
    meets: Callable[[int, int], bool],
) -> tuple[dict[int, int], bool]:
    """The last segment of each arm that must have ended before the j-th; whether another path of it could
    wait for fewer.

    Args:
        assembling: of every segment, whether it `assembles`.
        known: what was found for each of the segments before it.
        arms: how many there are.
        meets: whether the arms of an earlier one and of the j-th may come near to each other.
    """
    arm, piece, kind = segments[j].arm, segments[j].piece, segments[j].kind
    own = next((i for i in range(j - 1, -1, -1) if segments[i].arm == arm), -1)
    ended = dict(known[own]) if own >= 0 else dict.fromkeys(range(arms), -1)
    ended[arm] = own
    avoidable = False
    for i in range(j - 1, -1, -1):
        other = segments[i]
        if i <= ended[other.arm]:
            continue
        same = other.piece == piece and not (kind.unladen or other.kind.unladen)
        ordered = same or (assembling[i] and assembling[j])
        if ordered or meets(i, j):
            avoidable |= not ordered
            ended = {a: max(last, known[i][a]) for a, last in ended.items()}
            ended[other.arm] = i
    return ended, avoidable
