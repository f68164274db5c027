"""What every test runs under: one BLAS thread, a cache of reduced bases that ends with the session, its worker."""

import gc
import math
import os
import signal

import pytest
from threadpoolctl import threadpool_limits

import fmu
from fmu.analysis import certificate
from fmu.analysis.held_out import modes
from fmu.progress import lines
from tests.pictures import without_pictures

FREE_S = modes._FREE_S


gc.set_threshold(50_000, 20, 20)  # otherwise it takes one second in twenty


def pytest_collection_finish():
    """Keep what the collection made out of the garbage collector."""
    gc.freeze()


ROOMS = ("tests/cli/", "tests/engines/", "tests/paper/", "tests/report/")
"""Folders whose session fixtures are dear: a run, a cluster, rendered pages."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Give the tests of a file to one worker, and those of a room too, so that its fixtures are made once."""
    from xdist.scheduler import LoadScopeScheduling

    class ByRoom(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            return next((room for room in ROOMS if nodeid.startswith(room)), nodeid.partition("::")[0])

    return ByRoom(config, log)


@pytest.fixture(scope="session", autouse=True)
def _one_blas_thread():
    with threadpool_limits(1):
        yield


@pytest.fixture(scope="session", autouse=True)
def _ctrl_c_ends_programs():
    """Take Ctrl-C (SIGINT) also where a shell runs pytest in the background, with SIGINT ignored.

    Programs that tests start would ignore it too, and run to their end instead of stopping.
    """
    before = signal.getsignal(signal.SIGINT)
    if before == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


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


@pytest.fixture(scope="session", autouse=True)
def _no_waits_for_the_disk():
    """Leave files to the system's cache: a power failure in a test is told by what is called, not by the disk."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda handle: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def _no_time_for_refits():
    """Leave no mode out after a run: that takes longer than most runs, and the tests of it ask for `refits`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(modes, "_FREE_S", 0.0)
        yield


@pytest.fixture(scope="session", autouse=True)
def _no_lines_of_a_log():
    """Write no lines of progress on standard error: how many there are depends on the clock."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lines, "FIRST_S", math.inf)
        yield


AS_USUAL = certificate.USUAL


@pytest.fixture(scope="session", autouse=True)
def _few_draws_certified():
    """Certify reduced models at a few draws, or that takes longer than most runs; `certified` asks for all."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(certificate, "USUAL", certificate.Effort(fewest=6, most=6, solved=4, worst=2))
        yield


@pytest.fixture(scope="module")
def certified():
    """Certify runs at as many draws as a user's are."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(certificate, "USUAL", AS_USUAL)
        yield


@pytest.fixture(scope="module")
def refits():
    """Give runs the time that a user's have, for updating without single modes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(modes, "_FREE_S", FREE_S)
        yield


@pytest.fixture(scope="session")
def section():
    """The problem whose posterior has separate modes, nearly all its probability in one that is hard to find."""
    return fmu.cases.load("cantilever-section", "index")


@pytest.fixture(scope="session")
def section_maxima(section):
    """Return the maxima that a search from the usual starts finds, the most probable first."""
    return fmu.find_map(section)


@pytest.fixture(scope="module")
def quick_figures():
    """Leave out the layout of figures, half of the time that they take: other tests are of how they look."""
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ConstrainedLayoutEngine, "execute", lambda self, figure: {})
        yield


@pytest.fixture(scope="module")
def no_pictures():
    """Leave the pictures of pages empty: most of the time of a page. Some are drawn for what is said of them."""
    with without_pictures():
        yield
