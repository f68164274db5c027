"""Data that do not outnumber the parameters leave the scatter of a model to its prior, and the page says so."""

import numpy as np
import pytest
from scipy.stats import halfnorm

import fmu
from fmu.analysis.fit.allowed_scatter import LEFT_TO_PRIOR, scatter_sentences
from fmu.analysis.information import DATA, PRIOR, information
from fmu.analysis.trace.conversion import to_trace
from tests.shear_building import frequencies_hz, shear_building

PRIOR_SD = 0.1
OFF = np.array([1.1, 0.9, 1.12])
"""Measured frequencies relative to those of the model, which no stiffness fits."""


def posed(n_data):
    """A building of three storeys with one stiffness, whose prior is flat, and 1 % of noise."""
    model = shear_building(["k"] * 3)
    measured = (frequencies_hz(model, np.ones(1))[0] * OFF)[:n_data]
    data = fmu.ModalData(measured, sd_hz=0.01 * measured)
    parameters = [fmu.Parameter("k", 1.0, 0.2, 3.0)]
    return fmu.UpdatingProblem(
        model, data, parameters, pairing="index", discrepancy=fmu.Discrepancy(prior_sd=PRIOR_SD)
    )


def by_quadrature(problem, rng):
    """The largest distance of the distribution of τ from its prior, and draws of the posterior."""
    k, tau = (low + (high - low) * (np.arange(n) + 0.5) / n for low, high, n in ((0.2, 3.0, 700), (0.0, 0.5, 60)))
    grid = np.stack([x.ravel() for x in np.meshgrid(k, tau, indexing="ij")], axis=1)
    p = np.exp(problem.log_prob(grid) - problem.log_prob(grid).max())
    of_tau = p.reshape(700, 60).sum(axis=0)
    away = np.abs(np.cumsum(of_tau) / of_tau.sum() - halfnorm.cdf(tau + 0.5 * (tau[1] - tau[0]), scale=PRIOR_SD))
    theta = grid[rng.choice(len(grid), 1600, p=p / p.sum())]
    return away.max(), theta + rng.uniform(-0.5, 0.5, theta.shape) * [k[1] - k[0], tau[1] - tau[0]]


@pytest.mark.parametrize(("n_data", "by"), [(1, PRIOR), (3, DATA)])
def test_the_scatter_keeps_its_prior_where_no_degrees_of_freedom_are_left(n_data, by, make_result):
    problem = posed(n_data)
    away, draws = by_quadrature(problem, np.random.default_rng(4))
    trace = to_trace(make_result(draws.reshape(4, -1, 2)), problem)
    (sentence,) = scatter_sentences(trace)
    assert information(trace).basis == (DATA, by)
    if by == PRIOR:
        assert away < 0.02
        assert sentence.endswith(LEFT_TO_PRIOR)
        assert any(said.startswith("tau was not updated by the data") for said in information(trace).warnings())
    else:
        assert away > 0.3
        assert LEFT_TO_PRIOR not in sentence
