"""Seconds by name, and what all benchmarks say of them."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


class Stopwatch:
    """Collects seconds by name: wall, and of this process alone."""

    def __init__(self) -> None:
        self.seconds: dict[str, list[float]] = defaultdict(list)
        self.cpu: dict[str, list[float]] = defaultdict(list)

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        start, cpu = time.perf_counter(), time.process_time()
        yield
        self.seconds[name].append(time.perf_counter() - start)
        self.cpu[name].append(time.process_time() - cpu)


@contextmanager
def hooked(module: Any, hooks: dict[str, str], seconds: dict[str, float]) -> Iterator[None]:
    """CPU time of functions of a module, by label, while the block runs."""
    originals = {name: getattr(module, name) for name in hooks}

    def timed(function: Callable[..., Any], label: str) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            start = time.process_time()
            try:
                return function(*arguments, **options)
            finally:
                seconds[label] += time.process_time() - start

        return call

    for name, label in hooks.items():
        setattr(module, name, timed(originals[name], label))
    try:
        yield
    finally:
        for name, function in originals.items():
            setattr(module, name, function)


def met(wall: float, cpu: float, target: float) -> str:
    """Whether a time is below its target; by CPU time alone where something else kept the machine busy."""
    return "yes" if wall < target else "by CPU time" if cpu < target else "no"
