"""Experiments side by side in processes of their own; what they compute does not depend on how many."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from typing import Any

from fmu.progress import Report

_TICK_S = 0.1
_messages: Any = None
_stop: Any = None


def default_workers() -> int:
    """Return the number of CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_processes[T](
    work: Callable[..., T], tasks: Sequence[tuple[Any, ...]], workers: int, progress: Report | None
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
    messages = context.SimpleQueue()  # writes at once: no message comes later than its task's result
    stop = context.Event()
    with ProcessPoolExecutor(workers, context, _start, (messages, stop)) as pool:
        try:
            futures = [pool.submit(_run, work, task) for task in tasks]
            _listen(futures, messages, progress)
            for future in futures:
                if future.done() and future.exception() is not None:
                    future.result()
            return [future.result() for future in futures]
        except BaseException:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _listen(futures: Sequence[Future[Any]], messages: Any, progress: Report | None) -> None:
    """Pass messages on until all is done or something has failed."""
    while True:
        done, pending = wait(futures, timeout=_TICK_S)
        while not messages.empty():
            message = messages.get()
            if progress is not None:
                progress(*message)
        if not pending or any(future.exception() is not None for future in done):
            return


class _Abandoned(Exception):  # noqa: N818 - not an error
    """Another task has failed, or the user wants no more."""


def _start(messages: Any, stop: Any) -> None:
    """Remember where to report to and who says stop; runs once in every process."""
    global _messages, _stop
    _messages, _stop = messages, stop


def _run[T](work: Callable[..., T], task: tuple[Any, ...]) -> T:
    """Do one task; at most ten times a second it reports, and asks whether to go on."""
    last = 0.0

    def report(phase: str, done: int, total: int, info: dict[str, str]) -> None:
        nonlocal last
        now = time.monotonic()
        if done == total or now >= last + _TICK_S:
            last = now
            if _stop.is_set():
                raise _Abandoned
            _messages.put((phase, done, total, dict(info)))

    return work(*task, report)
