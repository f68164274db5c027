"""Code shared by the engines with worker processes: pickled tasks and outcomes, and the loop over the tasks.

`RemoteEngine` and `unpack_outcome` run in the calling process; `carry_out` and `limit_blas_threads` run in a
worker.
"""

from __future__ import annotations

import os
import pickle
import threading
import traceback
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import cloudpickle

from fmu.engines.base import MAX_DEATHS, Engine, Follow, InProcess, LostTaskError, Work
from fmu.engines.blas import THREADS
from fmu.progress import Info, Report
from fmu.progress.pace import Throttle

_REPORT_INTERVAL_S = 0.1
Message = tuple[str, int, int, Info]
"""The arguments of a `Report`."""


class Task(NamedTuple):
    """One task of a sequence, waiting or running."""

    sequence: int
    work: Callable[..., object]
    argument: object
    reports: bool
    deaths: int = 0
    """Number of workers that died while they ran this task."""

    def pack(self) -> bytes:
        """Return `work`, `argument` and `reports` as bytes, pickled for a worker."""
        return bytes(cloudpickle.dumps((self.work, self.argument, self.reports)))


def pack_shared(shared: object) -> bytes:
    """Return the object that all tasks need, pickled for the workers.

    Raise ValueError if something that it holds, such as a lock or an open file, cannot be pickled.
    """
    try:
        return bytes(cloudpickle.dumps(shared))
    except (TypeError, AttributeError, pickle.PicklingError) as error:
        raise ValueError(
            f"workers: the problem cannot be sent to another process ({error}): let the model's function make "
            "such an object itself when it is called, or use workers=1"
        ) from error


class Outcome(NamedTuple):
    """Outcome of a task: the bytes that `carry_out` returned, or the number of worker deaths in a row.

    `how` says how the last worker died.
    """

    packed: bytes = b""
    deaths: int = 0
    how: str = ""


class RemoteError(Exception):
    """Traceback from a worker, set as the cause of the exception that is raised in the calling process."""

    def __str__(self) -> str:
        return f"\n{self.args[0]}"


class RemoteEngine(Engine):
    """Base class of the engines with workers in other processes.

    While the engine is busy, calls to `run_tasks` from `follow` or from other threads run in the calling process.
    """

    def __init__(self) -> None:
        self._busy = threading.Lock()

    def run_tasks[Shared, Step, Result](
        self,
        work: Work[Shared, Step, Result],
        shared: Shared,
        tasks: Sequence[Step],
        follow: Follow[Step, Result] | None = None,
        report: Report | None = None,
    ) -> list[Result]:
        """Run the tasks; see `fmu.engines.base.Engine.run_tasks`."""
        if not self._busy.acquire(blocking=False):
            return InProcess().run_tasks(work, shared, tasks, follow, report)
        results: dict[int, Result] = {}
        waiting = deque(Task(i, work, task, report is not None) for i, task in enumerate(tasks))
        try:
            while self._start(waiting, shared):
                for task, outcome in self._take_ended(report):
                    if outcome.deaths:
                        waiting.appendleft(_again(task, outcome))
                        continue
                    results[task.sequence] = unpack_outcome(outcome.packed)
                    self._start(waiting, shared)  # no worker is idle while `follow` runs
                    following = None if follow is None else follow(task.sequence, results[task.sequence])
                    if following is not None:
                        waiting.append(Task(task.sequence, work, following, report is not None))
        except BaseException:
            self._abandon()
            raise
        finally:
            self._busy.release()
        return [results[i] for i in range(len(tasks))]

    @abstractmethod
    def _start(self, waiting: deque[Task], shared: object) -> bool:
        """Start waiting tasks on idle workers, and remove these tasks from `waiting`.

        Return True if any task is running.
        """

    @abstractmethod
    def _take_ended(self, report: Report | None) -> Iterator[tuple[Task, Outcome]]:
        """Wait for the workers, pass on their reports, and yield each ended task with its outcome.

        A task has also ended if its worker has died.
        """

    @abstractmethod
    def _abandon(self) -> None:
        """Abandon the running tasks."""


class Shared:
    """Data for all tasks, unpickled on the first call. An unpickling error is thus raised within a task."""

    def __init__(self, packed: bytes) -> None:
        self._packed: bytes | None = packed
        self._value: object = None

    def __call__(self) -> object:
        """Return the data."""
        if self._packed is not None:
            self._value = cloudpickle.loads(self._packed)
            self._packed = None
        return self._value


def carry_out(task: bytes, shared: Callable[[], object], send: Callable[[Message], None]) -> bytes:
    """Run a pickled task and return its pickled outcome: (result, exception or None, traceback).

    The task's reports are passed to `send`: at most ten per second, besides the last report of each phase. An
    exception that cannot be pickled is replaced by a RuntimeError with its text.
    """
    try:
        work, argument, reports = cloudpickle.loads(task)
        result = work(shared(), argument, _throttle_reports(send) if reports else None)
        return bytes(cloudpickle.dumps((result, None, "")))
    except BaseException as error:
        where = traceback.format_exc()
        try:
            packed = bytes(cloudpickle.dumps((None, error, where)))
            cloudpickle.loads(packed)
        except Exception:  # the exception cannot be pickled: send its text
            text = RuntimeError(f"{type(error).__name__}: {error}")
            packed = bytes(cloudpickle.dumps((None, text, where)))
        return packed


def unpack_outcome(outcome: bytes) -> Any:
    """Return the result of a task, or raise the exception with which it ended."""
    result, error, where = cloudpickle.loads(outcome)
    if error is not None:
        raise error from RemoteError(where)
    return result


def limit_blas_threads() -> None:
    """Limit BLAS to one thread in this process.

    The limit also holds for libraries that are loaded later, unless the user has set a number of threads.
    """
    import numpy.linalg  # noqa: F401
    import scipy.linalg  # noqa: F401
    from threadpoolctl import threadpool_limits

    for name in THREADS:
        os.environ.setdefault(name, "1")
    threadpool_limits(1, "blas")


def _again(task: Task, outcome: Outcome) -> Task:
    """Return the task for another run, with the worker deaths in `outcome` added to its own count.

    Raise LostTaskError if this count has reached `MAX_DEATHS`.
    """
    deaths = task.deaths + outcome.deaths
    if deaths >= MAX_DEATHS:
        raise LostTaskError(task.sequence, outcome.how)
    return task._replace(deaths=deaths)


def _throttle_reports(send: Callable[[Message], None]) -> Report:
    throttle = Throttle(_REPORT_INTERVAL_S)

    def report(phase: str, done: int, total: int, info: Info) -> None:
        if throttle.lets(None, ends=done >= total):
            send((phase, done, total, dict(info)))

    return report
