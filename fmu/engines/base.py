"""The interface of an engine, which runs tasks side by side, and the engine that runs them in this process.

The results depend neither on the engine nor on the number of its workers, provided that the work itself does not.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Protocol, Self, runtime_checkable

from fmu.progress import Report

type Work[Shared, Task, Result] = Callable[[Shared, Task, Report | None], Result]
"""``work(shared, task, report)``, a function of a module."""
type Follow[Task, Result] = Callable[[int, Result], Task | None]
"""``follow(i, result)`` returns the next task of sequence i, or None if the sequence has ended."""

MAX_DEATHS = 3
"""Worker deaths at which a task is given up."""


class RunFailedError(RuntimeError):
    """A run failed for a reason outside fmu, such as a model that fails too often or workers that die."""


class LostTaskError(RunFailedError):
    """Every worker that tried a task died.

    Attributes
    ----------
    sequence : int
        Index of the sequence that the task belongs to.
    how : str
        How the last worker died.
    """

    def __init__(self, sequence: int, how: str) -> None:
        super().__init__(sequence, how)
        self.sequence = sequence
        self.how = how

    def __str__(self) -> str:
        return f"task {self.sequence}: its worker died {MAX_DEATHS} times in a row ({self.how})"


@runtime_checkable
class Engine(Protocol):
    """Runs tasks side by side; a context manager that stops its workers at the end of the block."""

    @property
    def workers(self) -> int:
        """Number of tasks that run at once."""
        ...

    def run_tasks[Shared, Task, Result](
        self,
        work: Work[Shared, Task, Result],
        shared: Shared,
        tasks: Sequence[Task],
        follow: Follow[Task, Result] | None = None,
        report: Report | None = None,
    ) -> list[Result]:
        """Run ``work(shared, task, report)`` for every task, and for every task that follows from a result.

        A sequence of tasks, in which each follows from the result of the one before, runs one after the other;
        the sequences run side by side.

        Parameters
        ----------
        work : callable
            A function of a module.
        shared : object
            Data that all tasks need. A worker receives it once, and again only if it is a different object.
        tasks : sequence
            The first task of every sequence, none of them None.
        follow : callable, optional
            Called in this process for every result. It returns the next task of the sequence, or None if the
            sequence has ended. Without it, every sequence is a single task.
        report : callable, optional
            Called in this process with the progress that the work reports, at most about ten times a second for
            each worker. Without it, the work gets None.

        Returns
        -------
        list
            The last result of every sequence, in the order of `tasks`.

        Raises
        ------
        Exception
            The exception of the first task that failed. The other tasks are abandoned.
        LostTaskError
            If the worker of a task died `MAX_DEATHS` times.
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
    """Runs one task of each sequence in turn in this process, with one BLAS thread, as in every worker."""

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
        """Run the tasks, see `Engine.run_tasks`; `shared` is passed as it is."""
        from threadpoolctl import threadpool_limits

        results: dict[int, Result] = {}
        waiting = deque(enumerate(tasks))
        with threadpool_limits(1, "blas"):
            while waiting:
                i, task = waiting.popleft()
                results[i] = work(shared, task, report)
                following = None if follow is None else follow(i, results[i])
                if following is not None:
                    waiting.append((i, following))
        return [results[i] for i in range(len(tasks))]

    def close(self) -> None:
        """Do nothing: there are no workers to stop."""
