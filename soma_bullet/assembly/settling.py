"""Where pieces come to rest: each is put down at its goal, and goes on until the gaps below it are closed.

A linear program: small shifts of all pieces, without turning, that lower the assembly's potential energy as
far as the contacts let them, and lift nothing. What lies on a slope that friction holds does not slide along
it; what is steeper slides, as a wedge does that a hand presses home, and it pushes aside what lies level."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linprog

from soma_bullet.assembly.contacts import SUPPORT, Contact
from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import Array, readonly, tangents

FARTHEST = 100.0  # clearances that a piece may go
BELIEVED = 30.0  # clearances: what would go farther is held by friction, and only drops
LEVEL = 0.999  # upward part of the normal of a face that is level
SIDEWAYS = 1e-3  # of the weight: what a shift aside costs, so that nothing moves without need


def rest_shifts(assembly: Assembly) -> Array:
    """Shifts (n, 3) [m] from the nominal goals to where the pieces come to rest, in the assembly frame."""
    count = len(assembly.pieces)
    clearance = max(piece.clearance for piece in assembly.pieces)
    if clearance <= 0.0:
        return readonly(np.zeros((count, 3)))
    rows, gaps, equal = [], [], []
    for contact in assembly.contacts:
        pair = _row(contact, contact.normal, count)
        rows.append(-pair)
        gaps.append(_gap(contact, assembly))
        if _sticks(contact, assembly):
            equal += [_row(contact, tangent, count) for tangent in tangents(contact.normal)]
    # variables: shifts, then the sizes of their parts along x and y
    weight = np.array([piece.mass for piece in assembly.pieces])
    weight = weight / weight.sum()
    cost = np.concatenate([np.outer(weight, (0.0, 0.0, 1.0)).ravel(), np.repeat(SIDEWAYS * weight, 2)])
    size = np.zeros((4 * count, 5 * count))
    for k in range(count):
        for axis in (0, 1):
            for n, sign in enumerate((1.0, -1.0)):
                row = 4 * k + 2 * axis + n
                size[row, 3 * k + axis], size[row, 3 * count + 2 * k + axis] = sign, -1.0
    wide = lambda block: np.hstack([block, np.zeros((len(block), 2 * count))])  # noqa: E731
    most = FARTHEST * clearance
    found = linprog(
        cost,
        A_ub=np.vstack([wide(np.array(rows).reshape(-1, 3 * count)), size]),
        b_ub=np.concatenate([gaps, np.zeros(4 * count)]),
        A_eq=wide(np.array(equal)) if equal else None,
        b_eq=np.zeros(len(equal)) if equal else None,
        bounds=[(-most, most), (-most, most), (-most, 0.0)] * count + [(0.0, most)] * (2 * count),
        method="highs",
    )
    drops = np.column_stack([np.zeros((count, 2)), -assembly.drops])
    if not found.success:
        return readonly(drops)
    shifts = found.x[: 3 * count].reshape(count, 3)
    lost = np.abs(shifts).max(axis=1) > BELIEVED * clearance
    return readonly(np.where(lost[:, None], drops, np.round(shifts, 9) + 0.0))


def _row(contact: Contact, along: Array, count: int) -> Array:
    """Of body b against body a along a direction (3,), as coefficients of the shifts (3 n,)."""
    row = np.zeros(3 * count)
    for body, sign in ((contact.body_a, -1.0), (contact.body_b, 1.0)):
        if body != SUPPORT:
            row[3 * body : 3 * body + 3] = sign * along
    return row


def _gap(contact: Contact, assembly: Assembly) -> float:
    return sum(assembly.pieces[k].clearance for k in (contact.body_a, contact.body_b) if k != SUPPORT)


def _sticks(contact: Contact, assembly: Assembly) -> bool:
    """Whether one body would slide down along the other if friction did not keep it from that."""
    bodies = (contact.body_a, contact.body_b)
    friction = (assembly.support.friction if k == SUPPORT else assembly.pieces[k].friction for k in bodies)
    level = abs(float(contact.normal[2]))
    return 1.0 / np.sqrt(1.0 + np.prod(list(friction))) < level < LEVEL
