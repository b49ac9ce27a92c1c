"""How the world is simulated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from soma_bullet.option import NOT_NEGATIVE, POSITIVE, Options, Range

SUBSTEPS = Range(1, 20)
FACTOR = Range(0, 10, above=True)


@dataclass(frozen=True)
class Physics(Options):
    """How the world is simulated; the defaults are measured to hold pieces without slip."""

    substeps: Annotated[int | None, SUBSTEPS] = None
    """Time steps for each sample of a trajectory; trajectories are fed at 480 Hz. By default the fewest in
    which no grip could bring the lightest piece to more than 6.5 m/s: one for pieces of 8 g and a grip of 25
    N."""
    solver: Literal["pgs", "dantzig"] = "pgs"
    """pgs iterates, with a friction cone; dantzig solves contacts between pieces exactly, with a friction
    pyramid that holds up to 1.4 times too much along its diagonals. What the robot touches is iterated in
    either."""
    iterations: Annotated[int, Range(1, 10_000)] = 60
    """Iterations of the solver a step; 25 hold a piece as firmly as it can be gripped, more let it creep less
    in motion."""
    gravity: Annotated[float, Range(0, 100)] = 9.81
    """Downward acceleration [m/s2] of the simulated world; the planner does not know."""
    grip_force: Annotated[float | None, POSITIVE] = None
    """Force of a hand's grip [N]; the hand's own by default."""
    friction: Annotated[float, FACTOR] = 1.0
    """Factor on every friction coefficient of the simulated world; the planner does not know."""
    mass: Annotated[float, FACTOR] = 1.0
    """Factor on every piece's mass; the planner does not know."""
    asleep: Annotated[float, NOT_NEGATIVE] = 1e-6
    """Speed [m/s, rad/s] below which a piece is at rest; one that touches only fixtures and pieces at rest is
    left as it is until anything else comes near. 0: none ever is."""
    record_every: Annotated[int, Range(1, 480)] = 5
    """Samples of a trajectory between two samples of the log."""
