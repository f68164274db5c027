"""Every sampler on priors of every kind at once: half-bounded, unbounded and bounded, against quadrature."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

import fmu
from fmu.analysis.trace.reading import parameter_draws
from tests.samplers.moments import assert_right

SD = 0.5
MEASURED = np.array([11.9, 11.8, 10.2])


class Sums:
    """Three frequencies that each know of two parameters, the last of one: f = 10 + their sum."""

    n_parameters, n_modes = 5, 3
    slopes = np.array([[1.0, 1.0, 0, 0, 0], [0, 0, 1.0, 1.0, 0], [0, 0, 0, 0, 1.0]])

    def frequencies(self, theta):
        return 10.0 + np.stack([theta[:, 0] + theta[:, 1], theta[:, 2] + theta[:, 3], theta[:, 4]], axis=1)

    def frequencies_and_gradient(self, theta):
        return self.frequencies(theta), np.broadcast_to(self.slopes, (len(theta), 3, 5))


LOG_NORMAL = fmu.LogNormal.from_mode(1.3, sd=1.0)
PARAMETERS = [
    fmu.Parameter("log-normal", 1.0, prior=LOG_NORMAL),
    fmu.Parameter("normal", 0.0, prior=fmu.Normal(0.7, mean=0.2)),
    fmu.Parameter("half-normal", 1.0, prior=fmu.HalfNormal(1.5)),
    fmu.Parameter("beta", 0.5, prior=fmu.ScaledBeta(2.0, 1.5, -1.0, 2.0)),
    fmu.Parameter("uniform", 0.5, 0.0, 3.0),
]
REFERENCES = [
    stats.lognorm(LOG_NORMAL.sigma, scale=LOG_NORMAL.median),
    stats.norm(0.2, 0.7),
    stats.halfnorm(scale=1.5),
    stats.beta(2.0, 1.5, -1.0, 3.0),
    stats.uniform(0.0, 3.0),
]


def grid(reference, n=300):
    """Gauss–Legendre nodes over all but 1e-13 of a distribution, and weights times its density."""
    low, high = reference.ppf(1e-13), reference.isf(1e-13)
    node, weight = np.polynomial.legendre.leggauss(n)
    x = 0.5 * (low + high) + 0.5 * (high - low) * node
    return x, 0.5 * (high - low) * weight * reference.pdf(x)


def moments_of(references, measured):
    """Mean and covariance of parameters whose sum, plus 10, was measured, and the evidence."""
    x, w = zip(*map(grid, references), strict=True)
    X = np.stack(np.meshgrid(*x, indexing="ij"), axis=-1).reshape(-1, len(references))
    W = w[0] if len(w) == 1 else np.outer(*w).ravel()
    W = W * stats.norm.pdf(10.0 + X.sum(axis=1), measured, SD)
    mean = W @ X / W.sum()
    return mean, (W * (X - mean).T) @ (X - mean) / W.sum(), W.sum()


@pytest.fixture(scope="module")
def target():
    """Exact mean, covariance and log-evidence."""
    mean, covariance, log_evidence = np.zeros(5), np.zeros((5, 5)), 0.0
    for part, measured in zip((slice(0, 2), slice(2, 4), slice(4, 5)), MEASURED, strict=True):
        mean[part], covariance[part, part], evidence = moments_of(REFERENCES[part], measured)
        log_evidence += np.log(evidence)
    return SimpleNamespace(ndim=5, mean=mean, covariance=covariance, log_evidence=log_evidence)


@pytest.fixture(scope="module")
def problem():
    return fmu.UpdatingProblem.reduced(Sums(), fmu.ModalData(MEASURED), PARAMETERS, beta=0.5 / SD**2)


SAMPLERS = {
    "mh": ("mh", 16, 3000),
    "slice": ("slice", 16, 1000),
    "hmc": ("hmc", 32, 100),
    "hmc, central differences": (fmu.HamiltonianMonteCarlo(gradient="central-difference"), 4, 800),
    "emcee": (fmu.Ensemble(walkers=128), 4, 500),
}


@pytest.mark.parametrize(
    "name",
    [
        "hmc",
        *(pytest.param(name, marks=pytest.mark.validate) for name in SAMPLERS if name != "hmc"),
    ],
)
def test_a_posterior_of_mixed_priors(problem, target, name):
    sampler, chains, draws = SAMPLERS[name]
    trace = fmu.sample(problem, sampler, draws=draws, warmup=200, chains=chains, seed=20261121)
    position = parameter_draws(trace)
    result = SimpleNamespace(
        posterior=SimpleNamespace(position=position),
        chains=chains,
        draws=draws,
        walkers=position.shape[1] // draws,
    )
    assert_right(target, result)


def test_the_mass_of_its_maximum_is_the_evidence(problem, target):
    """Importance sampling from Gaussians cut off by the walls, worth some 600 draws: a standard error of 4 %."""
    found = fmu.find_map(problem, starts=32)
    assert len(found.maxima) == 1
    assert found.maxima[0].log_mass == pytest.approx(target.log_evidence, abs=0.15)
    assert np.all(np.isfinite(found.maxima[0].sd))
