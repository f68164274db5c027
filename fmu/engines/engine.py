"""The one interface to everything that computes side by side, and the engine that does it one after the other.

A *line* is a chain of tasks, each of which depends on the result before; lines run side by side. What comes out
depends on neither the engine nor the number of its workers, if the work does not.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Protocol, Self

from fmu.progress import Report

Work = Callable[[Any, Any, Report | None], Any]
"""``work(shared, task, report)``, a function of a module."""
Follow = Callable[[int, Any], Any]
"""``follow(i, result)`` gives the next task of line i, or None if it has ended."""

MOST_DEATHS = 3
"""How many times in a row a task may cost its worker's life before it is given up."""


class LostTaskError(RuntimeError):
    """The workers that tried a task died one after the other.

    Attributes
    ----------
    line : int
        Which line the task belongs to.
    how : str
    """

    def __init__(self, line: int, how: str) -> None:
        super().__init__(line, how)
        self.line = line
        self.how = how

    def __str__(self) -> str:
        return f"task {self.line}: its worker died {MOST_DEATHS} times in a row ({self.how})"


class Engine(Protocol):
    """Does tasks, in an order and a place of its own."""

    @property
    def workers(self) -> int:
        """How many tasks run at once."""
        ...

    def run_tasks(
        self,
        work: Work,
        shared: Any,
        tasks: Sequence[Any],
        follow: Follow | None = None,
        report: Report | None = None,
    ) -> list[Any]:
        """Do ``work(shared, task, report)`` for every task, and for every task that follows from a result.

        Parameters
        ----------
        work : callable
            A function of a module.
        shared : object
            What all tasks need; it is sent to each worker once, and again only if it is another object.
        tasks : sequence
            The first task of every line, none of them None.
        follow : callable, optional
            Called in this process as results come; gives the next task of the line, or None if it has ended.
            Without it every line is one task.
        report : callable, optional
            Called in this process for what work reports, some ten times a second at most; without it work gets
            None.

        Returns
        -------
        list
            The last result of every line, in the order of `tasks`.

        Raises
        ------
        Exception
            What the first task to fail raised; the other lines are abandoned.
        LostTaskError
            If a task's worker died, and that of its second try, and of its third.
        """
        ...

    def close(self) -> None:
        """Let the workers go."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class ContextManager:
    """Closes what it is a part of at the end of a ``with`` block."""

    def close(self) -> None:
        """Do nothing: there is nothing to let go."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class InProcess(ContextManager):
    """Does one task of each line in turn, here; BLAS has one thread meanwhile, as it has in every worker."""

    workers = 1

    def __repr__(self) -> str:
        return "InProcess()"

    def run_tasks(
        self,
        work: Work,
        shared: Any,
        tasks: Sequence[Any],
        follow: Follow | None = None,
        report: Report | None = None,
    ) -> list[Any]:
        """Do the tasks of all lines, see `Engine.run_tasks`; `shared` is passed as it is."""
        from threadpoolctl import threadpool_limits

        results: list[Any] = [None] * len(tasks)
        waiting = deque(enumerate(tasks))
        with threadpool_limits(1, "blas"):
            while waiting:
                i, task = waiting.popleft()
                results[i] = work(shared, task, report)
                following = None if follow is None else follow(i, results[i])
                if following is not None:
                    waiting.append((i, following))
        return results


def engine(workers: int = 1, cluster: str | None = None) -> Engine:
    """Return what runs tasks side by side; it is a context manager.

    Parameters
    ----------
    workers : int
        Processes of this machine; with 1 everything happens in this one.
    cluster : str, optional
        Instead of them a Dask cluster: ``"tcp://host:port"``, the address of its scheduler, or ``"local:N"``, a
        cluster of N processes of this machine.

    Returns
    -------
    Engine

    Raises
    ------
    ValueError
        If a number is out of range, the package ``distributed`` is missing, or no scheduler answers.

    Examples
    --------
    ``with fmu.engine(workers=4) as engine, model.spread_over(engine): fmu.find_map(problem)``
    """
    if cluster is not None:
        try:
            from fmu.engines.dask_cluster import DaskCluster
        except ImportError as error:
            raise ValueError("--cluster: needs the package distributed: pip install 'fmu[distributed]'") from error
        return DaskCluster(cluster)
    if workers < 1:
        raise ValueError(f"workers: must be at least 1 (got {workers})")
    if workers == 1:
        return InProcess()
    from fmu.engines.process_pool import ProcessPool

    return ProcessPool(workers)


def default_workers() -> int:
    """Return the number of CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
