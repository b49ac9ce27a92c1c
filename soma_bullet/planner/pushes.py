"""What an insertion does to the pieces that are placed already, and what these can bear.

A piece that comes in presses on what it meets along its direction, may catch at the rim of what it has to get
in between, and rubs along what it slides by. Placed pieces that no hand holds stay where they are by their
weight and friction alone. The question is the one of a hold's certificate, asked of every insertion: with how
much force may the piece press before the rest moves?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from soma_bullet.assembly.contacts import SUPPORT, Contact
from soma_bullet.assembly.model import Assembly
from soma_bullet.frames import Array
from soma_bullet.planner.assist import GRAVITY
from soma_bullet.planner.equilibrium import SIDE, active_contacts, contact_columns, friction_of, presses_down
from soma_bullet.planner.options import HoldLoad
from soma_bullet.planner.programs import LARGEST, RayProgram

Placed = frozenset[int]
OPPOSITE = 0.98  # cosine from which two contacts face each other
MEETS = 0.1  # an insertion meets a contact head on where the direction has so much of the contact's normal


@dataclass(frozen=True)
class Bearing:
    """What the placed pieces bear of an insertion.

    Attributes:
        force: with which the piece may press on what it meets, before something moves [N].
        margin: that force in those of a placing that has just met something; smaller where what the piece
            rubs along moves first. At least 1 is borne.
        piece: index of the placed piece that is pressed, or rubbed, and bears the least; -1 where none is.
        rubbed: it is rubbed.
    """

    force: float
    margin: float
    piece: int = SUPPORT
    rubbed: bool = False

    @property
    def borne(self) -> bool:
        """Whether everything stays where it is."""
        return self.margin >= 1.0


class Pushes:
    """The pushes of insertions into one assembly; each is looked at once."""

    def __init__(self, assembly: Assembly, load: HoldLoad):
        self.assembly, self.load = assembly, load
        self._programs: dict[tuple[Placed, Placed], tuple[list[int], RayProgram]] = {}
        self._found: dict[tuple[Placed, Placed, int, tuple[float, ...]], Bearing] = {}

    def bearing(self, placed: Placed, held: Placed, upcoming: int, direction: Array) -> Bearing:
        """What a placed set with some pieces held bears of the next piece, along its unit direction (3,)."""
        key = placed, held & placed, upcoming, tuple(np.round(direction, 9).tolist())
        if key not in self._found:
            self._found[key] = self._bearing(placed, held & placed, upcoming, direction)
        return self._found[key]

    def _bearing(self, placed: Placed, held: Placed, upcoming: int, direction: Array) -> Bearing:
        found = Bearing(LARGEST, LARGEST)
        contacts = self.assembly.contacts_of(upcoming, placed)
        beside = [c for c in contacts if abs(float(c.normal @ direction)) <= MEETS]
        for contact in contacts:
            if contact.body_a == SUPPORT or contact.body_a in held:
                continue
            facing = float(contact.normal @ direction)
            if facing < -MEETS:
                push = facing * contact.normal
            elif any(float(contact.normal @ other.normal) < -OPPOSITE for other in beside):
                push = direction  # it has to get in between, and may catch at the rim
            else:
                push = np.zeros(3)
            if push.any():
                force = self._farthest(placed, held, contact, push)
                found = Bearing(
                    min(found.force, force), *_smaller(found, force / self.needed, contact.body_a, False)
                )
            if abs(facing) <= MEETS:
                rub = friction_of(contact, self.assembly) * direction
                if contact.normal[2] > SIDE:
                    rub = rub - contact.normal
                margin = self._farthest(placed, held, contact, self.assembly.sizes.leaning * rub)
                found = Bearing(found.force, *_smaller(found, margin, contact.body_a, True))
        return found

    @property
    def needed(self) -> float:
        """Force of a placing that has just met something [N]."""
        return self.assembly.sizes.touch

    def _farthest(self, placed: Placed, held: Placed, contact: Contact, push: Array) -> float:
        """How many times a push (3,) [N] in the middle of a contact is borne by the piece below it; 0 where
        even none is."""
        if (placed, held) not in self._programs:
            self._programs[placed, held] = self._program(placed, held)
        bodies, program = self._programs[placed, held]
        at = contact.points.mean(axis=0) - self.assembly.goal_centres[contact.body_a]
        row = bodies.index(contact.body_a)
        load, wrench = np.zeros((2, len(bodies), 6))
        load[:, 2] = [-self.assembly.pieces[k].mass * GRAVITY for k in bodies]
        # everything sways at the same time: as the push goes, or outwards where it goes down
        aside = push[:2] if np.linalg.norm(push[:2]) > SIDE * np.linalg.norm(push) else at[:2]
        length = float(np.linalg.norm(aside))
        if length > 1e-9:
            load[:, :2] = np.outer(-load[:, 2] * self.load.disturbance, aside / length)
        wrench[row, :3], wrench[row, 3:] = push, np.cross(at, push)
        return max(0.0, program.farthest(load.ravel(), wrench.ravel()))

    def _program(self, placed: Placed, held: Placed) -> tuple[list[int], RayProgram]:
        """The free bodies, and the balance of what acts on them."""
        assembly, bodies = self.assembly, sorted(placed - held)
        contacts = active_contacts(assembly, placed, held, "frictionless")
        columns = [contact_columns(c, assembly, bodies, held, "frictionless") for c in contacts]
        matrix = np.hstack([np.zeros((6 * len(bodies), 0)), *columns])
        # a held piece keeps what it lies on from tipping; pressing it down, it would give it friction below
        ends = np.cumsum([block.shape[1] for block in columns])
        rows, limits = [], []
        for contact, block, end in zip(contacts, columns, ends, strict=True):
            if presses_down(contact, held):
                rows.append(np.zeros(matrix.shape[1]))
                rows[-1][end - block.shape[1] : end] = 1.0
                below = contact.body_b if contact.body_a in held else contact.body_a
                limits.append(assembly.pieces[below].mass * GRAVITY)
        most = (np.array(rows).reshape(-1, matrix.shape[1]), np.array(limits))
        scaling = np.concatenate([[1, 1, 1, *([1 / assembly.pieces[k].radius] * 3)] for k in bodies])
        return bodies, RayProgram(matrix, scaling, most)


def _smaller(found: Bearing, margin: float, piece: int, rubbed: bool) -> tuple[float, int, bool]:
    """The smaller margin, with what it is of."""
    if margin < found.margin:
        return round(margin, 6), piece, rubbed
    return found.margin, found.piece, found.rubbed
