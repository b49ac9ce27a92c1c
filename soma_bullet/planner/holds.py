"""What the spare hands hold between two insertions, and how they get there (paper Sec. IV-F).

A hand lets go, or takes a piece, only while what remains held keeps the state up.
"""

from __future__ import annotations

from itertools import combinations

from soma_bullet.planner.analyzers import Judgement, state_analyzer
from soma_bullet.planner.options import PAPER
from soma_bullet.planner.qualities import NOTHING, Placed, Qualities
from soma_bullet.planner.search import Support

PUSH, AIR = "push", "air"  # what is asked of an order unless no order has it
RULES = frozenset({PUSH, AIR})
SMALLEST_SHARE = 0.01  # of S that a state keeps which bears nothing of the next insertion
MOST_ASKED = 8  # pieces; of more, not every state is looked at in advance


class Holds:
    """Held sets of one assembly; each question is answered once.

    A hand that a state does not need adds nothing: the state counts as if it were away. So the S of a held
    set is that of its best smallest part that keeps the state up, and what stands with a set held stands with
    any larger one.

    A state must also bear the next insertion. Where the rule `push` is lifted it need not: it counts the
    less, the less it bears."""

    def __init__(self, qualities: Qualities, rules: frozenset[str] = RULES):
        self.q = qualities
        self.pushed = PUSH in rules
        self.hands, self.count = qualities.options.hand_count, len(qualities.assembly.names)
        self.analyse = state_analyzer(qualities.options.stability)
        self.refused: set[tuple[Placed, int, int | None]] = (
            set()
        )  # (placed, held piece, upcoming) that no grasp can take
        self._serving: dict[tuple[Placed, Placed], bool] = {}
        self._judged: dict[tuple[Placed, Placed], Judgement] = {}
        self._holdable: dict[tuple[Placed, int | None, Placed], bool] = {}
        self._after: dict[tuple[Placed, int, Placed, int | None], tuple[Support, ...]] = {}

    def refuse(self, placed: Placed, piece: int, upcoming: int | None) -> None:
        """Rule a hold out from now on: no grasp of it can take its load."""
        self.refused.add((placed, piece, upcoming))
        self._holdable.clear()
        self._after.clear()

    def judge(self, placed: Placed, held: Placed = NOTHING) -> Judgement:
        """The state with some pieces held."""
        held &= placed
        key = (placed, held)
        if key not in self._judged:
            self._judged[key] = self._judge(placed, held)
        return self._judged[key]

    def _judge(self, placed: Placed, held: Placed) -> Judgement:
        if not held:
            return self.analyse(self.q, placed, held)
        fewer = [self.judge(placed, held - {piece}) for piece in sorted(held)]
        standing = [judgement for judgement in fewer if judgement.stands]
        if standing:
            return max(standing, key=lambda judgement: judgement.quality)
        return self.analyse(self.q, placed, held)

    def supports(self, before: Placed, piece: int, held: Placed, upcoming: int | None) -> tuple[Support, ...]:
        """What may be held after `piece` went into `before`, so that a hand is free for `upcoming`; nothing
        in the end."""
        key = (before, piece, held, upcoming)
        if key not in self._after:
            placed, most = before | {piece}, self.hands - 1 if upcoming is not None else 0
            reached = [
                kept
                for kept in self._reachable(placed, held | {piece}, upcoming)
                if len(kept) <= most
                and self._serves(placed, upcoming, kept)
                and self.bears(placed, kept, upcoming)
            ]
            self._after[key] = tuple(
                self._support(placed, piece, held, kept, upcoming)
                for kept in sorted(reached, key=lambda kept: (len(kept), sorted(kept)))
                if self.can_hold(placed, upcoming, kept)
            )
        return self._after[key]

    def _reachable(self, placed: Placed, start: Placed, upcoming: int | None) -> set[Placed]:
        """Held sets on the way from `start`, by letting go and taking, that keep the state up."""
        free = self.judge(placed).stands and self.bears(placed, NOTHING, upcoming)
        # while the state stands by itself a hold is only taken up for the sake of the next one
        wanted = not free or (
            upcoming is not None and not self.judge(placed | {upcoming}, frozenset({upcoming})).stands
        )
        seen, stack = {start}, [start]
        while stack:
            current = stack.pop()
            options = [current - {piece} for piece in current]
            if wanted and len(current) < self.hands:
                options += [current | {piece} for piece in placed - current]
            for option in options:
                if option not in seen and self.judge(placed, option).stands:
                    seen.add(option)
                    stack.append(option)
        return seen if self.judge(placed, start).stands else seen - {start}

    def _serves(self, placed: Placed, upcoming: int | None, held: Placed) -> bool:
        """Whether a hold has a purpose: now, or in the first later state that cannot do without a hand."""
        if not held or not self.judge(placed).stands or not self.bears(placed, NOTHING, upcoming):
            return True
        return upcoming is not None and self._serves_later(placed | {upcoming}, held)

    def _serves_later(self, placed: Placed, held: Placed) -> bool:
        """Whether a hold can be needed in a state, or in what follows while the states stand by themselves.

        One spare hand helps only a state that stands with just that piece held. Taken for granted where there
        are too many states to ask, and at the first that needs hands where more of them are to spare."""
        if self.count > MOST_ASKED:
            return True
        key = (placed, held)
        if key not in self._serving:
            if self.judge(placed).stands:
                left = (piece for piece in range(self.count) if piece not in placed)
                self._serving[key] = any(
                    self._serves_push(placed, held, piece) or self._serves_later(placed | {piece}, held)
                    for piece in left
                )
            else:
                self._serving[key] = self.hands > 2 or self.judge(placed, held).stands
        return self._serving[key]

    def _serves_push(self, placed: Placed, held: Placed, upcoming: int) -> bool:
        """Whether a hold helps a state that stands to bear an insertion."""
        return not self.bears(placed, NOTHING, upcoming) and self.bears(placed, held, upcoming)

    def margin(self, placed: Placed, held: Placed, upcoming: int | None) -> float:
        """How much of the push of the next insertion a state bears, up to all of it (1)."""
        if upcoming is None or self.q.options.stability == PAPER:
            return 1.0
        return min(1.0, self.q.bearing(placed, held, upcoming).margin)

    def bears(self, placed: Placed, held: Placed, upcoming: int | None) -> bool:
        """Whether the next insertion leaves everything where it is, if that is asked for."""
        return not self.pushed or self.margin(placed, held, upcoming) >= 1.0

    def _support(
        self, placed: Placed, piece: int, before: Placed, held: Placed, upcoming: int | None
    ) -> Support:
        judgement = self.judge(placed, held)
        again, changes = len(held - before - {piece}), len(held - before)
        return Support(
            held,
            judgement.quality * max(SMALLEST_SHARE, self.margin(placed, held, upcoming)),
            (again, len(held), int(judgement.verdict == "clearance-dependent"), changes),
        )

    def can_hold(self, placed: Placed, upcoming: int | None, held: Placed) -> bool:
        """Whether every held piece has an assisting grasp clear of the next piece, its hand and the other
        hands."""
        if not held:
            return True
        key = (placed, upcoming, held)
        if key not in self._holdable:
            self._holdable[key] = self._can_hold(placed, upcoming, held)
        return self._holdable[key]

    def _can_hold(self, placed: Placed, upcoming: int | None, held: Placed) -> bool:
        if any((placed, piece, upcoming) in self.refused for piece in held):
            return False
        direction = None if upcoming is None else self.q.assemblability(upcoming, placed).direction
        if upcoming is not None and direction is None:
            return False
        if not all(self.q.can_assist(piece, placed, upcoming, direction) for piece in held):
            return False
        return len(held) < 2 or self.q.together(held, placed, upcoming, direction)

    def why_not(self, placed: Placed, upcoming: int | None) -> str:
        """Why no hold keeps a state up: numbers for every set of as many pieces as there are spare hands."""
        name = self.q.assembly.names
        text = self._alone(placed, upcoming)
        spare = self.hands - 1 if upcoming is not None else 0
        if upcoming is None:
            return f"{text}, and in the end no hand is left"
        if spare == 0:
            return f"{text}, and there is no hand to spare"
        useless, tried = [], []
        for held in map(frozenset, combinations(sorted(placed), min(spare, len(placed)))):
            label = " and ".join(name[k] for k in sorted(held))
            if not self.judge(placed, held).stands or not self.bears(placed, held, upcoming):
                useless.append(label)
            elif not self.can_hold(placed, upcoming, held):
                tried.append(f"{label} cannot be held: {self._ungraspable(placed, upcoming, held)}")
            else:
                tried.append(
                    f"{label} cannot be taken in time: no hand gets there while the others keep the state up"
                )
        if useless:
            tried.insert(0, f"with {' or '.join(useless)} held it does so too")
        return f"{text}; {'; '.join(tried)}"

    def _alone(self, placed: Placed, upcoming: int | None) -> str:
        """What becomes of a state that no hand holds."""
        state, name = self.judge(placed), self.q.assembly.names
        if not state.stands:
            return f"alone it {state.reason}"
        if upcoming is None or self.bears(placed, NOTHING, upcoming):
            return "alone it stands"
        bearing = self.q.bearing(placed, NOTHING, upcoming)
        what = "rubs along" if bearing.rubbed else "presses on"
        return (
            f"alone it is pushed apart: {name[upcoming]} {what} {name[bearing.piece]}, which bears "
            f"{bearing.margin:.2f} of the {'rubbing' if bearing.rubbed else 'push'}"
        )

    def _ungraspable(self, placed: Placed, upcoming: int, held: Placed) -> str:
        direction, name = self.q.assemblability(upcoming, placed).direction, self.q.assembly.names
        if direction is None:
            return f"{name[upcoming]} has no way in"
        for piece in sorted(held):
            if (placed, piece, upcoming) in self.refused:
                return "no grasp can take its load"
            count, left = (
                len(self.q.accessible(piece, placed)),
                len(self.q.assisting(piece, placed, upcoming, direction)),
            )
            if not left:
                return (
                    f"of its {count} accessible grasps none is clear of {name[upcoming]}, its way and its "
                    f"hand"
                )
        return "no two of their grasps are clear of each other"
