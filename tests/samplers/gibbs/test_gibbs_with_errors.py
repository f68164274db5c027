"""Gibbs sampling of populations with a model that has errors of its own: the posterior is the right one."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import fmu
from fmu.posterior.discrepancy.given_errors import with_errors_as_parameters
from fmu.posterior.joint.conditional.both import _slopes_by_errors, conditionals, scatter_about_typical
from fmu.samplers.gibbs import errors_of_model
from fmu.samplers.kernel import State
from tests.shear_building import frequencies_hz, shear_building

KINDS = {
    "scatter": fmu.Discrepancy(),
    "correlated scatter": fmu.Discrepancy(by="group", correlation="inferred"),
    "errors of modes": fmu.Discrepancy("modes", correlation="inferred"),
}


def contradicted(kind, varies=("k1",), **options):
    """Return the problem of three tests of two storeys, whose second mode is 10 % higher than the model has it."""
    rng, model = np.random.default_rng(7), shear_building(["k1", "k2"], 2e8, 1e5)
    k = np.stack([1.0 + 0.1 * rng.standard_normal(3), np.full(3, 1.1)], axis=1)
    f = np.stack([frequencies_hz(model, one)[0] for one in k]) * (1.0 + 0.03 * rng.standard_normal((3, 2)))
    return fmu.JointProblem(
        model,
        [fmu.Test(f"t{t}", fmu.ModalData(one * [1.0, 1.1])) for t, one in enumerate(f)],
        [fmu.Parameter(name, 1.0, 0.5, 1.6, prior=fmu.Normal(0.1, mean=1.0)) for name in ("k1", "k2")],
        varies=dict.fromkeys(varies, fmu.Population(sd=fmu.HalfNormal(0.1))),
        error=fmu.FrequencyErrors("relative", sd=0.03),
        discrepancy=KINDS[kind],
        **options,
    )


@pytest.mark.parametrize(
    "kind", [k if k == "scatter" else pytest.param(k, marks=pytest.mark.validate) for k in KINDS]
)
def test_draws_of_the_posterior_remain_draws_of_the_posterior(kind, monkeypatch):
    """Draws from the prior, resampled by their likelihood, keep their distribution in a few steps.

    The sizes move only together with the main parameters, so that no other steps make good for errors of these.
    """
    monkeypatch.setattr(errors_of_model, "_NOISE_STEPS", 0)
    problem, rng, n = contradicted(kind), np.random.default_rng(3), 1500
    prior = problem.sample_prior(rng, 50_000)
    w = np.exp(problem.log_likelihood(prior))
    w /= w.sum()
    assert 1.0 / np.sum(w**2) > 2 * n
    theta = prior[np.searchsorted(np.cumsum(w), (np.arange(n) + rng.random()) / n).clip(max=len(prior) - 1)]
    kernel = fmu.GibbsSampler(step_size=0.4).bind(problem)
    given, at = kernel.problem.likelihood, problem.layout.of_model(theta)
    errors = given.draw(rng, given.observed(at), at)
    extra = {"terms": given.terms(np.concatenate([at, errors], axis=1)), "errors": errors}
    state = State(kernel.scaled.to_scaled(theta), problem.log_prob(theta), extra=extra)
    for _ in range(8):
        state, _ = kernel.step(rng, state)
    after = kernel.scaled.to_theta(state.position)
    for k, name in enumerate(problem.names):
        centre = w @ prior[:, k]
        for f in (lambda x: x, lambda x, c=centre: np.log(np.abs(x - c) + 1e-9), lambda x, c=centre: (x - c) ** 2):
            expected = w @ f(prior[:, k])
            error = np.sqrt(w**2 @ (f(prior[:, k]) - expected) ** 2)
            error = np.hypot(error, np.std(f(after[:, k])) / np.sqrt(n))
            assert abs(np.mean(f(after[:, k])) - expected) < 4.5 * error, name


@pytest.mark.parametrize("options", [{"correlation": 1.0}, {"outliers": fmu.Outliers()}])
def test_steps_with_correlated_populations_and_outliers_keep_to_the_posterior(options):
    """The log-probability that a step returns is that of its point, and the errors are those of the terms."""
    problem = contradicted("scatter", ("k1", "k2"), **options)
    kernel = fmu.GibbsSampler(step_size=0.4).bind(problem)
    rng = np.random.default_rng(2)
    start = scatter_about_typical(problem, rng, 6, 1.0)
    state = kernel.init(kernel.scaled.to_scaled(start))[0]
    for _ in range(4):
        state, info = kernel.step(rng, state)
    theta = kernel.scaled.to_theta(state.position)
    assert np.all(theta != start, axis=1).all()
    assert_allclose(state.log_prob, problem.log_prob(theta), rtol=1e-9)
    assert_allclose(info.log_prob, state.log_prob)
    both = np.concatenate([problem.layout.of_model(theta), state.extra["errors"]], axis=1)
    assert_allclose(state.extra["terms"], kernel.problem.likelihood.terms(both), rtol=1e-8)


def test_slopes_by_errors_of_the_model_are_derivatives_of_the_gradient():
    problem, h = contradicted("scatter"), 1e-3
    plain = with_errors_as_parameters(problem.with_layout(problem.layout.remove_centring()))
    theta = conditionals(problem).typical
    moves = h * np.eye(plain.ndim)[problem.ndim :]
    ahead, behind = (plain.log_prob_and_grad(theta + sign * moves)[1] for sign in (1.0, -1.0))
    expected = (ahead - behind).T / (2.0 * h) * plain.scale[:, None]
    found = _slopes_by_errors(plain, theta) * plain.scale[:, None]
    assert_allclose(found, expected, rtol=0.1, atol=0.1 * np.abs(expected).max())
