"""Modes left out of a population, with the scores of their tests integrated out, against weighted prior draws."""

import numpy as np
import pytest

import fmu
from fmu.analysis.convergence.pareto import GOOD_K
from fmu.analysis.held_out.prediction import Draws
from fmu.analysis.held_out.refit import log_prob_of_all
from fmu.analysis.held_out.without_scores import leave_out_by_tests
from fmu.posterior.joint.varies.base import sum_by_test
from fmu.samplers.mixture.importance import effective_size
from tests.shear_building import frequencies_hz, shear_building

DISCREPANCIES = {"model without errors": (), "scatter": fmu.Discrepancy(prior_sd=0.05)}


def posed(discrepancy=(), last=2):
    """Return three tests of two storeys, the stiffness of one of which scatters; the third has `last` modes."""
    model, tests = shear_building(["k1", "k2"], 2e4, 10.0), []
    for t, k in enumerate([(1.05, 1.0), (0.88, 1.04), (1.1, 0.98)]):
        f = frequencies_hz(model, k)[0]
        tests.append(fmu.Test(f"t{t}", fmu.ModalData(f[: last if t == 2 else 2])))
    return fmu.JointProblem(
        model, tests,
        [fmu.Parameter(name, 1.0, 0.4, 1.8, fmu.Normal(0.1, mean=1.0)) for name in ("k1", "k2")],
        varies={"k1": fmu.Population(sd=fmu.HalfNormal(0.1))},
        error=fmu.FrequencyErrors("relative", sd=0.05), pairing="index", discrepancy=discrepancy,
    )  # fmt: skip


def test_mean_weights_are_ratios_of_evidences():
    """The evidences of each test, with and without a mode, are quadratures over its score."""
    problem, rng = posed(last=1), np.random.default_rng(1)
    standard = problem.with_layout(problem.layout.remove_centring())
    test, grid = problem.likelihood.test_of_terms, np.linspace(-6.0, 6.0, 601)
    theta, ratios = np.empty((2, 1000, problem.ndim)), np.empty((2, len(test)))
    for one, of_mode, sd in zip(theta, ratios, (0.02, 0.2), strict=True):
        one[:, :3] = 1.02, sd, 0.99
        rows = np.concatenate([np.tile(one[:1, :3], (len(grid), 1)), np.tile(grid[:, None], (1, 3))], axis=1)
        terms, prior = standard.terms_of_tests(rows), np.exp(-0.5 * grid**2)
        density = np.exp(sum_by_test(terms, test, 3)) * prior[:, None]
        for t, p in enumerate((density / density.sum(axis=0)).T):
            one[:, 3 + t] = rng.choice(grid, len(one), p=p)
        for k, t in enumerate(test):
            of_mode[k] = np.sum(density[:, t] * np.exp(-terms[:, k])) / density[:, t].sum()
    draws = problem.layout.restore_scores(np.swapaxes(theta, 0, 1).reshape(2000, -1))
    found = leave_out_by_tests(problem, draws.reshape(4, 500, -1), 1, rng, np.inf)
    assert sorted(found) == list(range(len(test)))
    for k, (_, weights) in found.items():
        w = np.exp(weights.log_weight).reshape(1000, 2)
        error = np.linalg.norm(w.std(axis=0) / w.mean(axis=0)) / np.sqrt(1000)
        expected = np.log(ratios[0, k] / ratios[1, k])
        assert abs(np.log(w[:, 0].mean() / w[:, 1].mean()) - expected) < 4.0 * error


@pytest.mark.parametrize("discrepancy", DISCREPANCIES.values(), ids=DISCREPANCIES)
def test_against_weighted_prior_draws(discrepancy):
    problem, rng = posed(discrepancy), np.random.default_rng(1)
    prior = problem.sample_prior(rng, 15_000)
    labels = problem.data.labels
    without = [problem.using([x for x in labels if x != label]) for label in labels]
    solved = log_prob_of_all([*without, problem], prior)
    log_l = solved[:, : len(labels) + 1] - problem.log_prior(prior)[:, None]
    posterior = np.exp(log_l[:, -1] - log_l[:, -1].max())
    theta = prior[rng.choice(len(prior), 4000, p=posterior / posterior.sum())].reshape(4, 1000, -1)
    found = leave_out_by_tests(problem, theta, 1, rng, np.inf)
    of_prior = Draws(problem, prior, solved[:, len(labels) + 1 :])
    assert sorted(found) == list(range(len(labels)))
    for k, (draws, weights) in found.items():
        log_w = log_l[:, k] - np.logaddexp.reduce(log_l[:, k])
        w, n = np.exp(log_w), effective_size(log_w)
        assert weights.pareto_k < GOOD_K
        assert n > 500
        elpd = np.log(w @ np.exp(log_l[:, -1] - log_l[:, k]))
        of_elpd = np.sqrt(np.sum((w * (np.exp(log_l[:, -1] - log_l[:, k] - elpd) - 1.0)) ** 2))
        assert abs(weights.elpd - elpd) < 4.0 * np.hypot(of_elpd, weights.mcse)
        expected, got = of_prior.predict(k, log_w), draws.predict(k, weights.log_weight)
        error = expected.sd * np.sqrt(1.0 / n + 1.0 / effective_size(weights.log_weight))
        assert abs(got.mean - expected.mean) < 4.0 * error
        assert abs(got.sd - expected.sd) < 4.0 * error
