"""What there is to report on, run for a few seconds: too short to mean anything, long enough to write down.

Runs on the cantilever, on a black-box model with hostile names, on a plain density.
"""

import fcntl
from contextlib import contextmanager

import numpy as np
import pytest
from matplotlib.layout_engine import ConstrainedLayoutEngine

import fmu
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal
from fmu.posterior.problem import UpdatingProblem
from fmu.report import pages
from fmu.report.pages import write_pages
from tests import measured_frfs
from tests.linear import LinearModel
from tests.report.browser import short_run, started
from tests.report.parsed import IMAGE, SCRIPT


@pytest.fixture(scope="session")
def chromium(tmp_path_factory):
    """Chromium, started once for all tests of a worker."""
    driver = started(tmp_path_factory.mktemp("profile"))
    yield driver
    driver.quit()


@pytest.fixture(scope="module")
def browser(chromium):
    """Chromium, which leaves its page at the end of a file: what moves there would take a core until it quits."""
    yield chromium
    chromium.get("about:blank")


class Gaussian:
    """A density without names, units, prior or measurement."""

    ndim = 2
    lower = np.array([-np.inf, -5.0])
    upper = np.array([np.inf, np.inf])

    def log_prob(self, x):
        return -0.5 * np.sum((np.asarray(x) - [0.0, 3.0]) ** 2, axis=-1)

    def log_prob_and_grad(self, x):
        return self.log_prob(x), [0.0, 3.0] - np.asarray(x)

    def sample_prior(self, rng, n):
        return rng.normal(size=(n, 2))


@pytest.fixture(scope="session")
def beam_traces():
    """Short runs on the cantilever: two samplers, with all that a trace can keep."""
    problem = fmu.cases.load("cantilever-young")
    maxima = fmu.find_map(problem, starts=16)
    lengths = {"hmc": {"draws": 60, "warmup": 60}, "emcee": {"draws": 12, "warmup": 10}}
    return {name: fmu.sample(problem, name, chains=2, maxima=maxima, **n) for name, n in lengths.items()}


@pytest.fixture(scope="session")
def frf_trace():
    """A short run on frequency response functions alone, with lines that are not used, a gain and delays."""
    data = measured_frfs.simulate(use=(measured_frfs.LINES < 5.0) | (measured_frfs.LINES > 6.0))
    own = fmu.FRFErrors(data, fmu.ModalDamping(measured_frfs.ratios()), gain_sd={(0, "x"): 0.1}, delay_sd=1e-3)
    parts = measured_frfs.building(), measured_frfs.modes(), measured_frfs.parameters()
    return fmu.sample(fmu.UpdatingProblem(*parts, error=own), "mixture", draws=60, warmup=60, chains=4)


@pytest.fixture(scope="session")
def problem():
    """A black-box model whose names are HTML and mathematics."""
    parameters = [
        Parameter(IMAGE, start=0.5, lower=-4.0, upper=4.0, prior=Normal(1.0), unit="Pa"),
        Parameter("$x_1$ & &amp;", start=0.0, prior=Normal(2.0), unit="<b>"),
    ]
    data = ModalData([101.0, 99.5, 102.0], labels=(IMAGE, "</style>", "$a$"))
    return UpdatingProblem(LinearModel(), data, parameters, beta=[0.5, 1.0, 2.0], name=SCRIPT)


@pytest.fixture(scope="session")
def hostile_traces(problem):
    """Runs on the black-box model, one with a name that is HTML too."""
    maxima = fmu.find_map(problem, starts=4)
    trace = fmu.sample(problem, "hmc", draws=40, warmup=30, chains=2, maxima=maxima)
    return {"hmc": trace, SCRIPT: trace}


@pytest.fixture(scope="session")
def plain_traces():
    """Runs on a plain density: one that converges, one of a single chain that cannot."""
    return {
        "hmc": fmu.sample(Gaussian(), "hmc", draws=400, warmup=200, chains=4),
        "mh": fmu.sample(Gaussian(), "mh", draws=60, warmup=30, chains=1),
    }


@contextmanager
def without_layout(seen=()):
    """Leave out the layout of figures, but on the pages `seen` in a browser: half of the time of a page."""
    sampler_page, index_page, execute = pages.sampler_page, pages.index_page, ConstrainedLayoutEngine.execute

    def write_page(page, name, *arguments):
        with pytest.MonkeyPatch.context() as patch:
            if name in seen:
                patch.setattr(ConstrainedLayoutEngine, "execute", execute)
            return page(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ConstrainedLayoutEngine, "execute", lambda self, figure: {})
        patch.setattr(pages, "sampler_page", lambda run, *more: write_page(sampler_page, run.name, run, *more))
        patch.setattr(pages, "index_page", lambda *given: write_page(index_page, pages.INDEX, *given))
        yield


def written_once(name, seen, request, tmp_path_factory):
    """Return the directory of the pages on the traces `name`, written by the first worker that needs them."""
    shared_folder = request.getfixturevalue("shared_folder")
    folder = shared_folder / f"pages-{name}"
    with (shared_folder / f"pages-{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            unfinished = tmp_path_factory.mktemp(name)
            with without_layout(seen):
                write_pages(request.getfixturevalue(name), unfinished)
            unfinished.rename(folder)
    return folder


@pytest.fixture(scope="session")
def beam_report(request, tmp_path_factory):
    """Directory of the pages on `beam_traces`."""
    return written_once("beam_traces", ("hmc", "index"), request, tmp_path_factory)


@pytest.fixture(scope="session")
def hostile_report(request, tmp_path_factory):
    """Directory of the pages on `hostile_traces`."""
    return written_once("hostile_traces", ("hmc",), request, tmp_path_factory)


@pytest.fixture(scope="session")
def garteur_report(tmp_path_factory):
    """Directory of a page on eleven parameters and ten modes with long names, in space."""
    return short_run("garteur", tmp_path_factory.mktemp("garteur"))


@pytest.fixture(scope="session")
def plain_report(request, tmp_path_factory):
    """Directory of the pages on `plain_traces`."""
    return written_once("plain_traces", ("mh",), request, tmp_path_factory)
