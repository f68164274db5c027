"""Experiments side by side in processes of their own. What they compute does not depend on how many there are."""

from __future__ import annotations

import multiprocessing
import os
import queue
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from typing import Any

from fmu.report.paper.experiment import Progress

_TICK_S = 0.1
_messages: Any = None


def default_workers() -> int:
    """Return the number of CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_processes[T](
    work: Callable[..., T], tasks: Sequence[tuple[Any, ...]], workers: int, progress: Progress | None
) -> list[T]:
    """Return ``work(*task, progress)`` for every task, in the order of the tasks.

    Parameters
    ----------
    work : callable
        A function of a module; its last argument is where it reports its progress.
    tasks : sequence of tuple
        Arguments that can be pickled.
    workers : int
        Processes; with one, everything happens in this one.
    progress : callable, optional

    Raises
    ------
    Exception
        What the first task to fail raised; the others are abandoned.
    """
    if workers <= 1:
        return [work(*task, progress) for task in tasks]
    context = multiprocessing.get_context("spawn")  # a fork of a process with threads may hang
    messages = context.Queue()
    with ProcessPoolExecutor(workers, context, _start, (messages,)) as pool:
        futures = [pool.submit(_run, work, task, progress is not None) for task in tasks]
        try:
            _listen(futures, messages, progress)
            return [future.result() for future in futures]
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _listen(futures: Sequence[Future[Any]], messages: Any, progress: Progress | None) -> None:
    """Pass messages on until all is done or something has failed."""
    while True:
        done, pending = wait(futures, timeout=_TICK_S)
        while progress is not None:
            try:
                progress(*messages.get_nowait())
            except queue.Empty:
                break
        if not pending or any(future.exception() is not None for future in done):
            return


def _start(messages: Any) -> None:
    """Remember where to report to; runs once in every process."""
    global _messages
    _messages = messages


def _run[T](work: Callable[..., T], task: tuple[Any, ...], reports: bool) -> T:
    """Do one task; reports at most ten times a second."""
    last = 0.0

    def report(phase: str, done: int, total: int, info: dict[str, str]) -> None:
        nonlocal last
        now = time.monotonic()
        if done == total or now >= last + _TICK_S:
            last = now
            _messages.put((phase, done, total, dict(info)))

    return work(*task, report if reports else None)
