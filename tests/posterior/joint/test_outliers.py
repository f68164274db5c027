"""Tests that may be outliers: densities beside SciPy's, conditional densities, and what the sampler finds."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import betaln
from scipy.stats import kstest, multivariate_normal, norm

import fmu
from fmu.posterior.joint.conditional.both import conditionals
from tests.gradients import assert_gradient

SPRINGS = fmu.SeparableModel.from_terms(
    ["k1", "k2"], [(np.diag([1.0, 0.0]), "k1"), (np.diag([0.0, 4.0]), "k2")], [np.eye(2)]
)
PRIOR = fmu.ScaledBeta(1.0, 9.0)
SD = fmu.HalfNormal(0.05)


def posed(outliers, values=None, n=6, noise=0.002, correlation=None, distribution="normal", known=True):
    """Return a problem of two independent springs, f² = k/(4π²) and 4 k/(4π²); k2 is known in the third test."""
    if values is None:
        values = 1.0 + 0.03 * np.random.default_rng(1).standard_normal((n, 2))
    tests = []
    for t, k in enumerate(values):
        f = np.sqrt(k * [1.0, 4.0]) / (2 * np.pi)
        tests.append(fmu.Test(f"t{t}", fmu.ModalData(f, sd_hz=noise * f)))
    if known:
        tests[2] = replace(tests[2], known={"k2": 1.0})
    population = fmu.Population(distribution, SD)
    return fmu.JointProblem(
        SPRINGS,
        tests,
        [fmu.Parameter(name, 1.0, 0.2, 3.0) for name in ("k1", "k2")],
        varies={"k1": population, "k2": population},
        outliers=outliers,
        correlation=correlation,
        pairing="index",
        reduction=False,
    )


CASES = {
    "given share": (fmu.Outliers(0.1, 4.0), None),
    "inferred share": (fmu.Outliers(PRIOR), None),
    "correlated": (fmu.Outliers(0.2), 1.0),
    "correlated, inferred share": (fmu.Outliers(PRIOR, 3.0), 2.0),
}


def points(problem, spread=3.0):
    """Return the problem without centring, and five draws from its prior with scores that are farther apart."""
    plain = problem.with_layout(problem.layout.remove_centring())
    theta = plain.sample_prior(np.random.default_rng(2), 5)
    for one in plain.layout.drawn:
        theta[:, one.columns[one.scored]] *= spread
    return plain, theta


@pytest.mark.parametrize("case", CASES)
def test_the_density_is_that_of_scipy(case):
    outliers, eta = CASES[case]
    plain, theta = points(posed(outliers, correlation=eta))
    layout = plain.layout
    z = np.stack([theta[:, one.columns] for one in layout.drawn], axis=2)
    R, s = layout.correlations(theta), outliers.scale
    share = theta[:, plain.names.index("share of outliers")] if outliers.parameter else np.full(5, outliers.share)
    prior = np.zeros(5)
    main = [k for k, role in enumerate(plain.roles) if role.kind != "score"]
    for k in main:
        prior += plain.parameters[k].prior.log_pdf(theta[:, k])
        prior -= plain.parameters[k].prior.log_mass(plain.lower[k], plain.upper[k])
    for i in range(5):
        for t in range(6):
            here = [0] if t == 2 else [0, 1]
            kinds = [(s, 1.0), (1.0, s), (s, s)] if t != 2 else [(s, 1.0)]

            def density(D, i=i, t=t, here=here):
                D = np.diag(D)
                return multivariate_normal.pdf(z[i, t, here], None, (D @ R[i] @ D)[np.ix_(here, here)])

            outlying = np.mean([density(D) for D in kinds])
            prior[i] += np.log((1 - share[i]) * density((1.0, 1.0)) + share[i] * outlying)
    assert_allclose(plain.log_prior(theta), prior, rtol=1e-10)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize(("noise", "distribution"), [(0.002, "normal"), (0.2, "normal"), (0.002, "log-normal")])
@pytest.mark.usefixtures("half_centred")
def test_gradient(case, noise, distribution):
    problem = posed(CASES[case][0], noise=noise, correlation=CASES[case][1], distribution=distribution)
    theta = problem.layout.restore_scores(points(problem, 1.5)[1])
    theta = 0.5 * theta + 0.5 * problem.start
    gradient = problem.log_prob_and_grad(theta)[1]
    assert_gradient(gradient, problem.log_prob, theta, 1e-5 * problem.scale, 4, rtol=1e-4, of_largest=1e-5)


@pytest.mark.parametrize("case", CASES)
def test_gradient_of_main_parameters_given_which_tests_are_outliers(case):
    problem = posed(CASES[case][0], correlation=CASES[case][1])
    found = conditionals(problem)
    theta, marginal = found.typical, found.marginal
    scales = problem.layout.outliers.draw_from_prior(np.random.default_rng(5), theta)
    scales[0, 0] = (CASES[case][0].scale, 1.0)
    w = marginal.coordinates(theta)

    def of(w):
        n = len(w)
        return marginal.log_prob_and_grad(w, np.repeat(theta, n, axis=0), np.repeat(scales, n, axis=0))

    assert_gradient(of(w)[1], lambda w: of(w)[0], w, 1e-5, rtol=1e-4, atol=1e-3)
    z = np.random.default_rng(6).standard_normal((2, 6, 2))
    both = np.concatenate([found.scores.scores.put(theta, one[None]) for one in z])
    gain = found.scores.log_prior(both, scales)
    expected = np.empty((2, 6))
    R = problem.layout.correlations(theta)[0]
    for t in range(6):
        here = [0] if t == 2 else [0, 1]
        D = np.diag(scales[0, t])
        expected[:, t] = multivariate_normal.logpdf(z[:, t, here], None, (D @ R @ D)[np.ix_(here, here)])
    assert_allclose((gain[1] - gain[0]).sum(), (expected[1] - expected[0]).sum(), rtol=1e-10)


def test_draws_from_the_prior_are_contaminated():
    problem = posed(fmu.Outliers(PRIOR, 4.0), correlation=1.0, noise=10.0)
    theta = problem.sample_prior(np.random.default_rng(1), 4000)
    z = theta[:, problem.names.index("k1 score [t0]")]
    # of three ways to be an outlier, the score of k1 is far in two; the mean share is 0.1
    assert kstest(z, lambda x: (1 - 0.2 / 3) * norm.cdf(x) + 0.2 / 3 * norm.cdf(x / 4.0)).pvalue > 1e-3
    share = theta[:, problem.names.index("share of outliers")]
    assert kstest(share, lambda x: 1 - (1 - x) ** 9).pvalue > 1e-3


def posed_springs(values, outliers, noise=0.002):
    """Return a problem of one spring with the given stiffnesses in the tests."""
    model = fmu.SeparableModel.from_terms(["k"], [(np.eye(1), "k")], [np.eye(1)])
    f = np.sqrt(values) / (2 * np.pi)
    tests = [fmu.Test(f"t{t}", fmu.ModalData([one], sd_hz=noise * one)) for t, one in enumerate(f)]
    parameter = fmu.Parameter("k", 1.0, 0.2, 3.0)
    return fmu.JointProblem(
        model, tests, [parameter], varies={"k": fmu.Population(sd=SD)}, outliers=outliers, pairing="index"
    )


def by_enumeration(values, a, b, scale, noise=0.002):
    """Return P(outlier) of each test, and the mean of the population's sd: all 2^n sets of outliers, on a grid.

    The share of outliers has a beta(a, b) prior. The flat prior of the mean is integrated out.
    """
    n, s = len(values), np.linspace(1e-4, 0.3, 600)[:, None]
    sets = np.array(list(product([False, True], repeat=n)))
    k = sets.sum(axis=1)
    prior = betaln(a + k, b + n - k)
    log_p = np.empty((len(sets), len(s)))
    for i, one in enumerate(sets):
        variance = np.where(one, scale * s, s) ** 2 + (2 * noise * values) ** 2
        total = (1 / variance).sum(axis=1)
        middle = (values / variance).sum(axis=1) / total
        square = ((values - middle[:, None]) ** 2 / variance).sum(axis=1)
        log_p[i] = prior[i] - 0.5 * (square + np.log(variance).sum(axis=1) + np.log(total))
    log_p += norm.logpdf(s[:, 0], 0.0, 0.05)
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    return p.sum(axis=1) @ sets, float(p.sum(axis=0) @ s[:, 0])


@pytest.mark.parametrize("away", [pytest.param(0.12, marks=pytest.mark.validate), 0.3])
def test_probabilities_are_those_of_all_sets_of_outliers(away):
    """A test whose value may be that of an outlier, and one that surely is; Gibbs steps, and a share inferred."""
    values = np.array([0.99, 1.01, 0.98, 1.015, 1.005, 1.0, 0.97, 1.0 + away])
    trace = fmu.sample(posed_springs(values, fmu.Outliers(PRIOR)), draws=25, warmup=25, chains=24, seed=3)
    exact, sd = by_enumeration(values, 1.0, 9.0, 5.0)
    found = trace["populations"]["outlier"].to_numpy()
    assert exact[-1] > 0.5
    assert_allclose(found, exact, atol=0.04)
    ess = float(fmu.summary(trace).loc["k sd", "ess_bulk"])
    draws = trace["posterior"]["k sd"].to_numpy()
    assert_allclose(draws.mean(), sd, atol=4.5 * draws.std() / np.sqrt(ess))


def test_what_is_no_share_and_no_scale():
    with pytest.raises(ValueError, match=r"share: must be between 0 and 1 \(got 1.0\)"):
        fmu.Outliers(1.0)
    with pytest.raises(ValueError, match=r"share: must be a number, or a beta prior on \[0, 1\]"):
        fmu.Outliers(fmu.ScaledBeta(1.0, 9.0, 0.0, 0.5))
    with pytest.raises(ValueError, match="scale"):
        fmu.Outliers(scale=1.0)
    with pytest.raises(ValueError, match=r"outliers: needs a parameter with a population.*\(got none\)"):
        fmu.JointProblem(
            SPRINGS,
            posed(None).tests,
            [fmu.Parameter(name, 1.0, 0.2, 3.0) for name in ("k1", "k2")],
            outliers=fmu.Outliers(),
        )


def test_scores_far_beyond_a_bound_stay_finite():
    """A score of an outlier whose value is the bound to rounding keeps a finite centred score."""
    problem = posed(fmu.Outliers(0.5, 20.0), noise=0.001, distribution="log-normal")
    assert np.any(problem.layout.drawn[0].centring > 0.0)
    theta = problem.sample_prior(np.random.default_rng(1), 500)
    assert np.all(np.isfinite(theta))
    assert np.all(np.isfinite(problem.log_prior(theta)))
