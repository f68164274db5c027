"""A small updating problem with a linear model, and runs made by hand instead of by a sampler."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from fmu.analysis.trace.conversion import to_trace
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal
from fmu.posterior.problem import UpdatingProblem
from fmu.samplers.loop.record import Draws, RunResult
from tests.centring import all_half_centred  # noqa: F401
from tests.linear import LinearModel


@pytest.fixture
def problem():
    parameters = [
        Parameter("E1", start=0.5, lower=-4.0, upper=4.0, prior=Normal(1.0), unit="Pa"),
        Parameter("rho", start=0.0, prior=Normal(2.0), unit="kg/m³"),
    ]
    data = ModalData([101.0, 99.5, 102.0], labels=("W1", "W2", "T1"))
    return UpdatingProblem(LinearModel(), data, parameters, beta=[0.5, 1.0, 2.0], name="linear")


@pytest.fixture(scope="session")
def around(section, section_maxima):
    """Points scattered within half a standard deviation around a maximum (from 0) of `section`."""

    def scatter(maximum, *shape):
        rng = np.random.default_rng(maximum)
        m = section_maxima[maximum]
        theta = m.mean + 0.5 * m.sd * rng.standard_normal((*shape, section.ndim))
        inset = 1e-3 * (section.upper - section.lower)
        return np.clip(theta, section.lower + inset, section.upper - inset)

    return scatter


@pytest.fixture
def plain():
    """A log-density that knows nothing of frequencies."""
    return SimpleNamespace(ndim=2, lower=np.full(2, -np.inf), upper=np.full(2, np.inf))


@pytest.fixture
def make_result():
    def make(position, *, walkers=1, warmup=None, sampler="mh", wall_s=2.0, seed=5, init="prior", **stats):
        def draws(values):
            shape = values.shape[:2]
            common = {
                "lp": np.zeros(shape),
                "accepted": np.ones(shape, dtype=bool),
                "n_solves": np.full(shape, 3),
                "n_gradients": np.full(shape, 2),
            }
            given = {k: np.broadcast_to(np.atleast_1d(v)[..., : shape[1]], shape) for k, v in stats.items()}
            return Draws(values, common | given)

        warmup = position[:, : 2 * walkers] if warmup is None else warmup
        return RunResult(
            warmup=draws(warmup),
            posterior=draws(position),
            sampler=sampler,
            settings={"scale": 0.1},
            seed=seed,
            walkers=walkers,
            draws=position.shape[1] // walkers,
            warmup_draws=warmup.shape[1] // walkers,
            chains=len(position),
            init=init,
            wall_s=wall_s,
            warmup_wall_s=0.5,
        )

    return make


@pytest.fixture
def make_trace(make_result, plain):
    """A trace of given draws (chains, draws, 2), without a model."""
    return lambda position, **settings: to_trace(make_result(position, **settings), plain)


@pytest.fixture
def ar1():
    """AR(1) series of variance 1 along axis 1: autocorrelation time (1 + phi)/(1 - phi)."""

    def make(rng, shape, phi):
        noise = np.sqrt(1 - phi**2) * rng.standard_normal(shape)
        noise[:, 0] /= np.sqrt(1 - phi**2)
        return lfilter([1.0], [1.0, -phi], noise, axis=1)

    return make
