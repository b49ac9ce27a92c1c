"""Episodes of the three-block task in a world without physics."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from soma_bullet.control.execute import Executor
from soma_bullet.control.executive import Executive
from soma_bullet.control.options import ExecutionOptions
from soma_bullet.frames import Array, translate
from soma_bullet.task.feed_options import FeedOptions
from soma_bullet.task.limits import USUAL
from soma_bullet.task.program.program import Program
from soma_bullet.task.search_options import SearchOptions
from soma_bullet.verdict.judge import Judgement, judge
from soma_bullet.world.log import ExecutionLog
from tests.control.fake import FakeSimulator
from tests.soma3 import planned

EVERY = 10  # samples of a trajectory between those of the log


def world_of(
    program: Program, kind: type[FakeSimulator] = FakeSimulator, off: Mapping[str, Array] | None = None
) -> FakeSimulator:
    """The world of a program, in which some pieces lie elsewhere [m] than they were seen."""
    off, feed = off or {}, program.feed
    poses = {name: translate(feed.pose(name), off.get(name, np.zeros(3))) for name in feed.names}
    return kind(planned()[0], poses)


def ran(
    program: Program,
    world: FakeSimulator,
    options: ExecutionOptions | None = None,
    kind: type[Executive] = Executive,
    ablate: str = "",
    search: SearchOptions = USUAL,
) -> ExecutionLog:
    """An episode in a world."""
    workcell, plan, _ = planned()
    options = options or ExecutionOptions()
    compliance = options.compliance if options.compliant else None
    executor = Executor(world, program, workcell.sizes, compliance, EVERY)
    ended = kind(workcell, plan, program, executor, FeedOptions(), options, ablate, search=search).run()
    executor.settle()
    return executor.log(ended)


def judged(log: ExecutionLog) -> Judgement:
    workcell, _, _ = planned()
    return judge(log, workcell.assembly, workcell.cell)
