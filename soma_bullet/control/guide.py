"""Compliant insertion: the wrist's force and torque guide the last millimetres.

Along the insertion the hand slows down as the resistance grows (damping control); sideways it yields to the
force (admittance); where it meets resistance before the end it searches along an Archimedean spiral for the
opening (blind spiral search: W. Newman et al., ICRA 2001; H. Park et al., IEEE T-IE 2017), and where it finds
none, again with the piece turned about the insertion's direction, one way and the other. Past the rim it
yields to torques about that direction as well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from soma_bullet.control.options import Compliance
from soma_bullet.frames import Array, tangents

PROGRESS = 0.1e-3  # [m] deeper than before: what gets so far yields to the force and is led around no more
PATIENCE = 0.05  # [s] of resistance before a search begins
# [s] without getting deeper since the first resistance after which it begins where that comes and goes, too
BOUNCING = 0.3
STALLED = 90.0  # [s] without getting deeper after which it gives up: longer than all searches take


def scaled(compliance: Compliance, scale: float) -> Compliance:
    """How a hand yields with workpieces that are `scale` times as large: forces and lengths grow with it."""
    names = ("press", "search", "dead", "pitch", "reach", "inside", "entry", "limit")
    return replace(compliance, **{name: scale * getattr(compliance, name) for name in names})


def gentle(compliance: Compliance, share: float) -> Compliance:
    """How a hand yields that may press with a share of the usual only."""
    names = ("press", "search", "limit")
    return replace(compliance, **{name: share * getattr(compliance, name) for name in names})


class Guide:
    """Where one insertion has got to: how far aside the hand is, and how fast it may go on.

    Attributes:
        offset: of the hand from its path (3,) [m].
        twist: by which the hand has turned about the direction of the insertion [rad].
        waited: how long it has met resistance without getting deeper [s].
        failed: why it gives up; empty while it does not.
    """

    def __init__(self, direction: Array, compliance: Compliance):
        self.direction, self.compliance = np.asarray(direction, float), compliance
        self._across = tangents(self.direction)
        self.offset = np.zeros(3)
        self._centre = np.zeros(3)
        self.twist = 0.0
        self._straight = 0.0  # [rad] twist from which a search turns the piece
        self._searches = 0  # that have found nothing, at this place
        self._turned = 0.0  # [rad] along the spiral
        self._left = np.inf
        self._met = np.inf  # [m] what was left where it last met resistance
        self._rim = -np.inf  # [m] what was left where it first did
        self._stalled = 0.0  # [s] since it last got deeper
        self._bounced = 0.0  # [s] since it met resistance that it has not got past
        self.waited = 0.0
        self.failed = ""

    @property
    def searching(self) -> bool:
        """Whether the hand is on its spiral."""
        return self._turned > 0.0

    @property
    def held_up(self) -> float:
        """How long it has met resistance, on and off, without getting deeper [s]."""
        return self._bounced

    def update(self, load: Array, dt: float, left: float = np.inf, near: bool = False) -> float:
        """Take the load of the hand after `dt` [s]; returns the speed as a fraction of the planned.

        Args:
            load: force on the hand [N] and torque about its centre [N m] in the world (6,).
            left: of the way [m]: what gets deeper has found the opening, and yields sideways instead of
                searching on.
            near: it may rest on what it meets so near to its end, and does not search.
        """
        c, force = self.compliance, load[:3]
        resistance = -float(force @ self.direction)
        aside = force + resistance * self.direction
        if float(np.linalg.norm(force)) > c.limit:
            self.failed = "force"
        self.waited = self.waited + dt if resistance > c.search else 0.0
        if resistance > c.search:
            self._met, self._rim = left, max(self._rim, left)
        if resistance > c.search or self._bounced:
            self._bounced += dt
        self._stalled += dt
        if left < self._left - PROGRESS:
            self._left, self.waited, self._stalled, self._bounced = left, 0.0, 0.0, 0.0
            self._stop()
        if self._stalled > STALLED:
            self.failed = "not found"
        again = self.searching or self._bounced > BOUNCING
        if not near and (self.waited > PATIENCE or (again and resistance > c.search / 2)):
            self._search(dt)
        elif (
            near or not self.searching
        ):  # a search pauses where the resistance does: it may be above the opening
            self._stop()
            size = float(np.linalg.norm(aside))
            if size > c.dead:
                self.offset = self._bounded(self.offset + aside * (1.0 - c.dead / size) * c.give * dt)
                self._centre = self.offset
            if not near and left < self._rim - c.inside:
                self._yield(float(load[3:] @ self.direction), dt)
        fastest = c.careful if left > self._met - c.entry else 1.0
        return float(
            np.clip(1.0 - resistance / c.press, -1.0 if near else -fastest, fastest)
        )  # fast, it would bounce

    def _yield(self, torque: float, dt: float) -> None:
        """Turn as a torque [N m] about the direction asks."""
        c = self.compliance
        beyond = np.sign(torque) * max(abs(torque) - c.slack, 0.0)
        self.twist = self._straight = float(np.clip(self.twist + beyond * c.twist * dt, -c.most, c.most))

    def _stop(self) -> None:
        if self.searching:
            self._turned, self._centre, self._straight, self._searches = 0.0, self.offset, self.twist, 0

    def _search(self, dt: float) -> None:
        """One step along the spiral: outwards, with the piece turned back inwards, and so on."""
        c = self.compliance
        per_turn = c.pitch / (2 * np.pi)
        step = c.speed * dt / max(per_turn * self._turned, c.pitch)
        inwards = self._searches % 2 == 1
        self._turned += -step if inwards else step
        radius = per_turn * self._turned
        farthest = c.reach + float(np.linalg.norm(self._centre))
        if (self._turned < step) if inwards else (radius > farthest):  # all within reach has been tried
            self._searches += 1
            self._turned -= -step if inwards else step
            if self._searches == len(c.turns):
                self.failed = "not found"
            return
        wanted = float(np.clip(self._straight + c.turns[self._searches], -c.most, c.most))
        self.twist += float(np.clip(wanted - self.twist, -c.turning * dt, c.turning * dt))
        first, second = self._across
        aside = radius * (np.cos(self._turned) * first + np.sin(self._turned) * second)
        self.offset = self._bounded(self._centre + aside)

    def _bounded(self, offset: Array) -> Array:
        length = float(np.linalg.norm(offset))
        return offset * min(1.0, self.compliance.reach / max(length, 1e-12))
