"""How grasps are sampled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from soma_bullet.option import NOT_NEGATIVE, POSITIVE, Options, Range


@dataclass(frozen=True)
class SamplingOptions(Options):
    """How grasps are sampled."""

    spacing: Annotated[float, POSITIVE] = 0.006
    """Largest step of the grid on the overlap of two opposite facets [m]."""
    rolls: Annotated[int, Range(1, 360)] = 8
    """Hand orientations about the closing axis."""
    smallest_contact: Annotated[float, Range(0, 1)] = 0.3
    """Fraction of the pad that must lie on both facets; of its length where they are curved."""
    smallest_width: Annotated[float, NOT_NEGATIVE] = 0.002
    """A thinner piece is not gripped [m]."""
    opening_margin: Annotated[float, NOT_NEGATIVE] = 0.004
    """What must remain between the open hand and the piece, on either side [m]."""
