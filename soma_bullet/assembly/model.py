"""The assembly: workpieces with goal poses on a support, and the contacts of the finished state."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np

from soma_bullet.assembly.advice import Advice
from soma_bullet.assembly.contacts import SUPPORT, Contact, find_contacts
from soma_bullet.assembly.hulls import Hull
from soma_bullet.assembly.separation import swept_separation
from soma_bullet.assembly.workpiece import Workpiece
from soma_bullet.frames import Array, apply
from soma_bullet.sizes import Sizes

MEETING = 1e-3  # [m] pieces that are nearer than this at their goals meet, if only along an edge


@dataclass(frozen=True)
class Support:
    """The horizontal plane that the assembly stands on.

    Attributes:
        height: z of the plane in the assembly frame [m].
        friction: Coulomb coefficient.
    """

    height: float = 0.0
    friction: float = 0.5


@dataclass(frozen=True, eq=False)
class Assembly:
    """What to build.

    Attributes:
        name: for people and folders.
        pieces: the workpieces, in the order of the file.
        goals: Ts_assembly_piece (n, 4, 4), the nominal final poses.
        support: what they stand on.
        digest: hash of everything that decides a plan (the file's content and the meshes').
        advice: how it asks to be planned.
    """

    name: str
    pieces: tuple[Workpiece, ...]
    goals: Array
    support: Support
    digest: str = ""
    advice: Advice = Advice()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the pieces, in order."""
        return tuple(piece.name for piece in self.pieces)

    def index(self, name: str) -> int:
        """Index of the piece called `name`; KeyError lists the names."""
        try:
            return self.names.index(name)
        except ValueError:
            raise KeyError(f"no piece {name!r}; there are {', '.join(self.names)}") from None

    @cached_property
    def sizes(self) -> Sizes:
        """Lengths and forces that go with the pieces' size."""
        return Sizes.of([piece.radius for piece in self.pieces])

    @cached_property
    def contacts(self) -> tuple[Contact, ...]:
        """Contacts of the finished assembly, the support included: patches, edges, corners."""
        return find_contacts(self.pieces, self.goals, self.support.height)

    @cached_property
    def goal_parts(self) -> tuple[tuple[Hull, ...], ...]:
        """Convex parts of every piece at its goal, in the assembly frame."""
        return tuple(
            tuple(part.moved(goal) for part in piece.parts)
            for piece, goal in zip(self.pieces, self.goals, strict=True)
        )

    @cached_property
    def goal_centres(self) -> Array:
        """Centres of mass (n, 3) [m] at the goals, in the assembly frame."""
        return np.array([apply(g, p.center_of_mass) for p, g in zip(self.pieces, self.goals, strict=True)])

    @cached_property
    def meeting(self) -> frozenset[frozenset[int]]:
        """Pairs of bodies (SUPPORT among them) that meet in the finished assembly: by a face, along an edge
        or at a corner."""
        faces = {frozenset((contact.body_a, contact.body_b)) for contact in self.contacts}
        edges = {
            frozenset((a, b))
            for a, b in combinations(range(len(self.pieces)), 2)
            if swept_separation(self.goal_parts[a], np.zeros(3), self.goal_parts[b], MEETING) < MEETING
        }
        return frozenset(faces | edges)

    def contacts_of(self, piece: int, placed: frozenset[int]) -> tuple[Contact, ...]:
        """Contacts of `piece` with the placed pieces and the support, each oriented with its normal into
        `piece`."""
        mine = (c.into(piece) for c in self.contacts if piece in (c.body_a, c.body_b))
        return tuple(c for c in mine if c.body_a == SUPPORT or c.body_a in placed)

    @cached_property
    def drops(self) -> Array:
        """How far each piece of the finished assembly settles below its nominal goal (n,) [m]."""
        return self.drops_of(frozenset(range(len(self.pieces))))

    def drops_of(self, placed: frozenset[int]) -> Array:
        """How far each placed piece settles below its nominal goal when it is put down (n,) [m]; 0 for the
        others.

        A piece on the support drops by its clearance; one on others by both clearances plus the smallest drop
        among the pieces that carry it (it rests on the highest). On an edge or a corner it drops farther: the
        real one stands back by more than the clearance. A piece that nothing carries keeps its goal.
        """
        upward = np.cos(np.deg2rad(60.0))
        # what carries each piece, and how far both real surfaces stand back there
        carriers: list[dict[int, tuple[float, float]]] = [{} for _ in self.pieces]
        for contact in self.contacts:
            if not {contact.body_a, contact.body_b} - {SUPPORT} <= placed:
                continue
            for piece in {contact.body_a, contact.body_b} - {SUPPORT}:
                oriented = contact.into(piece)
                if oriented.normal[2] > upward:
                    known = carriers[piece].get(oriented.body_a)
                    gaps = self.gaps_at(oriented)
                    carriers[piece][oriented.body_a] = min(known or gaps, gaps, key=sum)
        drops = np.full(len(self.pieces), np.nan)
        for _ in self.pieces:
            for piece, below in enumerate(carriers):
                if not below:
                    drops[piece] = 0.0
                elif SUPPORT in below:
                    drops[piece] = below[SUPPORT][1]
                elif not np.isnan(drops[list(below)]).any():
                    drops[piece] = min(drops[other] + own + its for other, (its, own) in below.items())
        return np.nan_to_num(drops)

    def gaps_at(self, contact: Contact) -> tuple[float, float]:
        """How far the real surfaces of both bodies stand back from a contact along its normal [m]."""
        first, second = (
            0.0 if body == SUPPORT else self.pieces[body].clearance * recess
            for body, recess in ((contact.body_a, contact.recess_a), (contact.body_b, contact.recess_b))
        )
        return first, second
