"""An engine that runs tasks in processes on this machine, each connected to the calling process by its own pipe.

The workers share no queue, no lock that a dying worker could hold, and no thread in the calling process. The task
on which a worker died is therefore known, and only this task is rerun.

A pool of two processes starts in 0.6 to 0.9 s, against 1.6 to 2.5 s for two local processes of Dask 2026.8. Unlike
Dask, it can start processes in a script without ``if __name__ == "__main__":`` or inside a worker.
"""

from __future__ import annotations

import atexit
import multiprocessing
import multiprocessing.util  # its exit handler waits for workers: ours is registered later, so that it runs first
import os
import signal
import sys
import threading
import weakref
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from types import ModuleType
from typing import Any

from fmu.engines.memory import free_memory
from fmu.engines.remote import Outcome, RemoteEngine, Shared, Task, carry_out, limit_blas_threads, pack_shared
from fmu.progress import Report

# Interval at which workers are checked: processes that a worker started may keep its pipe open after its death.
_CHECK_INTERVAL_S = 0.5
_STOP_TIMEOUT_S = 2.0
_MASKS = os.name == "posix"
_starting = threading.Lock()
_pools: weakref.WeakSet[ProcessPool] = weakref.WeakSet()


class WorkerProcess:
    """A worker process, the calling process's end of its pipe, and the task that it is running."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")  # a fork of a process with threads may hang
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=serve, args=(theirs, sys.path, os.getcwd()), name="fmu worker")
        with _quiet_start():
            self.process.start()
        theirs.close()
        self.task: Task | None = None
        self._has: bytes | None = None  # the shared data that were sent last

    def give(self, task: Task, shared: bytes) -> None:
        """Send a task to the worker, preceded by the data that all tasks share unless it already has them.

        If the worker has died, nothing is raised here; `message` reports it.
        """
        packed = task.pack()
        self.task = task
        with suppress(OSError):  # the worker has died; `message` will return this
            if self._has is not shared:
                self._has = shared
                self.connection.send(("shared", shared))
            self.connection.send(("task", packed))

    def message(self) -> tuple[str, Any]:
        """Return the worker's next message.

        It is ``("nothing", None)`` if there is none, and ``("died", how)`` if the worker has died.
        """
        try:
            if self.connection.poll():
                kind, content = self.connection.recv()
                return kind, content
            if self.process.is_alive():
                return "nothing", None
        except (EOFError, OSError):
            self.process.join(_STOP_TIMEOUT_S)
        code = self.process.exitcode
        if code is None:
            return "died", "it closed its pipe"
        return "died", f"exit code {code}" if code >= 0 else _name_of_signal(-code)

    def stop(self) -> None:
        """Stop the process, even if it is busy, and wait for it to end."""
        self.connection.close()
        self.process.terminate()
        self.process.join(_STOP_TIMEOUT_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.process.close()


class ProcessPool(RemoteEngine):
    """An engine whose worker processes start when they are first needed and run until the pool is closed.

    Parameters
    ----------
    workers : int
        Largest number of worker processes.
    """

    def __init__(self, workers: int) -> None:
        super().__init__()
        self._workers = workers
        self._shared: tuple[object, bytes] | None = None  # the object that all tasks need, and its bytes
        self._processes: list[WorkerProcess] = []
        _pools.add(self)

    def __repr__(self) -> str:
        return f"ProcessPool({self.workers} workers)"

    @property
    def workers(self) -> int:
        """Number of processes."""
        return self._workers

    def free_memory(self) -> int | None:
        """Return the free bytes of memory on this machine or in this container, or None if they are not known."""
        return free_memory()

    def close(self) -> None:
        """Stop all workers, even those that are busy."""
        self._shared = None
        processes, self._processes = self._processes, []
        for process in processes:
            process.stop()

    def _start(self, waiting: deque[Task], shared: object) -> bool:
        packed = self._pack_shared(shared)
        idle = [process for process in self._processes if process.task is None]
        for _ in range(min(len(waiting) - len(idle), self.workers - len(self._processes))):
            idle.append(WorkerProcess())
            self._processes.append(idle[-1])
        for process in idle[: len(waiting)]:
            process.give(waiting.popleft(), packed)
        return any(process.task is not None for process in self._processes)

    def _take_ended(self, report: Report | None) -> Iterator[tuple[Task, Outcome]]:
        busy = {p.connection: (p, p.task) for p in self._processes if p.task is not None}
        wait([*busy, *(process.process.sentinel for process, _ in busy.values())], timeout=_CHECK_INTERVAL_S)
        for process, task in busy.values():
            kind, content = process.message()
            if kind == "report" and report is not None:
                report(*content)
            elif kind == "died":
                self._stop(process)
                yield task, Outcome(deaths=1, how=content)
            elif kind == "outcome":
                process.task = None
                yield task, Outcome(content)

    def _abandon(self) -> None:
        """Stop the workers that are running a task; idle workers keep running."""
        for process in [process for process in self._processes if process.task is not None]:
            self._stop(process)

    def _stop(self, process: WorkerProcess) -> None:
        self._processes.remove(process)
        process.stop()

    def _pack_shared(self, shared: object) -> bytes:
        """Return `shared` pickled. The bytes are reused if it is the same object as in the last call."""
        if self._shared is None or self._shared[0] is not shared:
            self._shared = shared, pack_shared(shared)
        return self._shared[1]


def serve(connection: Connection, path: list[str], folder: str) -> None:
    """In a worker process, run all tasks that arrive over a connection, until its other end is closed.

    The worker receives ``("shared", bytes)`` and ``("task", bytes)``, pickled. For each task it sends
    ``("report", arguments)`` any number of times, then ``("outcome", bytes)``.
    """
    # A terminal sends an interrupt to every process; only the calling process answers it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if _MASKS:  # the signal was blocked while the process started
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    sys.path[:] = path
    os.chdir(folder)
    limit_blas_threads()
    shared = Shared(b"")
    while True:
        try:
            kind, content = connection.recv()
            if kind == "shared":
                shared = Shared(content)
            else:
                outcome = carry_out(content, shared, lambda report: connection.send(("report", report)))
                connection.send(("outcome", outcome))
        except (EOFError, OSError):  # the calling process has ended
            return


def _exit_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _name_of_signal(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


@contextmanager
def _quiet_start() -> Iterator[None]:
    """Block interrupts and hide the main module while a worker process starts.

    A spawned process imports the program's main module, which would itself start processes if it lacks ``if
    __name__ == "__main__":``. Functions of the main module are pickled by value here, so no worker has to import
    it.
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


@atexit.register
def _close_all() -> None:
    for pool in list(_pools):
        pool.close()
