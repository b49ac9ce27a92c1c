"""How long a schedule is searched for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from soma_bullet.option import Options, Range


@dataclass(frozen=True)
class SearchOptions(Options):
    """How long a schedule is searched for. Work is counted, not time, so that the same search ends alike on
    every machine."""

    lines: Annotated[int, Range(1)] = 60_000
    """Straight lines of a hand that are made or checked in all searches of an episode together, after which
    the search for a schedule ends: about 60 s on two cores."""
    order_lines: Annotated[int, Range(1)] = 36_000
    """The same for one order of the pieces, after which the next best order is tried."""
    orders: Annotated[int, Range(1)] = 12
    """Orders of the pieces that are tried, best first."""
    scenes: Annotated[int, Range(1)] = 120
    """Scenes for collision checks that are kept in memory at most, of 2 to 5 MB each."""
