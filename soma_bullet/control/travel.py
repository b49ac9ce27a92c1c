"""Takes a hand along the path of a segment: freely, up to the first touch, or as far, and aside, as the
wrist's force asks.

What a motion wants of each time step is a generator: it commands, yields until the step is done, measures,
and commands again."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field, replace

import numpy as np

from soma_bullet.control.guide import Guide, gentle, scaled
from soma_bullet.control.options import Compliance
from soma_bullet.frames import Array
from soma_bullet.sizes import Sizes
from soma_bullet.task.kinds import TRANSFER
from soma_bullet.task.segment import DT, Segment
from soma_bullet.world.simulator import Simulator

TARE = 0.1  # [s] at rest before a guarded segment
FILTER = 4  # samples of the force that are averaged
LEANING = 0.3  # [s] of resistance so near to its end after which a guided motion has arrived as well
FELT = 0.2  # of the grip force: where less presses the pads apart there is nothing between them
WATCH = 5  # samples between looks at the width of a hand that carries
LOWERING = 8e-3  # [m/s] of the last way straight down
NARROW = 0.5  # of the length of that way: largest radius of a search on it
EASING = 2e-3  # [m/s] of going back to where a piece rests that the hand does not press on
SLOW = 0.25  # [s] over which a guided motion takes up its speed again

Steps = Generator[None, None, None]


@dataclass
class Motion:
    """What came of following a path."""

    outcome: str = "as planned"
    remaining: float = 0.0
    peak: float = 0.0
    force: Array = field(default_factory=lambda: np.zeros(3))
    reason: str = ""


class Travel:
    """The motions of the hands.

    Args:
        compliance: how guarded motions yield; None for motions that stop at the first touch.

    Attributes:
        carried: arm -> width of what it holds [m].
        tares: arm -> load of the hand with what it holds in the air (6,).
    """

    def __init__(self, world: Simulator, sizes: Sizes, compliance: Compliance | None):
        self.world, self.sizes = world, sizes
        self.compliance = scaled(compliance, sizes.scale) if compliance is not None else None
        self.carried: dict[int, float] = {}
        self.tares: dict[int, Array] = {}

    def forget(self, arm: int) -> None:
        """A hand has let go."""
        self.carried.pop(arm, None)
        self.tares.pop(arm, None)

    def lost(self, arm: int, width: float) -> bool:
        """Whether a hand has nothing where it should have a piece of that width [m]: the pads meet, or they
        are nearer than that and nothing presses them apart. What is squeezed, or sits otherwise in the hand,
        is not lost."""
        opening = float(self.world.openings()[arm])
        if opening < self.sizes.shut:
            return True
        return opening < width - self.sizes.empty and self.world.felt_grip(
            arm
        ) < FELT * self.world.grip_force(arm)

    def go(self, segment: Segment, motion: Motion) -> Steps:
        """Follow the path of a segment as it asks, and say in `motion` what came of it."""
        if segment.guard and self.compliance is not None and len(segment.compliance):
            load = yield from self._mean_load(segment.arm)
            if len(segment.path):
                tare = self.tares[segment.arm] = load
                yield from self._guided(segment, motion, self.compliance, tare)
            else:
                tare = self.tares.get(segment.arm, load)
                if (
                    (tare - load)[
                        :3
                        # it rests on something; pressed on, that would creep away
                    ]
                    @ segment.last_way
                    > self.sizes.resting
                ):
                    return
                yield from self._lowered(
                    segment, motion, self.compliance, tare, self.world.target(segment.arm), 0.0
                )
            if motion.outcome != "jammed":
                yield from self._ease(segment, tare)
        elif segment.guard:
            yield from self._guarded(segment, motion)
        else:
            yield from self._free(segment, motion)

    def _free(self, segment: Segment, motion: Motion) -> Steps:
        """Feed a path; a hand that carries watches that its pads stay apart."""
        world, arm = self.world, segment.arm
        upkeep = None
        if segment.kind is TRANSFER:
            upkeep = world.upkeep(arm, segment.piece, len(segment.path))
        for k, q in enumerate(segment.path[1:], 1):
            if upkeep is not None:
                upkeep.at(k)
            world.command_arm(arm, q)
            yield
            if k % WATCH == 0 and arm in self.carried and self.lost(arm, self.carried[arm]):
                del self.carried[arm]
                motion.outcome = "lost"
                return

    def _guarded(self, segment: Segment, motion: Motion) -> Steps:
        """Feed a path; stop where the wrist's force has changed by more than the guard."""
        arm, length = segment.arm, float(np.linalg.norm(segment.offset))
        tare = yield from self._mean_load(arm)
        recent: list[Array] = []
        for k, q in enumerate(segment.path[1:], 1):
            self.world.command_arm(arm, q)
            yield
            recent = [*recent[1 - FILTER :], self.world.load(arm)]
            change = (np.mean(recent, axis=0) - tare)[:3]
            force = float(np.linalg.norm(change))
            motion.peak = max(motion.peak, force)
            if force > segment.guard and len(recent) == FILTER:
                motion.remaining, motion.force = length * _fraction_left(segment.path, float(k)), change
                motion.outcome = "jammed" if motion.remaining > self.sizes.jam else "stopped early"
                return

    def _guided(self, segment: Segment, motion: Motion, compliance: Compliance, tare: Array) -> Steps:
        """Feed a path as far as the wrist's force allows, and aside as it asks; see Guide.

        A piece that comes in at a slant, or level, stays a little above its path and comes down straight at
        the end: it then meets what carries it without pushing it aside. Where something should be met at the
        end, the hand goes on until it is."""
        compliance = gentle(compliance, min(1.0, segment.guard / self.sizes.guard))
        path, length = segment.path, float(np.linalg.norm(segment.offset))
        along, raised = segment.offset / length, segment.raised

        def place(at: float, guide: Guide) -> Array:
            whole = min(int(at), len(path) - 2)
            nominal = path[whole] + (at - whole) * (path[whole + 1] - path[whole])
            fall = raised * min(1.0, 3.0 * at / (len(path) - 1))
            shift, turn = guide.offset + (0.0, 0.0, fall), guide.twist * along
            return nominal + segment.compliance[:, :3] @ shift + segment.compliance[:, 3:] @ turn

        def left(at: float) -> float:
            return length * _fraction_left(path, at)

        guide = Guide(along, compliance)
        at = yield from self._feel(segment, motion, guide, tare, len(path) - 1.0, place, left)
        if (
            motion.outcome == "jammed"
            or (motion.outcome == "stopped early" and not raised)
            or not raised + segment.beyond
        ):
            return
        yield from self._lowered(segment, motion, compliance, tare, place(at, guide), raised)

    def _lowered(
        self, segment: Segment, motion: Motion, compliance: Compliance, tare: Array, start: Array, fall: float
    ) -> Steps:
        """Go on the last way by `fall` [m], and beyond until something is met, however lightly."""
        lightly = replace(segment, guard=min(segment.guard, self.sizes.touch))
        down, step = segment.last_way, LOWERING * DT
        guide = Guide(down, replace(compliance, reach=min(compliance.reach, NARROW * self.sizes.fall)))
        motion.outcome = "as planned"
        yield from self._feel(
            lightly, motion, guide, tare, (fall + segment.beyond) / step,
            # it turns no more
            lambda at, g: start + segment.compliance[:, :3] @ (down * at * step + g.offset),
            lambda at: max(fall - at * step, 0.0),
        )  # fmt: skip

    def _ease(self, segment: Segment, tare: Array) -> Steps:
        """Go back until a piece only just rests on what stopped it: pressed on, that would creep away under
        it."""
        world, arm = self.world, segment.arm
        start, back = world.target(arm), 0.0
        recent: list[Array] = []
        while back < self.sizes.jam / 2:
            recent = [*recent[1 - FILTER :], world.load(arm)]
            if -float((np.mean(recent, axis=0) - tare)[:3] @ segment.last_way) < self.sizes.resting:
                return
            back += EASING * DT
            world.command_arm(arm, start - segment.compliance[:, :3] @ segment.last_way * back)
            yield

    def _feel(
        self, segment: Segment, motion: Motion, guide: Guide, tare: Array, last: float,
        place: Callable[[float, Guide], Array], left: Callable[[float], float],
    ) -> Generator[None, None, float]:  # fmt: skip
        """Go from 0 to `last`, a sample at a time, as the guide allows; returns how far it came.

        `place` gives the joints, `left` what is left [m].
        """
        world, arm = self.world, segment.arm
        at, pace = 0.0, 0.0
        sizes, on_table = self.sizes, segment.kind.ends == "table"
        seated = sizes.jam if on_table else sizes.seated
        recent: list[Array] = []
        while at < last:
            speed = 1.0
            if len(recent) == FILTER:
                load = np.mean(recent, axis=0) - tare
                motion.force = load[:3]
                force = float(np.linalg.norm(motion.force))
                motion.peak = max(motion.peak, force)
                motion.remaining = left(at)
                if (
                    motion.remaining <= seated
                    and force > segment.guard
                    and float(motion.force @ guide.direction) < 0.0
                ):
                    motion.outcome = "stopped early" if motion.remaining > 0.0 else "as planned"
                    return at
                # it lies on something, or rubs: searching here would only push that aside; and a table has no
                # opening to find
                early = motion.remaining > sizes.jam
                near = not early or on_table
                speed = guide.update(load, DT, motion.remaining, near)
                if guide.failed or (near and (guide.held_up if early else guide.waited) > LEANING):
                    motion.outcome = "jammed" if guide.failed or early else "stopped early"
                    motion.reason = guide.failed
                    return at
            pace = min(speed, pace + DT / SLOW)
            at = float(np.clip(at + pace, 0.0, last))
            world.command_arm(arm, place(at, guide))
            yield
            recent = [*recent[1 - FILTER :], world.load(arm)]
        motion.remaining = 0.0
        return at

    def _mean_load(self, arm: int) -> Generator[None, None, Array]:
        loads = []
        for _ in range(round(TARE / DT)):
            yield
            loads.append(self.world.load(arm))
        return np.mean(loads, axis=0)


def rest(duration: float) -> Steps:
    """Nothing, for a while [s]."""
    for _ in range(round(duration / DT)):
        yield


def _fraction_left(path: Array, at: float) -> float:
    """Of the way along a path (m, n), by the joints, from a sample that may lie between two."""
    q = path[min(round(at), len(path) - 1)]
    travelled = np.abs(q - path[0]).sum()
    return float(1.0 - travelled / max(np.abs(path[-1] - path[0]).sum(), 1e-12))
