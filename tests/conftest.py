"""What every test runs under: one BLAS thread, and a cache of reduced bases that ends with the session."""

import os

import pytest
from threadpoolctl import threadpool_limits


@pytest.fixture(scope="session", autouse=True)
def _one_blas_thread():
    with threadpool_limits(1):
        yield


@pytest.fixture(scope="session", autouse=True)
def _fresh_basis_cache(tmp_path_factory):
    """Bases that an earlier version of the code left in the user's cache must not answer for this one.

    All workers of a session share one cache, so that each basis is trained once.
    """
    folder = tmp_path_factory.getbasetemp()
    folder = folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FMU_CACHE_DIR", os.fspath(folder / "bases"))
        yield
