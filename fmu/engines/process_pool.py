"""Tasks in processes of this machine, each with a line to this one of its own.

Nothing is shared between workers: no queue, no lock that one of them could take with it when it dies, no thread in
the calling process. So it is known which task a worker died of, and only that one is done again.
"""

from __future__ import annotations

import atexit
import multiprocessing
import multiprocessing.util  # its clean-up at exit waits for workers: it has to come after ours
import os
import signal
import sys
import threading
import weakref
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import wait
from types import ModuleType
from typing import Any, NamedTuple

import cloudpickle

from fmu.engines.engine import MOST_DEATHS, ContextManager, Follow, InProcess, LostTaskError, Work
from fmu.engines.worker import Order, serve, unpacked
from fmu.progress import Report

# How often it is checked that a worker lives: its line may be held open by processes that it started itself.
_TICK_S = 0.5
_PATIENCE_S = 2.0
_starting = threading.Lock()
_pools: weakref.WeakSet[ProcessPool] = weakref.WeakSet()


class Assignment(NamedTuple):
    """A task of a line, and how many workers have died of it."""

    line: int
    order: Order
    deaths: int = 0


class WorkerProcess:
    """A process, this end of the line to it, and what it is doing."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")  # a fork of a process with threads may hang
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=serve, args=(theirs, sys.path, os.getcwd()), name="fmu worker")
        with _quiet_start():
            self.process.start()
        theirs.close()
        self.assignment: Assignment | None = None
        self.has: bytes | None = None  # of what tasks share

    def give(self, assignment: Assignment, shared: bytes) -> None:
        """Send a task, and before it what all tasks share, if the worker has something else."""
        order = cloudpickle.dumps(assignment.order)
        self.assignment = assignment
        with suppress(OSError):  # it has died, which `message` will tell
            if self.has is not shared:
                self.has = shared
                self.connection.send(("shared", shared))
            self.connection.send(("order", order))

    def message(self) -> tuple[str, Any] | None:
        """Return what it has sent, ``("died", how)`` if it is dead, None if there is nothing yet."""
        try:
            if self.connection.poll():
                kind, content = self.connection.recv()
                return kind, content
            if self.process.is_alive():
                return None
        except (EOFError, OSError):
            self.process.join(_PATIENCE_S)
        code = self.process.exitcode
        if code is None:
            return "died", "it closed its line"
        return "died", f"exit code {code}" if code >= 0 else _name_of_signal(-code)

    def stop(self) -> None:
        """Have the process end, whatever it is doing, and wait until it has."""
        self.connection.close()
        self.process.terminate()
        self.process.join(_PATIENCE_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.process.close()


class ProcessPool(ContextManager):
    """Worker processes that are started when first needed, and stay until the pool is closed.

    Parameters
    ----------
    workers : int

    Notes
    -----
    A pool that is busy, and asked for more by what it called back, does that in the calling process.
    """

    def __init__(self, workers: int) -> None:
        self.workers = workers
        self._processes: list[WorkerProcess] = []
        self._busy = threading.Lock()
        self._shared: tuple[Any, bytes] | None = None
        _pools.add(self)

    def __repr__(self) -> str:
        return f"ProcessPool({self.workers} workers)"

    def run_tasks(
        self,
        work: Work,
        shared: Any,
        tasks: Sequence[Any],
        follow: Follow | None = None,
        report: Report | None = None,
    ) -> list[Any]:
        """Do the tasks of all lines, see `fmu.engines.engine.Engine.run_tasks`."""
        if not self._busy.acquire(blocking=False):
            return InProcess().run_tasks(work, shared, tasks, follow, report)
        try:
            return self._lines(work, shared, tasks, follow, report)
        except BaseException:
            self._abandon()
            raise
        finally:
            self._busy.release()

    def close(self) -> None:
        """Stop the workers, whatever they are doing."""
        self._shared = None
        processes, self._processes = self._processes, []
        for process in processes:
            process.stop()

    def _lines(
        self, work: Work, shared: Any, tasks: Sequence[Any], follow: Follow | None, report: Report | None
    ) -> list[Any]:
        given = self._pickled(shared)
        results: list[Any] = [None] * len(tasks)
        waiting = deque(Assignment(i, Order(work, task, report is not None)) for i, task in enumerate(tasks))
        while True:
            self._hand_out(waiting, given)
            if all(process.assignment is None for process in self._processes):
                return results
            for process, done, kind, content in self._heard():
                if kind == "report":
                    if report is not None:
                        report(*content)
                elif kind == "died":
                    self._stop(process)
                    waiting.appendleft(_again(done, content))
                else:
                    process.assignment = None
                    results[done.line] = unpacked(content)
                    self._hand_out(waiting, given)  # no worker is idle while the caller looks at the result
                    following = None if follow is None else follow(done.line, results[done.line])
                    if following is not None:
                        waiting.append(Assignment(done.line, Order(work, following, report is not None)))

    def _pickled(self, shared: Any) -> bytes:
        """Return `shared` pickled: the same bytes as last time if it is the same object."""
        if self._shared is None or self._shared[0] is not shared:
            self._shared = shared, cloudpickle.dumps(shared)
        return self._shared[1]

    def _hand_out(self, waiting: deque[Assignment], shared: bytes) -> None:
        """Give tasks to idle workers, of which more are started if need be."""
        idle = [process for process in self._processes if process.assignment is None]
        for _ in range(min(len(waiting) - len(idle), self.workers - len(self._processes))):
            idle.append(WorkerProcess())
            self._processes.append(idle[-1])
        for process in idle[: len(waiting)]:
            process.give(waiting.popleft(), shared)

    def _heard(self) -> Iterator[tuple[WorkerProcess, Assignment, str, Any]]:
        """Wait for the workers, and give one message of each that has something to say: (who, on what, …)."""
        busy = {p.connection: (p, p.assignment) for p in self._processes if p.assignment is not None}
        wait([*busy, *(process.process.sentinel for process, _ in busy.values())], timeout=_TICK_S)
        for process, assignment in busy.values():
            message = process.message()
            if message is not None:
                yield process, assignment, *message

    def _abandon(self) -> None:
        """Stop the workers that are doing something; the others stay."""
        for process in [process for process in self._processes if process.assignment is not None]:
            self._stop(process)

    def _stop(self, process: WorkerProcess) -> None:
        self._processes.remove(process)
        process.stop()


def _again(done: Assignment, how: str) -> Assignment:
    """Return a task to be done once more; LostTaskError if that has been tried often enough."""
    if done.deaths + 1 >= MOST_DEATHS:
        raise LostTaskError(done.line, how)
    return done._replace(deaths=done.deaths + 1)


def _name_of_signal(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


@contextmanager
def _quiet_start() -> Iterator[None]:
    """Start a process that no interrupt reaches, and that does not run the calling program once more.

    A spawned process imports the program's main module, which without ``if __name__ == "__main__":`` would start
    processes in its turn. Functions of that module travel by value here, so that no worker has to import it.
    """
    with _starting:
        main = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if _MASKS else None
        try:
            yield
        finally:
            sys.modules["__main__"] = main
            if blocked is not None:
                signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


_MASKS = hasattr(signal, "pthread_sigmask")


@atexit.register
def _close_all() -> None:
    for pool in list(_pools):
        pool.close()
