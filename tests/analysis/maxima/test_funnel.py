"""The posterior of a model with an inferred scatter is a funnel: its components cover it, and draws are exact."""

from dataclasses import replace

import numpy as np
import pytest

import fmu
from fmu.analysis.convergence.effective import ess_bulk
from fmu.analysis.maxima.funnel import components_along
from fmu.analysis.maxima.starts import components, starts_at_maxima
from fmu.posterior.scaled import ScaledDensity
from fmu.progress.phases import solves
from fmu.samplers.loop.run import Run
from fmu.samplers.mixture.importance import effective_size
from fmu.samplers.mixture.mixture import MixtureSampler
from fmu.samplers.mixture.proposal import Mixture
from tests.shear_building import frequencies_hz, shear_building

SD, PRIOR = 0.004, 0.1
"""Relative error of a frequency, and the prior's standard deviation of the scatter."""
LIMITS = np.array([0.2, 0.6]), np.array([1.3, 3.0])
"""Of two stiffnesses: two others with the same frequencies lie beyond them."""


@pytest.fixture(scope="module")
def funnel():
    """Two storeys with log-normal stiffnesses, and a scatter that two exact frequencies hardly inform."""
    model = shear_building(["k1", "k2"], stiffness=2e4, mass=10.0)
    return fmu.UpdatingProblem(
        model,
        fmu.ModalData(frequencies_hz(model, (1.1, 0.8))[0]),
        [
            fmu.Parameter(name, 1.0, low, high, fmu.LogNormal(1.0, 0.5))
            for name, low, high in zip(("k1", "k2"), *LIMITS, strict=True)
        ],
        error=fmu.FrequencyErrors("relative", sd=SD),
        discrepancy=fmu.Discrepancy(prior_sd=PRIOR),
        pairing="index",
    )


@pytest.fixture(scope="module")
def maxima(funnel):
    return fmu.find_map(funnel, starts=8)


@pytest.fixture(scope="module")
def exact(funnel, maxima):
    """Points and weights of a quadrature: for each scatter a grid as wide as the scatter makes the stiffnesses."""
    nodes, of_node = np.polynomial.legendre.leggauss(40)
    points, weights = [], []
    for tau, of_tau in zip(0.5 * (nodes + 1.0) * 4.5 * PRIOR, of_node, strict=True):
        half = 16.0 * np.sqrt(SD**2 + tau**2)
        low, high = (np.clip(maxima[0].theta[:2] * np.exp(x), *LIMITS) for x in (-half, half))
        k = low + 0.5 * (nodes[:, None] + 1.0) * (high - low)
        points.append(np.stack([*np.meshgrid(*k.T, indexing="ij"), np.full((40, 40), tau)], axis=-1))
        weights.append(np.prod(high - low) * np.outer(of_node, of_node) * of_tau)
    theta, weight = np.reshape(points, (-1, 3)), np.ravel(weights)
    log_p = funnel.log_prob(theta)
    weight = weight * np.exp(log_p - log_p.max())
    return theta, weight / weight.sum()


def test_components_cover_the_funnel(funnel, maxima):
    scaled, (quadratics, share, warp) = ScaledDensity(funnel), components_along(funnel, maxima)
    mixture = Mixture([warp.quadratic(q) for q in quadratics], share, warp)
    u = mixture.draw(np.random.default_rng(1), 2000)
    log_w = scaled.log_prob(u) - mixture.log_density(u)
    assert effective_size(log_w) > 0.3 * len(u)


def test_draws_are_those_of_a_quadrature(funnel, maxima, exact):
    sampler = MixtureSampler().starting_from(*components_along(funnel, maxima))
    run = Run(funnel, sampler, warmup=100, chains=4, seed=1, init=starts_at_maxima(funnel, maxima, 4, 1, seed=1))
    draws = run.extend(600).posterior.position
    theta, weight = exact
    for of_theta in (lambda x: np.log(x[..., 0]), lambda x: np.log(x[..., 1]), lambda x: x[..., 2]):
        true, drawn = of_theta(theta), of_theta(draws)
        mean = weight @ true
        for power in (1, 2, 3):
            expected, got = weight @ (true - mean) ** power, (drawn - mean) ** power
            assert ess_bulk(got) > 300
            assert abs(got.mean() - expected) < 5.0 * got.std() / np.sqrt(ess_bulk(got))


def test_a_poor_quadratic_model_makes_way_for_the_funnel(funnel, maxima):
    poor, fair = (
        replace(maxima, maxima=tuple(replace(m, effective_draws=n) for m in maxima)) for n in (5.0, 500.0)
    )
    assert components(funnel, poor)[2] is not None
    assert components(funnel, fair)[2] is None


def test_the_ascents_along_the_funnel_are_counted(funnel, maxima):
    before = solves()
    components_along(funnel, maxima)
    taken = solves() - before
    trace = fmu.sample(funnel, "mixture", draws=20, warmup=20, chains=2, seed=1, maxima=maxima)
    assert trace.attrs["before_n_solves"] == taken > 12
