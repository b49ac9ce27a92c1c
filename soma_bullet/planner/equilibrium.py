"""Static equilibrium of a whole placed set, and how much horizontal acceleration it resists.

Every placed piece is free except the held ones; contacts push and rub with action and reaction on every patch. The margin is
the smallest, over horizontal directions, of the largest acceleration (in g) for which contact forces in equilibrium exist:
one linear program a direction, maximise t subject to A lambda + w + t D(theta) = 0, lambda >= 0.

Source of the formulation: E. Whiting, J. Ochsendorf, F. Durand, "Procedural modeling of structurally-sound masonry
buildings", SIGGRAPH Asia 2009 (rigid blocks, linearised friction).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import highspy
import numpy as np
import shapely

from soma_bullet.assembly.contacts import SUPPORT, Contact
from soma_bullet.assembly.facets import outline_vertices
from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import Array, tangents

Sides = Literal["dropped", "frictionless", "friction"]
Verdict = Literal["robust", "clearance-dependent", "unstable"]

SIDE = 0.1  # |n_z| below this is a side contact
PYRAMID = 12  # sides of the friction pyramid; its radius is the mean of inscribed and circumscribed
DIRECTIONS = 24  # horizontal directions of the assembly frame
TIE = 1e-3  # [g] a margin up to this is none
LARGEST = 1e3  # [g] stands for "no limit"


@dataclass(frozen=True)
class StateStability:
    """Stability of a placed set.

    Attributes:
        verdict: robust without side contacts, clearance-dependent where frictionless side contacts are needed, else unstable.
        margin: horizontal acceleration resisted without side contacts [g].
        margin_sides: ... with frictionless side contacts [g].
    """

    verdict: Verdict
    margin: float
    margin_sides: float

    @property
    def quality(self) -> float:
        """The S that enters the score: robust up to 1 g; every clearance-dependent value lies below every robust one."""
        if self.verdict == "robust":
            return min(self.margin, 1.0)
        if self.verdict == "clearance-dependent":
            return min(0.1 * self.margin_sides, TIE)
        return 0.0


def classify(assembly: Assembly, placed: frozenset[int], held: frozenset[int] = frozenset()) -> StateStability:
    """Stability of the placed set with some pieces held, each a fixed body whose hand never pushes others down."""
    # rounded: the solver's last digits must not choose between states that are equal
    margin = round(equilibrium_margin(assembly, placed, held, "dropped"), 9)
    sides = margin if margin > TIE else round(equilibrium_margin(assembly, placed, held, "frictionless"), 9)
    verdict: Verdict = "robust" if margin > TIE else "clearance-dependent" if sides > TIE else "unstable"
    return StateStability(verdict, margin, sides)


def equilibrium_margin(
    assembly: Assembly, placed: frozenset[int], held: frozenset[int] = frozenset(), sides: Sides = "dropped"
) -> float:
    """Smallest horizontal acceleration [g] that topples or slides the placed set; 0 where it cannot stand at all."""
    free = sorted(placed - held)
    if not free:
        return LARGEST
    contacts = active_contacts(assembly, placed, held, sides)
    columns = [contact_columns(c, assembly, free, held, sides) for c in contacts]
    lengths = np.array([assembly.pieces[i].radius for i in free])
    masses = np.array([assembly.pieces[i].mass for i in free])
    weights = masses / masses.mean()
    program = RayProgram(np.hstack(columns) if columns else np.zeros((6 * len(free), 0)), _scaling(lengths))
    gravity = np.zeros((len(free), 6))
    gravity[:, 2] = -weights
    margins = []
    for angle in disturbance_angles(assembly, placed):
        push = np.zeros((len(free), 6))
        push[:, 0], push[:, 1] = np.cos(angle) * weights, np.sin(angle) * weights
        margins.append(program.farthest(gravity.ravel(), push.ravel()))
        if margins[-1] <= 0.0:
            return 0.0
    return float(min(margins))


def active_contacts(assembly: Assembly, placed: frozenset[int], held: frozenset[int], sides: Sides) -> list[Contact]:
    """Contacts among the placed pieces that act in a variant and touch a free piece."""
    chosen = []
    for contact in assembly.contacts:
        bodies = {contact.body_a, contact.body_b} - {SUPPORT}
        if not bodies <= placed or bodies <= held:
            continue
        if sides == "dropped" and abs(contact.normal[2]) < SIDE:
            continue
        chosen.append(contact)
    return chosen


def contact_columns(contact: Contact, assembly: Assembly, free: Sequence[int], held: frozenset[int], sides: Sides) -> Array:
    """Wrenches (6 * free, m) on the free bodies, about their centres of mass, of unit forces at the patch's corners."""
    forces = contact_forces(contact, friction_of(contact, assembly), frictionless(contact, held, sides))
    columns = np.zeros((6 * len(free), len(contact.points) * len(forces)))
    for body, sign in ((contact.body_b, 1.0), (contact.body_a, -1.0)):
        if body not in free:
            continue
        row = 6 * free.index(body)
        arms = contact.points - assembly.goal_centres[body]
        columns[row : row + 3] = sign * np.tile(forces.T, len(contact.points))
        columns[row + 3 : row + 6] = sign * np.cross(arms[:, None], forces[None]).reshape(-1, 3).T
    return columns


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
        assembly.support.friction if k == SUPPORT else assembly.pieces[k].friction for k in (contact.body_a, contact.body_b)
    )
    return float(np.sqrt(first * second))


def frictionless(contact: Contact, held: frozenset[int], sides: Sides) -> bool:
    """Whether the patch may not count on friction: sides, and patches through which a held piece presses another down.

    The load of the latter would be a preload of the hand, which must not be assumed: they still block, without rubbing.
    """
    if sides != "friction" and abs(contact.normal[2]) < SIDE:
        return True
    presses_down = (contact.body_a in held and contact.normal[2] < -SIDE) or (
        contact.body_b in held and contact.normal[2] > SIDE
    )
    return presses_down


def disturbance_angles(assembly: Assembly, placed: frozenset[int]) -> Array:
    """Horizontal directions [rad]: a regular fan of the assembly frame, and the normals of the support polygon's edges."""
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


class RayProgram:
    """max t, subject to columns @ lambda + load + t * push = 0, lambda >= 0 (and optional bounds): one model, many rays."""

    def __init__(self, columns: Array, scaling: Array, upper_rows: tuple[Array, Array] | None = None):
        self.scaling = scaling
        rows, count = columns.shape
        extra, limits = upper_rows if upper_rows is not None else (np.zeros((0, count)), np.zeros(0))
        self.rows = rows
        matrix = np.vstack([columns * scaling[:, None], extra])
        program = highspy.HighsLp()
        program.num_col_, program.num_row_ = count + 1, rows + len(extra)
        program.col_cost_ = np.concatenate([np.zeros(count), [-1.0]])
        program.col_lower_ = np.zeros(count + 1)
        program.col_upper_ = np.concatenate([np.full(count, highspy.kHighsInf), [LARGEST]])
        program.row_lower_ = np.concatenate([np.zeros(rows), np.full(len(extra), -highspy.kHighsInf)])
        program.row_upper_ = np.concatenate([np.zeros(rows), limits])
        column, row = np.nonzero(np.abs(matrix.T) > 1e-12)
        starts = np.searchsorted(column, np.arange(count + 2))  # the last column is the push, set for each ray
        program.a_matrix_.format_ = highspy.MatrixFormat.kColwise
        program.a_matrix_.start_ = starts.astype(np.int32)
        program.a_matrix_.index_ = row.astype(np.int32)
        program.a_matrix_.value_ = matrix[row, column]
        self.solver: Any = highspy.Highs()  # its stubs lack half of its methods
        self.solver.silent()
        self.solver.setOptionValue("presolve", "off")
        self.solver.setOptionValue("threads", 1)
        self.solver.passModel(program)
        self.last = count

    def farthest(self, load: Array, push: Array) -> float:
        """Largest t in [0, LARGEST]; -1 where even t = 0 has no solution. load, push: (rows,)."""
        bounds = -load * self.scaling
        every = np.arange(self.rows, dtype=np.int32)
        self.solver.changeRowsBounds(self.rows, every, bounds, bounds)
        for row, amount in enumerate(push * self.scaling):
            self.solver.changeCoeff(row, self.last, float(amount))
        self.solver.run()
        if self.solver.getModelStatus() != highspy.HighsModelStatus.kOptimal:
            return -1.0
        return float(self.solver.getInfo().objective_function_value) * -1.0
