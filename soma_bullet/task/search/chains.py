"""How a piece gets into a hand by a given grasp: picked from the table, or brought there by regrasps.

A chain is built backwards from the grasp that is wanted: the last regrasp first, then how its giver got the
piece. Fewer actions come first, and a hand-over before a put-down. Planned durations: a hand-over (carry,
approach, close, open, retreat, go home) adds about 7 s, a put-down (carry, lower, 10 mm at 10 mm/s, open,
retreat, and a pick) about 11 s.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np

from soma_bullet.grasp.graph import Grip
from soma_bullet.task.actions import hand_over, pick, put_down, square
from soma_bullet.task.actions.action import Action
from soma_bullet.task.search.planning import Fetch, Planning

Chain = tuple[Action, ...]
Regrasps = tuple[str, ...]  # "hand over" or "put down", in order
CHAINS: tuple[Regrasps, ...] = (
    ("hand over",),
    ("put down",),
    ("put down", "hand over"),
    ("hand over", "put down"),
    ("put down", "put down"),
)  # in the order of their cost
BRIEF = tuple(chain for chain in CHAINS if len(chain) == 1)


def chains(planning: Planning, fetch: Fetch, arm: int, grip: Grip, regrasps: Regrasps) -> Iterator[Chain]:
    """Actions with regrasps of the given kinds after which an arm has the piece by a grip."""
    if not regrasps:
        if fetch.carrying is None:
            picked = pick.check(planning, fetch, fetch.source, arm, grip)
            if picked is not None:
                yield *square.check(planning, fetch, arm, grip, picked), picked
        elif (arm, grip) == fetch.carrying:
            yield ()
    elif regrasps[-1] == "hand over":
        yield from _handed_over(planning, fetch, arm, grip, regrasps[:-1])
    else:
        yield from _from_another_place(planning, fetch, arm, grip, regrasps[:-1])


def _handed_over(planning: Planning, fetch: Fetch, arm: int, grip: Grip, before: Regrasps) -> Iterator[Chain]:
    for giver, held in hand_over.candidates(planning, fetch, arm, grip, before):
        for chain in islice(chains(planning, fetch, giver, held, before), 1):
            met = hand_over.check(planning, fetch, giver, held, arm, grip)
            if met is not None:
                yield *chain, met


def _from_another_place(
    planning: Planning, fetch: Fetch, arm: int, grip: Grip, before: Regrasps
) -> Iterator[Chain]:
    for rest in np.flatnonzero(planning.graph(fetch.piece).serving[:, grip.number]).tolist():
        for spot, giver, held in put_down.candidates(planning, fetch, rest, arm, grip, before):
            again = pick.check(planning, fetch, spot, arm, grip)
            if again is None:
                continue
            for chain in islice(chains(planning, fetch, giver, held, before), 1):
                down = put_down.check(planning, fetch, giver, held, spot)
                if down is not None:
                    yield *chain, down, again
