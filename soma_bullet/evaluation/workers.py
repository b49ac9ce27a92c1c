"""Who runs the episodes: processes of this machine, or a cluster."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any

from soma_bullet.evaluation.line import Line, crashed_line
from soma_bullet.evaluation.options import EvaluationOptions

Lines = Generator[Line, None, None]
Episode = Callable[[int, EvaluationOptions], Line]


def in_processes(seeds: Sequence[int], options: EvaluationOptions, jobs: int, episode: Episode) -> Lines:
    """Lines as they are ready. A process that dies (not: an exception) costs its own episode alone."""
    waiting, busy = deque(seeds), dict[Connection, tuple[Any, int]]()
    idle: list[tuple[Connection, Any]] = []
    try:
        while waiting or busy:
            while waiting and len(busy) < jobs:
                connection, process = idle.pop() if idle else _new_worker(episode, options)
                seed = waiting.popleft()
                busy[connection] = (process, seed)
                connection.send(seed)
            for ready in wait(list(busy)):
                assert isinstance(ready, Connection)
                process, seed = busy.pop(ready)
                try:
                    line = ready.recv()
                    idle.append((ready, process))
                except (EOFError, OSError):
                    ready.close()
                    process.join()
                    line = crashed_line(seed, options, f"its process died ({_exit_reason(process.exitcode)})")
                yield line
    finally:
        for connection, process in [
            *idle,
            *((connection, process) for connection, (process, _) in busy.items()),
        ]:
            connection.close()
            process.terminate()
            process.join()


def _exit_reason(code: int | None) -> str:
    if code is not None and code < 0:
        return signal.Signals(-code).name
    return f"exit status {code}"


def _new_worker(episode: Episode, options: EvaluationOptions) -> tuple[Connection, Any]:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs, episode, options), daemon=True)
    with _inherited():
        process.start()
    theirs.close()
    return ours, process


@contextmanager
def _inherited() -> Iterator[None]:
    """What a new process takes over: one thread for linear algebra, and that Ctrl-C is for its parent to deal
    with.

    Blocked, not ignored: one that comes just now reaches the parent when the block ends.
    """
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    resource_tracker.ensure_running()  # which would unblock it
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _work(connection: Connection, episode: Episode, options: EvaluationOptions) -> None:
    """A worker: seeds in, lines out, until the other end is closed."""
    while True:
        try:
            seed = connection.recv()
            connection.send(_guarded(seed, options, episode))
        except (EOFError, OSError):
            return


def _guarded(seed: int, options: EvaluationOptions, episode: Episode) -> Line:
    try:
        return episode(seed, options)
    except Exception as error:
        return crashed_line(seed, options, f"{type(error).__name__}: {error}")


def on_ray(seeds: Sequence[int], options: EvaluationOptions, jobs: int, episode: Episode) -> Lines:
    """The same as tasks of ray: on the cluster that RAY_ADDRESS names, else on this machine."""
    if not seeds:
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    import ray

    address = os.environ.get("RAY_ADDRESS")
    local: dict[str, Any] = {} if address else {"num_cpus": jobs, "object_store_memory": 100 * 2**20}
    ray.init(
        address=address or "local",
        include_dashboard=False,
        log_to_driver=False,
        logging_level=logging.ERROR,
        **local,
    )
    try:
        remote = ray.remote(max_retries=0, num_cpus=1)(_guarded)
        waiting, busy = deque(seeds), dict[Any, int]()
        while waiting or busy:
            while waiting and len(busy) < jobs:
                seed = waiting.popleft()
                busy[remote.remote(seed, options, episode)] = seed
            (ready, *_), _ = ray.wait(list(busy), num_returns=1)
            seed = busy.pop(ready)
            try:
                line = ray.get(ready)
            except ray.exceptions.RayError as error:
                line = crashed_line(seed, options, f"its process died ({type(error).__name__})")
            yield line
    finally:
        ray.shutdown()
