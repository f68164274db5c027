"""A Dask cluster on this machine, as a user would start one: the engine is given its address."""

import logging
from contextlib import contextmanager

import pytest


@pytest.fixture(scope="session")
def local_cluster():
    dask = pytest.importorskip("dask")
    distributed = pytest.importorskip("distributed")

    @contextmanager
    def start(workers):
        # the scheduler reports every death of a worker, so that it is the engine that counts them
        with (
            dask.config.set({"distributed.scheduler.allowed-failures": 0}),
            distributed.LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
            ) as cluster,
        ):
            yield cluster

    return start


@pytest.fixture(scope="module")
def dask_processes(local_cluster):
    """Two idle processes take some per cent of a core: they end with the tests of a file."""
    with local_cluster(2) as cluster:
        yield cluster
