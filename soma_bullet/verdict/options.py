"""What counts as in place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from soma_bullet.option import POSITIVE, Options


@dataclass(frozen=True)
class Tolerance(Options):
    """What counts as in place."""

    names: ClassVar[Mapping[str, str]] = {"mm": "tolerance-mm", "deg": "tolerance-deg", "of": "tolerance-of"}

    mm: Annotated[float, POSITIVE] = 2.0
    """A piece is in place when its centre of mass is this near to its goal [mm] ..."""
    deg: Annotated[float, POSITIVE] = 2.0
    """... and it is turned by no more than this [deg]."""
    of: Literal["file", "nominal", "rest"] = "file"
    """What the goal is: the nominal one, or where the piece comes to rest when the gaps below it have closed,
    for which a wedge goes far; by default as the assembly's file says, and nominal where it does not."""
