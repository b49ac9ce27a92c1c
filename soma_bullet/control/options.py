"""How a program is executed, and how a hand yields."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from soma_bullet.option import NOT_NEGATIVE, POSITIVE, Options, Range


@dataclass(frozen=True)
class Compliance(Options):
    """How a hand yields to what it meets in an insertion."""

    press: Annotated[float, POSITIVE] = 1.5
    """Resistance [N] at which the hand advances no further; beyond it, it backs off."""
    search: Annotated[float, POSITIVE] = 0.5
    """Resistance [N] from which it searches."""
    give: Annotated[float, NOT_NEGATIVE] = 20e-3
    """Sideways speed for each newton [m/s/N] of forces beyond `dead`; slower, a piece tilts in the hand on
    the rim."""
    dead: Annotated[float, NOT_NEGATIVE] = 0.06
    """Sideways force [N] to which it does not yield."""
    speed: Annotated[float, POSITIVE] = 6e-3
    """Speed of the search [m/s]."""
    pitch: Annotated[float, POSITIVE] = 0.25e-3
    """Distance between two turns of the spiral of the search [m]."""
    reach: Annotated[float, NOT_NEGATIVE] = 1.6e-3
    """How far aside of its path the hand may get [m]."""
    turns: tuple[Annotated[float, Range(-3.2, 3.2)], ...] = (0.0, 0.026, -0.026)
    """Angles by which the piece is turned in one search after the other, from how it came [rad]."""
    twist: Annotated[float, NOT_NEGATIVE] = 25.0
    """Turning speed for each newton metre about the direction of the insertion [rad/s/(N m)] of torques
    beyond `slack`, once it is `inside`: the torque of a rim on which a piece stands says nothing about how it
    should turn. As sideways, at a lever of 20 mm."""
    slack: Annotated[float, NOT_NEGATIVE] = 1.2e-3
    """Torque about the direction of the insertion [N m] to which it does not yield."""
    inside: Annotated[float, NOT_NEGATIVE] = 1e-3
    """How much deeper than where it first met resistance it yields to torques [m]."""
    turning: Annotated[float, POSITIVE] = 0.1
    """Speed at which the hand turns from one search to the next [rad/s]."""
    most: Annotated[float, NOT_NEGATIVE] = 0.045
    """How far the hand may turn [rad]."""
    careful: Annotated[float, Range(0, 1, above=True)] = 0.25
    """Largest fraction of the planned speed, in and out, until the hand is `entry` deeper than where it last
    met resistance: what comes in over an edge at speed pushes aside what it comes into; what goes back at
    speed bounces."""
    entry: Annotated[float, NOT_NEGATIVE] = 2e-3
    """How much deeper than where it last met resistance it goes on at full speed [m]."""
    limit: Annotated[float, POSITIVE] = 14.0
    """Force at which the insertion is given up [N]."""


@dataclass(frozen=True)
class ExecutionOptions(Options):
    """How a program is executed."""

    together: bool = True
    """The arms move at the same time where it is safe; --execution.no-together: one at a time."""
    compliant: bool = True
    """The wrist's force guides insertions; --execution.no-compliant: they stop at the first touch."""
    recover: bool = True
    """What does not go as planned is tried again where possible; --execution.no-recover: it ends the
    episode."""
    look: Literal["never", "placed", "each"] = "placed"
    """When it is looked whether the placed pieces are where they should be: `never` before the end, after
    each piece that is `placed`, or after `each` thing that a hand does. What was displaced is placed
    again."""
    longest: Annotated[float, Range(0, 1e5, above=True)] = 900.0
    """Simulated time [s] after which an episode is ended."""
    compliance: Compliance = Compliance()
    """How a hand yields to what it meets in an insertion."""
