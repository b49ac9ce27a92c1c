"""How long a search may take, and how much it may keep: counted, so that the same search ends the same
way."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field
from itertools import count
from typing import Any

from soma_bullet.task.memo import Memo
from soma_bullet.task.search_options import SearchOptions

USUAL = SearchOptions()


class TooManyLines(Exception):
    """A search has made or checked as many lines as it may."""


@dataclass
class Effort:
    """What searches have done together.

    Attributes:
        most: lines of hands that there may be in all; lines: that were made or checked so far.
        for_order: that there may be for one order.
        until: lines that there may be when the search at hand ends.
        scenes: that are kept, of all searches.
        serial: gives each search a number.
    """

    most: int = USUAL.lines
    lines: int = 0
    for_order: int = USUAL.order_lines
    until: int = USUAL.lines
    scenes: Memo[Hashable, Any] = field(default_factory=lambda: Memo(USUAL.scenes))
    serial: count[int] = field(default_factory=count)

    @classmethod
    def of(cls, options: SearchOptions) -> Effort:
        """As much as the options allow, nothing of it spent."""
        return cls(
            options.lines, for_order=options.order_lines, until=options.lines, scenes=Memo(options.scenes)
        )

    def allow(self, lines: int) -> None:
        """The search at hand may make or check so many more lines."""
        self.until = min(self.most, self.lines + lines)

    @property
    def spent(self) -> bool:
        """Whether the search at hand has to end."""
        return self.lines >= min(self.until, self.most)

    @property
    def exhausted(self) -> bool:
        """Whether all searches have to end."""
        return self.lines >= self.most

    def spend(self) -> None:
        """Make or check a line. Raises TooManyLines."""
        if self.spent:
            raise TooManyLines
        self.lines += 1
