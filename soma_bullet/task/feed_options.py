"""How the pieces are fed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from soma_bullet.option import NOT_NEGATIVE, Options

SIGMAS = 3.0  # of the noise of perception that a hand makes room for


@dataclass(frozen=True)
class FeedOptions(Options):
    """How the pieces are fed."""

    layout: Literal["random", "rows"] = "random"
    """random: anywhere in the feed areas, at any yaw; rows: spread out evenly, without yaw."""
    noise_mm: Annotated[float, NOT_NEGATIVE] = 0.0
    """One sigma of the error of the perceived places in x and y [mm]: pieces really lie elsewhere. Of uniform
    errors the largest, in any direction."""
    noise_deg: Annotated[float, NOT_NEGATIVE] = 0.0
    """One sigma of the error of the perceived yaw [deg]; of uniform errors the largest."""
    poses: Literal["all", "preferred"] = "all"
    """all: in any pose in which a piece rests steadily; preferred: in that with the most grasps that serve at
    the goal too, as rows always does."""
    errors: Literal["normal", "uniform"] = "normal"
    """How the errors of perception are spread: normal, or uniform over a disc and an interval."""
    square: bool = True
    """Inexactly perceived pieces are squared before they are picked; --feed.no-square: they are picked as
    seen."""

    @property
    def noise(self) -> tuple[float, float]:
        """One sigma of the errors [mm], [deg], as in `Feed`; of uniform ones what has them end at SIGMAS
        times that."""
        if self.errors == "uniform":
            return self.noise_mm / SIGMAS, self.noise_deg / SIGMAS
        return self.noise_mm, self.noise_deg
