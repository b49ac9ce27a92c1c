"""Static equilibrium of a whole placed set, and how much horizontal acceleration it resists.

Every placed piece is free except the held ones; contacts push and rub with action and reaction on every
patch. The margin is the smallest, over horizontal directions, of the largest acceleration t (in g) for which
contact forces in equilibrium exist: A lambda + w + t D(theta) = 0, lambda >= 0. These accelerations fill a
convex polygon, whose corners are found as needed.

Source of the formulation: E. Whiting, J. Ochsendorf, F. Durand, "Procedural modeling of structurally-sound
masonry buildings", SIGGRAPH Asia 2009 (rigid blocks, linearised friction)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
import shapely

from soma_bullet.assembly.contacts import SUPPORT, Contact
from soma_bullet.assembly.facets import outline_vertices
from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import Array, tangents
from soma_bullet.planner.programs import LARGEST, PushRegion

Sides = Literal["settled", "dropped", "frictionless", "friction"]
Verdict = Literal["robust", "fragile", "clearance-dependent", "unstable"]
FIRM = ("robust", "fragile")  # verdicts of states that need no side contacts

SIDE = 0.1  # |n_z| below this is a side contact
PYRAMID = 12  # sides of the friction pyramid; its radius is the mean of inscribed and circumscribed
# A contact that stays open when the pieces have settled closes once one of them leans by the opening. The
# margin must allow for that lean: twice, since a body that starts to tip overshoots, in each of a stack of
# three.
LEAN = 6.0
DIRECTIONS = 24  # horizontal directions of the assembly frame
CLOSED = 1e-6  # [m] a smaller opening is none
TIE = 1e-3  # [g] a margin up to this is none


@dataclass(frozen=True)
class StateStability:
    """Stability of a placed set.

    Attributes:
        verdict: robust without side contacts; fragile, where it resists less than is done to it;
            clearance-dependent where it takes frictionless side contacts, or contacts that the fit clearance
            leaves open; else unstable.
        margin: horizontal acceleration resisted without side contacts [g].
        margin_sides: ... with frictionless side contacts [g].
    """

    verdict: Verdict
    margin: float
    margin_sides: float

    @property
    def quality(self) -> float:
        """The S that enters the score: robust up to 1 g; every clearance-dependent value lies below every
        robust one."""
        if self.verdict in FIRM:
            return min(self.margin, 1.0)
        if self.verdict == "clearance-dependent":
            return min(0.1 * self.margin_sides, TIE)
        return 0.0


def classify(
    assembly: Assembly, placed: frozenset[int], held: frozenset[int] = frozenset(), least: float = 0.0
) -> StateStability:
    """Stability of the placed set with some pieces held, each a fixed body whose hand never pushes others
    down.

    Args:
        least: what is done to a state sideways [g]: one that resists less is fragile.
    """
    # rounded: the solver's last digits must not choose between states that are equal
    margin = round(equilibrium_margin(assembly, placed, held, "dropped"), 9)
    sides = margin if margin > TIE else round(equilibrium_margin(assembly, placed, held, "frictionless"), 9)
    if TIE < margin <= LEAN * _widest_opening(assembly, placed):
        robust = equilibrium_margin(assembly, placed, held, "settled") > TIE
        sides = margin if robust else round(equilibrium_margin(assembly, placed, held, "frictionless"), 9)
        return StateStability(_firm(margin, least) if robust else "clearance-dependent", margin, sides)
    if margin > TIE:
        return StateStability(_firm(margin, least), margin, sides)
    return StateStability("clearance-dependent" if sides > TIE else "unstable", margin, sides)


def _firm(margin: float, least: float) -> Verdict:
    return "robust" if margin >= least else "fragile"


def equilibrium_margin(
    assembly: Assembly, placed: frozenset[int], held: frozenset[int] = frozenset(), sides: Sides = "dropped"
) -> float:
    """Smallest horizontal acceleration [g] that topples or slides the placed set; 0 where it cannot stand at
    all."""
    free = sorted(placed - held)
    if not free:
        return LARGEST
    contacts = active_contacts(assembly, placed, held, sides)
    columns = [contact_columns(c, assembly, free, held, sides) for c in contacts]
    lengths = np.array([assembly.pieces[i].radius for i in free])
    masses = np.array([assembly.pieces[i].mass for i in free])
    weights = masses / masses.mean()
    matrix = np.hstack(columns) if columns else np.zeros((6 * len(free), 0))
    gravity = np.zeros((len(free), 6))
    gravity[:, 2] = -weights

    push = np.zeros((2, len(free), 6))
    push[0, :, 0] = push[1, :, 1] = weights
    region = PushRegion(matrix, _scaling(lengths), gravity.ravel(), push.reshape(2, -1), LARGEST)
    return region.smallest_reach(disturbance_angles(assembly, placed))


def active_contacts(
    assembly: Assembly, placed: frozenset[int], held: frozenset[int], sides: Sides
) -> list[Contact]:
    """Contacts among the placed pieces that act in a variant and touch a free piece."""
    chosen, drops = [], assembly.drops_of(placed)
    for contact in assembly.contacts:
        bodies = {contact.body_a, contact.body_b} - {SUPPORT}
        if not bodies <= placed or bodies <= held:
            continue
        if sides in ("settled", "dropped") and abs(contact.normal[2]) < SIDE:
            continue
        if sides == "settled" and _opening(contact, assembly, drops) > CLOSED:
            continue
        chosen.append(contact)
    return chosen


def _opening(contact: Contact, assembly: Assembly, drops: Array) -> float:
    """Gap [m] that a patch with a vertical part keeps when the pieces have settled by `drops` (n,) [m]."""
    if SUPPORT in (contact.body_a, contact.body_b):
        return 0.0
    above = contact.body_b if contact.normal[2] > 0 else contact.body_a
    below = contact.body_a + contact.body_b - above
    gap = sum(assembly.gaps_at(contact))
    return float(gap - (drops[above] - drops[below]) * abs(contact.normal[2]))


def _widest_opening(assembly: Assembly, placed: frozenset[int]) -> float:
    """Largest opening of the settled state, as the angle [rad] by which a piece leans to close it."""
    drops = assembly.drops_of(placed)
    open_by = [
        _opening(contact, assembly, drops) / (contact.width or _smaller_radius(contact, assembly))
        for contact in assembly.contacts
        if abs(contact.normal[2]) >= SIDE and {contact.body_a, contact.body_b} - {SUPPORT} <= placed
    ]
    return float(max(open_by, default=0.0))


def _smaller_radius(contact: Contact, assembly: Assembly) -> float:
    """Radius [m] of the smaller piece at a contact: what leans about a point."""
    bodies = {contact.body_a, contact.body_b} - {SUPPORT}
    return min(assembly.pieces[body].radius for body in bodies)


def contact_columns(
    contact: Contact, assembly: Assembly, free: Sequence[int], held: frozenset[int], sides: Sides
) -> Array:
    """Wrenches (6 * free, m) on the free bodies, about their centres of mass, of unit forces at the patch's
    corners."""
    smooth = frictionless(contact, held, sides)
    blocks = {
        body: _wrenches(contact, assembly, body, smooth)
        for body in (contact.body_a, contact.body_b)
        if body in free
    }
    columns = np.zeros((6 * len(free), next(iter(blocks.values())).shape[1]))
    for body, block in blocks.items():
        row = 6 * free.index(body)
        columns[row : row + 6] = block
    return columns


@lru_cache(maxsize=4096)
def _wrenches(contact: Contact, assembly: Assembly, body: int, smooth: bool) -> Array:
    """Wrenches (6, m) on one body of unit forces at the patch's corners."""
    forces = contact_forces(contact, friction_of(contact, assembly), smooth)
    arms = contact.points - assembly.goal_centres[body]
    torques = np.cross(arms[:, None], forces[None]).reshape(-1, 3)
    return (1.0 if body == contact.body_b else -1.0) * np.vstack(
        [np.tile(forces.T, len(contact.points)), torques.T]
    )


def contact_forces(contact: Contact, mu: float, smooth: bool) -> Array:
    """Generators (m, 3) of the force on body b at a point of the patch."""
    if smooth or mu == 0.0:
        return contact.normal[None]
    t, b = tangents(contact.normal)
    angles = 2 * np.pi * np.arange(PYRAMID) / PYRAMID
    radius = mu * 2 / (1 + np.cos(np.pi / PYRAMID))
    return contact.normal + radius * (np.cos(angles)[:, None] * t + np.sin(angles)[:, None] * b)


def friction_of(contact: Contact, assembly: Assembly) -> float:
    """Coulomb coefficient of a patch: the geometric mean of the two bodies'."""
    first, second = (
        assembly.support.friction if k == SUPPORT else assembly.pieces[k].friction
        for k in (contact.body_a, contact.body_b)
    )
    return float(np.sqrt(first * second))


def frictionless(contact: Contact, held: frozenset[int], sides: Sides) -> bool:
    """Whether the patch may not count on friction: sides, and patches through which a held piece presses
    another down.

    The load of the latter would be a preload of the hand, which must not be assumed: they still block,
    without rubbing."""
    if sides != "friction" and abs(contact.normal[2]) < SIDE:
        return True
    return presses_down(contact, held)


def presses_down(contact: Contact, held: frozenset[int]) -> bool:
    """Whether a held piece lies on another by a patch."""
    return (contact.body_a in held and contact.normal[2] < -SIDE) or (
        contact.body_b in held and contact.normal[2] > SIDE
    )


def disturbance_angles(assembly: Assembly, placed: frozenset[int]) -> Array:
    """Horizontal directions [rad]: a regular fan of the assembly frame, and the normals of the support
    polygon's edges."""
    regular = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    feet = [c.points[:, :2] for c in assembly.contacts if c.body_a == SUPPORT and c.body_b in placed]
    if not feet:
        return regular
    corners = outline_vertices(shapely.multipoints(np.vstack(feet)))
    edges = np.roll(corners, -1, axis=0) - corners
    normals = np.arctan2(-edges[:, 0], edges[:, 1])
    return np.unique(np.round(np.concatenate([regular, normals % (2 * np.pi)]), 9))


def _scaling(lengths: Array) -> Array:
    """Row scales that make torques comparable with forces (6 * bodies,)."""
    return np.concatenate([[1, 1, 1, 1 / r, 1 / r, 1 / r] for r in lengths])
