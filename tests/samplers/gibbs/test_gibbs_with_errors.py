"""Gibbs sampling of populations with a model that has errors of its own: the posterior is the right one."""

import numpy as np
import pytest

import fmu
from fmu.analysis.convergence.rank_statistics import chain_ess
from tests.shear_building import frequencies_hz, shear_building

KINDS = {
    "scatter": fmu.Discrepancy(),
    "correlated scatter": fmu.Discrepancy(by="group", correlation="inferred"),
    "errors of modes": fmu.Discrepancy("modes", correlation="inferred"),
}


def contradicted(kind):
    """Return the problem of three tests of two storeys, whose second mode is 10 % higher than the model has it."""
    rng, model = np.random.default_rng(7), shear_building(["k1", "k2"], 2e8, 1e5)
    k = np.stack([1.0 + 0.1 * rng.standard_normal(3), np.full(3, 1.1)], axis=1)
    f = np.stack([frequencies_hz(model, one)[0] for one in k]) * (1.0 + 0.03 * rng.standard_normal((3, 2)))
    return fmu.JointProblem(
        model,
        [fmu.Test(f"t{t}", fmu.ModalData(one * [1.0, 1.1])) for t, one in enumerate(f)],
        [fmu.Parameter(name, 1.0, 0.5, 1.6, prior=fmu.Normal(0.1, mean=1.0)) for name in ("k1", "k2")],
        varies={"k1": fmu.Population(sd=fmu.HalfNormal(0.1))},
        error=fmu.FrequencyErrors("relative", sd=0.03),
        discrepancy=KINDS[kind],
    )


@pytest.mark.parametrize(
    "kind", [k if k == "scatter" else pytest.param(k, marks=pytest.mark.validate) for k in KINDS]
)
def test_the_posterior_is_that_of_weighted_draws_from_the_prior(kind):
    problem = contradicted(kind)
    trace = fmu.sample(problem, fmu.GibbsSampler(step_size=0.4), draws=60, warmup=20, chains=20, seed=1)
    prior = problem.sample_prior(np.random.default_rng(3), 40_000)
    w = np.exp(problem.log_likelihood(prior))
    w /= w.sum()
    assert 1.0 / np.sum(w**2) > 2000
    for k, name in enumerate(problem.names):
        drawn = np.asarray(trace["posterior"][name])
        assert chain_ess(drawn) > 200, name
        centre = np.median(drawn)
        for f in (lambda x: x, lambda x, c=centre: np.log(np.abs(x - c) + 1e-9), np.square):
            expected = w @ f(prior[:, k])
            error = np.sqrt(w**2 @ (f(prior[:, k]) - expected) ** 2)
            error = np.hypot(error, np.std(f(drawn)) / np.sqrt(chain_ess(f(drawn))))
            assert abs(np.mean(f(drawn)) - expected) < 4.5 * error, name
