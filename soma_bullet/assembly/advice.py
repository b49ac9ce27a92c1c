"""What an assembly asks for, beside being built."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Advice:
    """How an assembly asks to be planned and judged, where nobody asks otherwise.

    Attributes:
        push: of the next insertion, that a hold must resist [N]; disturbance: the same sideways [g].
        stability, analyzers: what judges states, and steps beside the usual.
        tolerance_of: whether pieces should be at their `nominal` goals, or where they come to `rest`.
    """

    push: float | None = None
    disturbance: float | None = None
    stability: str | None = None
    analyzers: tuple[str, ...] = ()
    tolerance_of: Literal["nominal", "rest"] = "nominal"
