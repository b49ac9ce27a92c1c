"""How long a search may take, and how much it may keep: counted, so that the same search ends the same
way."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field
from itertools import count
from typing import Any

from soma_bullet.task.memo import Memo

LINES = 60_000  # of hands made or checked, about 60 s on two cores
SCENES = 120  # for collision checks, of 2 to 5 MB each


class TooManyLines(Exception):
    """A search has made or checked as many lines as it may."""


@dataclass
class Effort:
    """What searches have done together.

    Attributes:
        most: lines of hands that there may be in all; lines: that were made or checked so far.
        until: lines that there may be when the search at hand ends.
        scenes: that are kept, of all searches.
        serial: gives each search a number.
    """

    most: int = LINES
    lines: int = 0
    until: int = LINES
    scenes: Memo[Hashable, Any] = field(default_factory=lambda: Memo(SCENES))
    serial: count[int] = field(default_factory=count)

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
