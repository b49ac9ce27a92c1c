"""How a piece is placed: looked at in the hand before, corrected, and tried again where it jams."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import replace

import numpy as np

from soma_bullet.control.correction import Correction, correct, displacement
from soma_bullet.control.execute import Executor, Observation
from soma_bullet.control.perception import Perception
from soma_bullet.frames import Array, readonly
from soma_bullet.task.kinds import BACK_OFF
from soma_bullet.task.program.motions import joined
from soma_bullet.task.program.overlap.concurrent import Concurrent
from soma_bullet.task.segment import NOWHERE, Segment
from soma_bullet.task.workcell import Workcell

AGAIN = 3  # times that a jammed insertion is tried again
LOOKS = 16  # at a piece in the hand before it is placed, if perception errs: each errs anew
DOUBT = 2.0  # standard errors of their mean by which a piece may seem displaced before that counts
Detour = Generator[Segment, Observation, Observation]


class Placement:
    """Places pieces.

    Args:
        recover: what goes wrong is tried again; else it is reported.
    """

    def __init__(self, workcell: Workcell, executor: Executor, perception: Perception, recover: bool):
        self.workcell, self.executor, self.perception, self.recover = workcell, executor, perception, recover

    def run(
        self, segment: Segment, concurrent: Callable[[], Concurrent], alone: Callable[[], bool]
    ) -> Detour:
        """What is run for a placing: itself, and what is tried where it jams. Returns the last observation.

        Args:
            concurrent: the other arms, while it is about to run.
            alone: whether no other hand carries a piece: else planning anew would lay that down first.
        """
        corrected = self._corrected(segment, concurrent, alone, DOUBT)
        segment, world = corrected.segment, self.executor.world
        if corrected.fault and self.recover:
            left = float(np.linalg.norm(segment.offset))
            return Observation(corrected.fault, world.measured_joints(), world.openings(), NOWHERE, left)
        seen = yield segment
        for _ in range(AGAIN if self.recover else 0):
            if seen.outcome != "jammed":
                break
            text = f"{seen.reason or 'contact'}, {seen.remaining * 1e3:.1f} mm left"
            self.executor.note_event("jammed", segment.piece, text)
            q = world.measured_joints()[segment.arm]
            back = readonly(joined(_reached(segment, seen)[::-1], q))
            yield replace(segment, kind=BACK_OFF, path=back, offset=-segment.offset, guard=0.0)
            corrected = self._corrected(segment, concurrent, alone)
            if corrected.fault:
                return replace(seen, outcome=corrected.fault)
            seen = yield corrected.segment
        return seen

    def _corrected(
        self,
        segment: Segment,
        concurrent: Callable[[], Concurrent],
        alone: Callable[[], bool],
        sigmas: float = 0.0,
    ) -> Correction:
        """A placing, corrected by what is seen in the hand: the mean of some looks if they err.

        It counts from `sigmas` of their mean's error on; without them, after a jam, all of it does.
        """
        noise = self.perception.options
        looks = LOOKS if noise.noise_mm or noise.noise_deg else 1
        seen = [poses[segment.piece] for poses in self.perception.looks(looks)]
        q = self.executor.world.measured_joints()[segment.arm]
        off = displacement(self.workcell, segment, q, seen)
        if sigmas and not off.counts(*(sigmas * np.array(self.perception.noise) / np.sqrt(looks))):
            return Correction(segment)
        if off.size > self.workcell.sizes.gone:
            return Correction(segment, "lost")
        return correct(self.workcell.robot, segment, off, concurrent(), q, utmost=not alone())


def _reached(segment: Segment, seen: Observation) -> Array:
    """As much of a path as was travelled."""
    length = float(np.linalg.norm(segment.offset))
    last = round((len(segment.path) - 1) * (1.0 - seen.remaining / max(length, 1e-12)))
    return segment.path[: max(last, 1) + 1]
