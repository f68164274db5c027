"""What every test runs under: one BLAS thread, and a cache of reduced bases that ends with the session."""

import os

import pytest
from threadpoolctl import threadpool_limits


@pytest.fixture(scope="session", autouse=True)
def _one_blas_thread():
    with threadpool_limits(1):
        yield


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory):
    """Return the temporary folder that all workers of a session share."""
    folder = tmp_path_factory.getbasetemp()
    return folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder


@pytest.fixture(scope="session", autouse=True)
def _fresh_basis_cache(shared_folder):
    """Bases that an earlier version of the code left in the user's cache must not answer for this one.

    All workers of a session share one cache, so that each basis is trained once.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FMU_CACHE_DIR", os.fspath(shared_folder / "bases"))
        yield
