"""The interface of an engine, which runs tasks in parallel, and the engine that runs them in this process.

The results depend neither on the engine nor on the number of workers, unless the tasks themselves do.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Protocol, Self, runtime_checkable

from fmu.engines.blas import single_thread
from fmu.engines.memory import free_memory
from fmu.progress import Report

type Work[Shared, Task, Result] = Callable[[Shared, Task, Report | None], Result]
"""``work(shared, task, report)``, a function defined at module level."""
type Follow[Task, Result] = Callable[[int, Result], Task | None]
"""``follow(i, result)`` returns the next task of sequence i, or None if the sequence has ended."""

MAX_DEATHS = 3
"""Number of worker deaths after which a task is abandoned."""


class RunFailedError(RuntimeError):
    """Raised if a run fails for a reason outside fmu, such as a model that often fails or workers that die."""


class LostTaskError(RunFailedError):
    """Raised when `MAX_DEATHS` workers in a row have died while they ran the same task.

    Attributes
    ----------
    sequence : int
        Index of the sequence to which the task belongs.
    how : str
        How the last worker died, in words.
    """

    def __init__(self, sequence: int, how: str) -> None:
        super().__init__(sequence, how)
        self.sequence = sequence
        self.how = how

    def __str__(self) -> str:
        return f"task {self.sequence}: its worker died {MAX_DEATHS} times in a row ({self.how})"


@runtime_checkable
class Engine(Protocol):
    """Runs tasks in parallel. Used as a context manager, it stops its workers at the end of the block."""

    @property
    def workers(self) -> int:
        """Number of tasks that can run at the same time."""
        ...

    def free_memory(self) -> int | None:
        """Return the bytes of memory that the workers may use together, or None if this is not known."""
        ...

    def run_tasks[Shared, Task, Result](
        self,
        work: Work[Shared, Task, Result],
        shared: Shared,
        tasks: Sequence[Task],
        follow: Follow[Task, Result] | None = None,
        report: Report | None = None,
    ) -> list[Result]:
        """Run ``work(shared, task, report)`` for every task, and for the tasks that follow from the results.

        In a sequence, each task follows from the result of the previous task. The tasks of a sequence run one
        after the other; different sequences run in parallel.

        Parameters
        ----------
        work : callable
            A function defined at module level.
        shared : object
            Data that all tasks need. A worker receives the object only once, until a different object is passed.
        tasks : sequence
            The first task of every sequence. No task may be None.
        follow : callable, optional
            Called in this process as ``follow(i, result)``, where i is the index of the sequence in `tasks`. It
            returns the next task of the sequence, or None if the sequence has ended. If `follow` is None, every
            sequence is a single task.
        report : callable, optional
            Called in this process with the progress that `work` reports. From a worker in another process, at most
            about ten reports a second are passed on, but always the last report of each phase. If `report` is
            None, None is passed to `work`.

        Returns
        -------
        list
            The last result of every sequence, in the order of `tasks`.

        Raises
        ------
        Exception
            The exception of the first task that failed. The remaining tasks are abandoned.
        LostTaskError
            If `MAX_DEATHS` workers in a row have died while they ran the same task.
        RunFailedError
            If the connection to a cluster is lost.
        """
        ...

    def close(self) -> None:
        """Stop the workers."""
        ...

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


class InProcess(Engine):
    """Runs all tasks in this process, one after the other. BLAS uses one thread, as in a worker."""

    workers = 1

    def __repr__(self) -> str:
        return "InProcess()"

    def run_tasks[Shared, Task, Result](
        self,
        work: Work[Shared, Task, Result],
        shared: Shared,
        tasks: Sequence[Task],
        follow: Follow[Task, Result] | None = None,
        report: Report | None = None,
    ) -> list[Result]:
        """Run the tasks without copying `shared`; see `Engine.run_tasks`."""
        results: dict[int, Result] = {}
        waiting = deque(enumerate(tasks))
        with single_thread():
            while waiting:
                i, task = waiting.popleft()
                results[i] = work(shared, task, report)
                following = None if follow is None else follow(i, results[i])
                if following is not None:
                    waiting.append((i, following))
        return [results[i] for i in range(len(tasks))]

    def free_memory(self) -> int | None:
        """Return the free bytes of memory on this machine or in this container, or None if they are not known."""
        return free_memory()

    def close(self) -> None:
        """Do nothing: there are no workers to stop."""
