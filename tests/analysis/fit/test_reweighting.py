"""The scatter that a discrepancy would have, estimated without it, against runs and quadratures with it."""

import numpy as np
import pytest

import fmu
from fmu.analysis.fit.reweighting import TAU, by_draws, by_linearised_model, estimated_scatter
from tests.shear_building import frequencies_hz, shear_building

STOREYS = ["k1", "k2", "k3", "k4", "k5"]
TRUTH = np.array([1.0, 1.12, 0.94, 1.06, 0.91])


def problem_of(sd, discrepancy=(), prior_sd=0.5):
    """Return a model of equal storeys, updated with frequencies of a structure of stiffnesses `TRUTH`."""
    rng = np.random.default_rng(3)
    measured = frequencies_hz(shear_building(STOREYS), TRUTH)[0] * (1.0 + sd * rng.standard_normal(5))
    return fmu.UpdatingProblem.reduced(
        shear_building(["k"] * 5),
        fmu.ModalData(measured),
        [fmu.Parameter("k", 1.0, 0.2, 3.0, fmu.Normal(prior_sd, mean=1.0))],
        pairing="index",
        error=fmu.FrequencyErrors("relative", sd=sd),
        discrepancy=discrepancy,
    )


def sampled(problem, draws=60):
    return fmu.sample(problem, draws=draws, warmup=60, maxima=fmu.find_map(problem, starts=2))


def exact(sd, prior_sd=0.5):
    """Return the quantiles of τ and the ratio of the standard deviations of k, by sums over a grid."""
    with_scatter, without = problem_of(sd, fmu.Discrepancy(), prior_sd), problem_of(sd, (), prior_sd)
    k = np.linspace(0.5, 1.6, 150)
    grid = np.stack(np.meshgrid(k, TAU, indexing="ij"), axis=-1)
    log_p = with_scatter.log_prob(grid.reshape(-1, 2)).reshape(grid.shape[:2])
    p = np.exp(log_p - log_p.max())
    below = np.cumsum(p.sum(axis=0)) / p.sum()
    alone = np.exp(without.log_prob(k[:, None]) - without.log_prob(k[:, None]).max())

    def spread(weight):
        weight = weight / weight.sum()
        return np.sqrt(weight @ (k - weight @ k) ** 2)

    return [np.interp(q, below, TAU) for q in (0.05, 0.5, 0.95)], spread(p.sum(axis=1)) / spread(alone)


def test_the_linearised_model_says_what_a_run_with_scatter_would():
    quantiles, wider = exact(0.005)
    trace = sampled(problem_of(0.005))
    assert by_draws(trace) is None
    found = by_linearised_model(trace)
    np.testing.assert_allclose(found.quantiles, quantiles, rtol=0.1)
    assert found.wider == pytest.approx([wider], rel=0.15)
    said = estimated_scatter(trace)
    assert said.startswith("These draws cannot tell how large the scatter would be, as they do not cover")
    assert said.endswith("times as large")


def test_the_draws_say_it_where_they_cover_the_wider_posterior():
    """The prior is informative, or the derivatives at the maximum would not be those of the wider posterior."""
    quantiles, wider = exact(0.08, 0.04)
    trace = sampled(problem_of(0.08, (), 0.04), draws=400)
    found = by_draws(trace)
    np.testing.assert_allclose(found.quantiles, quantiles, rtol=0.1)
    assert found.wider == pytest.approx([wider], rel=0.1)
    assert estimated_scatter(trace).startswith("By these draws, reweighted, it would be ")


def test_nothing_is_said_where_the_derivatives_are_unknown():
    trace = sampled(problem_of(0.15))
    bare = trace.filter(lambda node: node.name != "identifiability")
    assert estimated_scatter(bare) == ""
