"""Engines run tasks in this process, in other processes or on a Dask cluster, and give the same results.

Read `base` (the interface) first, then `remote` (the code shared by the two engines with worker processes).
"""

from __future__ import annotations

import os
from typing import Annotated

from fmu.arguments import Workers, check_arguments
from fmu.engines.base import Engine, InProcess


@check_arguments
def engine(
    workers: Annotated[Workers, "the address of a cluster is given as cluster="] = 1, cluster: str | None = None
) -> Engine:
    """Return an engine that runs tasks in parallel; use it as a context manager.

    Parameters
    ----------
    workers : int
        Number of processes on this machine. If 1, all tasks run in this process.
    cluster : str, optional
        A Dask scheduler's address, ``"tcp://host:port"``. If given, the cluster runs the tasks, and `workers` has
        no effect.

    Returns
    -------
    Engine

    Raises
    ------
    ValueError
        If a number is out of range, the package ``distributed`` is missing, the address has another form, or no
        scheduler answers.

    Examples
    --------
    ``with fmu.engine(workers=4) as engine, problem.model.spread_over(engine): fmu.find_map(problem)``
    """
    if cluster is not None:
        try:
            from fmu.engines.dask_cluster import DaskCluster
        except ImportError as error:
            raise ValueError("--cluster: needs the package distributed: pip install 'fmu[distributed]'") from error
        return DaskCluster(cluster)
    if workers == 1:
        return InProcess()
    from fmu.engines.process_pool import ProcessPool

    return ProcessPool(workers)


def default_workers() -> int:
    """Return the number of CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
