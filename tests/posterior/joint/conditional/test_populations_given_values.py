"""Candidates for populations given the values in the tests: they leave the prior, and the values, as they are."""

import numpy as np
import pytest
import scipy.stats
from numpy.testing import assert_allclose

import fmu
from fmu.posterior.joint.conditional.given_values import PopulationsGivenValues, inverse_wishart_factors
from fmu.posterior.joint.correlation import partial_correlations
from fmu.samplers.local import accept
from tests.shear_building import frequencies_hz, shear_building

pytestmark = pytest.mark.usefixtures("all_half_centred")


def without_data(n_tests, distribution, correlation=None, known=()):
    """Return the populations of two stiffnesses in several tests, and the layout with standard normal scores."""
    model = shear_building(["k1", "k2"], 2e8, 1e5)
    f = frequencies_hz(model, [1.0, 1.0])[0]
    problem = fmu.JointProblem(
        model,
        [
            fmu.Test(f"t{t}", fmu.ModalData(f), known={"k2": 1.0} if t in known else {}, group="ab"[t % 2])
            for t in range(n_tests)
        ],
        [fmu.Parameter(name, 1.0, 0.1, 9.0, prior=fmu.Normal(0.1, mean=1.0)) for name in ("k1", "k2")],
        varies=dict.fromkeys(("k1", "k2"), fmu.Population(distribution, sd=fmu.LogNormal(0.03, 0.4))),
        correlation=correlation,
        error=fmu.FrequencyErrors("relative", sd=0.05),
    )
    plain = problem.with_layout(problem.layout.remove_centring())
    return plain, PopulationsGivenValues(plain.layout, plain.parameters)


@pytest.mark.parametrize(
    ("n_tests", "distribution", "correlation", "known"),
    [(4, "normal", None, ()), (5, "log-normal", None, (1,)), (9, "log-normal", 1.5, ())],
)
def test_the_prior_is_left_as_it_is(n_tests, distribution, correlation, known):
    """Draws from the prior are draws from it after a step, with the values that they had."""
    plain, populations = without_data(n_tests, distribution, correlation, known)
    rng, n = np.random.default_rng(4), 8000
    before = plain.sample_prior(rng, n)
    found = populations.propose(rng, before)
    accepted = accept(rng, found.log_ratio)
    after = populations.move(before, found, accepted)
    assert 0.2 < np.mean(accepted) < 0.99
    scored = np.array([[name not in test.known for name in ("k1", "k2")] for test in plain.tests])
    assert_allclose(plain.values(after)[:, scored], plain.values(before)[:, scored], rtol=1e-11)
    main = [k for k, role in enumerate(plain.roles) if role.kind != "score"]
    moved = np.repeat(accepted, 2 if correlation is None else len(main), axis=1)
    assert np.all(
        (after[:, main] != before[:, main]) == (moved if correlation else np.repeat(accepted, 2, axis=1))
    )
    fresh = plain.sample_prior(rng, n)
    for k in range(plain.ndim):
        assert scipy.stats.ks_2samp(after[:, k], fresh[:, k]).pvalue > 1e-4, plain.names[k]
    # where candidates were accepted, the change of each parameter must be neither up nor down
    for k in main:
        change = (after - before)[:, k]
        assert abs(np.mean(change)) < 4.5 * np.std(change) / np.sqrt(n), plain.names[k]


def test_populations_with_bounds_nearby_or_few_tests_stay_where_they_are():
    plain, populations = without_data(4, "normal")
    rng = np.random.default_rng(4)
    theta = plain.sample_prior(rng, 200)
    width = plain.names.index("k1 sd")
    theta[:, width] = 0.3
    log_ratio = populations.propose(rng, theta).log_ratio
    assert np.all(log_ratio[:, 0] == -np.inf)
    assert np.all(np.isfinite(log_ratio[:, 1]).sum() > 150)
    assert without_data(2, "normal")[1].n_blocks == 0
    assert without_data(7, "normal", 1.0)[1].n_blocks == 0


def test_inverse_wishart_draws_have_their_mean_and_their_correlations():
    rng, p, nu = np.random.default_rng(3), 3, np.array([12.0])
    scatter = np.array([[2.0, 0.5, 0.1], [0.5, 1.0, -0.3], [0.1, -0.3, 0.7]])
    factor = inverse_wishart_factors(rng, np.broadcast_to(scatter, (20_000, 1, p, p)), nu)[:, 0]
    draws = factor @ np.swapaxes(factor, 1, 2)
    reference = scipy.stats.invwishart(12, scatter).rvs(20_000, random_state=1)
    for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2)):
        assert scipy.stats.ks_2samp(draws[:, i, j], reference[:, i, j]).pvalue > 1e-3
    R = draws[0] / np.sqrt(np.outer(np.diag(draws[0]), np.diag(draws[0])))
    inverse = np.linalg.inv(R[np.ix_([0, 1, 2], [0, 1, 2])])
    rho = partial_correlations(factor)[0]
    assert_allclose(rho, [R[0, 1], R[0, 2], -inverse[1, 2] / np.sqrt(inverse[1, 1] * inverse[2, 2])], rtol=1e-10)
