"""Populations that are correlated in time: density, moves of the sampler, the next test, wrong calls."""

import numpy as np
import pytest
from scipy.stats import binom, ks_2samp, multivariate_normal, norm

import fmu
from fmu.posterior.joint.conditional.in_time import move_in_time
from fmu.posterior.joint.joint_problem import draw_next_test
from fmu.posterior.joint.modal_test import TestsError
from fmu.posterior.joint.varies.autocorrelation import InTime, ScoresInTime, default_prior
from tests.gradients import assert_gradient

DAYS = np.array([4.0, 0.0, 1.5, 2.0, 7.0, 12.0])
"""The tests are not in the order of time."""


def spring_tests(days, k=None, sd=0.003):
    """Return tests of a spring with a mass."""
    f = np.sqrt(np.ones(len(days)) if k is None else k) / (2 * np.pi)
    return [
        fmu.Test(f"t{i}", fmu.ModalData([one], sd_hz=sd * one), covariates={"day": float(day)})
        for i, (one, day) in enumerate(zip(f, days, strict=True))
    ]


def spring_problem(tests, population, others=(), **options):
    """Return the problem of a spring k that scatters, with `others` beside it that do not."""
    names = ["k", *others]
    model = fmu.SeparableModel.from_terms(names, [(np.eye(1), name) for name in names], [np.eye(1)])
    parameters = [fmu.Parameter("k", 1.0, 0.5, 1.6, prior=fmu.Normal(0.2, mean=1.0))]
    parameters += [fmu.Parameter(name, 0.2, 0.1, 0.3) for name in others]
    return fmu.JointProblem(model, tests, parameters, varies={"k": population}, pairing="index", **options)


@pytest.fixture(scope="module")
def problem():
    """Six tests at uneven days, one of which knows the stiffness."""
    tests = spring_tests(DAYS, np.full(6, 1.2))
    tests[2] = fmu.Test("t2", tests[2].data, covariates={"day": 1.5}, known={"k": 1.0})
    return spring_problem(tests, fmu.Population("log-normal", correlation_time="inferred", by="day"), ["c"])


def correlation_matrix(days, T):
    return np.exp(-np.abs(days[:, None] - days) / T)


def test_the_density_is_that_of_a_multivariate_normal_distribution(problem):
    in_time = problem.layout.in_time
    theta = problem.sample_prior(np.random.default_rng(1), 4)
    z = np.random.default_rng(2).standard_normal((4, 6, 1))
    value = in_time.log_density(theta, z)[0].sum(axis=1)
    here = np.array([0, 1, 3, 4, 5])
    for row, of in enumerate(z[:, here, 0]):
        T = theta[row, problem.names.index("k correlation time")]
        whole = multivariate_normal(cov=correlation_matrix(DAYS[here], T)).logpdf(of)
        assert value[row] == pytest.approx(whole - norm.logpdf(of).sum(), rel=1e-10, abs=1e-10)


def test_its_gradient_and_curvature_are_those_of_differences(problem):
    theta = problem.sample_prior(np.random.default_rng(3), 3)
    theta[:, problem.names.index("k correlation time")] = 0.7, 3.0, 30.0
    step = 1e-5 * np.maximum(np.abs(theta), 0.1)
    assert_gradient(problem.log_prob_and_grad(theta)[1], problem.log_prob, theta, step, 4, of_largest=1e-6)
    scores = [k for k, role in enumerate(problem.roles) if role.kind == "score"]
    plain = problem.with_layout(problem.layout.remove_centring())  # where it is exact
    curvature = plain.prior.quadratic(theta, np.ones(problem.ndim))[1][:, scores][:, :, scores]
    h = 1e-4 * np.eye(problem.ndim)[scores]
    slopes = [
        (plain.prior.log_pdf_gradient(theta - one) - plain.prior.log_pdf_gradient(theta + one))[:, scores] / 2e-4
        for one in h
    ]
    np.testing.assert_allclose(curvature, np.stack(slopes, axis=1), rtol=1e-7, atol=1e-7)


def test_draws_from_the_prior_are_correlated_and_their_innovations_are_not(problem):
    layout = problem.layout
    theta = np.repeat(problem.start[None], 20_000, axis=0)
    T = theta[0, problem.names.index("k correlation time")]
    e = np.random.default_rng(4).standard_normal((len(theta), 6, 1))
    z = layout.in_time.correlate(theta, e)
    np.testing.assert_allclose(layout.in_time.innovations(theta, z), e, atol=1e-12)
    here = np.array([0, 1, 3, 4, 5])
    found = np.corrcoef(z[:, here, 0].T)
    np.testing.assert_allclose(found, correlation_matrix(DAYS[here], T), atol=5.0 / np.sqrt(len(theta)))


@pytest.mark.parametrize("day", [13.0, 3.0, -2.0])
def test_a_further_test_depends_on_its_neighbours_in_time(problem, day):
    """After the last test, between two and before the first; as normal distributions have it."""
    here = np.array([0, 1, 3, 4, 5])
    theta = np.repeat(problem.start[None], 20_000, axis=0)
    T = theta[0, problem.names.index("k correlation time")]
    z = np.zeros((1, 6, 1))
    z[0, here, 0] = 1.0, -0.5, 0.3, 2.0, -1.0
    e = np.random.default_rng(5).standard_normal((len(theta), 1))
    found = problem.layout.in_time.next_scores(theta, np.repeat(z, len(theta), axis=0), e, {"day": day})[:, 0]
    C = correlation_matrix(np.append(DAYS[here], day), T)
    gain = np.linalg.solve(C[:5, :5], C[:5, 5])
    sd = np.sqrt(1.0 - gain @ C[:5, 5])
    assert found.mean() == pytest.approx(gain @ z[0, here, 0], abs=5.0 * sd / np.sqrt(len(theta)))
    assert found.std() == pytest.approx(sd, rel=5.0 / np.sqrt(2 * len(theta)))


def test_the_next_test_in_the_order_is_near_the_last_if_values_change_slowly():
    tests = spring_tests(np.arange(4.0), np.array([1.0, 1.02, 1.05, 1.2]), sd=1e-4)
    values = []
    for T in (1e4, 0.01):
        problem = spring_problem(tests, fmu.Population(correlation_time=T))
        theta = np.repeat(problem.start[None], 400, axis=0)
        theta[:, problem.names.index("k score [t3]")] = 2.0
        theta = problem.layout.restore_scores(theta)
        values.append(draw_next_test(problem, np.random.default_rng(1), theta, 0, {}).values[:, 0])
        last = problem.values(theta)[0, 3, 0]
    assert values[0].std() < 0.1 * values[1].std()
    assert values[0].mean() == pytest.approx(last, abs=0.02)


def test_the_moves_given_the_values_and_given_the_scores_keep_the_prior():
    """Draws of the prior, with bounds that cut the population, stay draws of the prior."""
    population = fmu.Population(sd=fmu.HalfNormal(0.2), correlation_time=fmu.LogNormal(2.0, 0.8), by="day")
    problem = spring_problem(spring_tests(DAYS), population)
    plain = problem.with_layout(problem.layout.remove_centring())
    rng = np.random.default_rng(6)
    first, theta = plain.sample_prior(rng, 4000), plain.sample_prior(rng, 4000)
    begun = theta.copy()
    for _ in range(5):
        theta = move_in_time(rng, theta, plain.layout, plain.parameters)
        theta = plain.layout.in_time.draw_times(
            rng, theta, plain.layout.population_scores(theta), plain.parameters
        )
    assert np.mean(np.any(theta != begun, axis=1)) > 0.9
    assert min(ks_2samp(theta[:, k], first[:, k]).pvalue for k in range(problem.ndim)) > 1e-4


def test_the_moves_given_the_values_alone_keep_the_prior():
    """What changes in a draw of the prior has no mean, of the population and of the logarithm of its time."""
    population = fmu.Population(sd=fmu.HalfNormal(0.2), correlation_time=fmu.LogNormal(2.0, 0.8), by="day")
    problem = spring_problem(spring_tests(DAYS), population)
    plain = problem.with_layout(problem.layout.remove_centring())
    rng, n = np.random.default_rng(6), 8000
    before = plain.sample_prior(rng, n)
    after = move_in_time(rng, before, plain.layout, plain.parameters)
    for name, of in (("k mean", np.array), ("k sd", np.array), ("k correlation time", np.log)):
        k = plain.names.index(name)
        change = of(after[:, k]) - of(before[:, k])
        assert np.mean(change != 0.0) > 0.3, name
        assert abs(change.mean()) < 4.5 * change.std() / np.sqrt(n), name


def test_parts_hold_no_two_tests_that_depend_on_each_other_directly():
    every, without = np.arange(7), np.array([0, 1, 2, 4, 5, 6])
    in_time = ScoresInTime(
        tuple(InTime(2.0, None, "", order, order.astype(float)) for order in (every, without)), 7
    )
    assert np.sum(in_time.parts, axis=0).tolist() == [1] * 7
    for one in in_time.every:
        for part in in_time.parts:
            assert not np.any(part[one.order][1:] & part[one.order][:-1])


def test_the_default_prior_covers_the_times_that_the_tests_can_tell():
    prior = default_prior(np.array([0.0, 1.0, 3.0, 4.0, 30.0]))
    found = norm.cdf(np.log(np.array([0.5, 30.0]) / prior.median) / prior.sigma)
    assert found == pytest.approx([0.05, 0.95], abs=1e-9)


def test_a_run_finds_the_correlation_time_and_its_population_passes():
    """The population of independent values is contradicted."""
    rng = np.random.default_rng(1)
    days = np.cumsum(rng.uniform(0.5, 1.5, 40))
    k = 1.0 + 0.02 * np.linalg.cholesky(correlation_matrix(days, 5.0)) @ rng.standard_normal(40)
    told = []
    for population in (fmu.Population(correlation_time="inferred", by="day"), fmu.Population()):
        problem = spring_problem(spring_tests(days, k), population, reduction=False)
        trace = fmu.sample(problem, "gibbs", draws=15, warmup=20, chains=8, seed=1)
        told.append([one for one in fmu.diagnose(trace).fit.against if "population of k" in one])
        if population.by:
            assert np.quantile(trace["posterior"]["k correlation time"], 0.05) > 1.0
    assert [bool(one) for one in told] == [False, True]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"day": 0.0}, "tests.3.covariates.day: must differ from that of 't1'"),
        ({"day": None}, "tests.3.covariates: must have day as a number, as values of k are correlated in time"),
        ({}, "tests.3.covariates: must have day as a number, as values of k are correlated in time"),
    ],
)
def test_times_that_are_wrong_are_named(change, said):
    tests = spring_tests(DAYS)
    tests[3] = fmu.Test("t3", tests[3].data, covariates=change)
    with pytest.raises(TestsError, match=said):
        spring_problem(tests, fmu.Population(correlation_time=2.0, by="day"))


@pytest.mark.parametrize("covariates", [{}, {"day": None}, {"day": fmu.Normal(0.5, mean=1.5)}])
def test_only_a_test_in_which_the_parameter_is_unknown_needs_a_time(problem, covariates):
    tests = list(problem.tests)
    tests[2] = fmu.Test("t2", tests[2].data, covariates=covariates, known={"k": 1.0})
    found = spring_problem(tests, fmu.Population("log-normal", correlation_time="inferred", by="day"), ["c"])
    (one,), (with_all,) = found.layout.in_time.every, problem.layout.in_time.every
    assert one.order.tolist() == with_all.order.tolist()
    assert one.times.tolist() == with_all.times.tolist()
    assert np.isfinite(found.log_prob(found.start))


def test_a_single_test_and_what_cannot_be_combined_are_refused():
    population = fmu.Population(correlation_time="inferred")
    with pytest.raises(TestsError, match=r"varies.k: varies by test, and needs two tests or more \(got 1\)"):
        spring_problem(spring_tests(DAYS[:1]), population)
    rule = "outliers: must not be given with populations that are correlated in time"
    with pytest.raises(TestsError, match=rf"{rule} \(got k\)"):
        spring_problem(spring_tests(DAYS), population, outliers=fmu.Outliers())
    with pytest.raises(ValueError, match="by: must be given with a correlation_time"):
        fmu.Population(by="day")
    with pytest.raises(ValueError, match="correlation_time"):
        fmu.Population(correlation_time=0.0)


def test_a_new_test_needs_its_time(problem):
    trace = fmu.sample(problem, "gibbs", draws=10, warmup=5, seed=1)
    data = spring_tests([13.0])[0].data
    with pytest.raises(TestsError, match="covariates: must have day as a number, which is the time of a test"):
        fmu.predict_tests(trace, problem, [fmu.Test("new", data)], like="t0")
    table = fmu.predict_tests(trace, problem, [fmu.Test("new", data, covariates={"day": 13.0})], like="t0")
    assert 0.0 < table["p_value"].iloc[0] <= 1.0


@pytest.mark.validate
def test_intervals_hold_truths_drawn_from_the_prior():
    """Forty sets of twenty tests; 90 % intervals of mean, scatter, correlation time and the next test."""
    rng, days = np.random.default_rng(20_285), np.cumsum(np.random.default_rng(0).uniform(0.5, 1.5, 20))
    inside = []
    for seed in range(40):
        T, s = np.exp(rng.normal(np.log(3.0), 0.8)), abs(rng.normal(0.0, 0.05))
        mean, later = rng.normal(1.0, 0.05), np.append(days, days[-1] + 1.0)
        z = np.linalg.cholesky(correlation_matrix(later, T)) @ rng.standard_normal(21)
        k = mean * np.exp(s * z)
        tests = spring_tests(days, k[:20] * (1.0 + 0.006 * rng.standard_normal(20)))
        model = fmu.SeparableModel.from_terms(["k"], [(np.eye(1), "k")], [np.eye(1)])
        parameter = fmu.Parameter("k", 1.0, 0.3, 3.0, prior=fmu.Normal(0.05, mean=1.0))
        population = fmu.Population(
            "log-normal", fmu.HalfNormal(0.05), None, False, fmu.LogNormal(3.0, 0.8), "day"
        )
        options = {"varies": {"k": population}, "pairing": "index", "reduction": False}
        problem = fmu.JointProblem(model, tests, [parameter], **options)
        trace = fmu.sample(problem, "gibbs", draws=400, warmup=150, seed=seed, progress=False)
        posterior = trace["posterior"]
        theta = np.stack([posterior[name].to_numpy().ravel() for name in problem.names], axis=1)
        following = draw_next_test(problem, rng, theta, 0, {"day": float(later[-1])}).values[:, 0]
        drawn = {"k median": mean, "k log sd": s, "k correlation time": T}
        pairs = [(posterior[name].to_numpy(), truth) for name, truth in drawn.items()] + [(following, k[-1])]
        inside.append([np.quantile(x, 0.05) <= truth <= np.quantile(x, 0.95) for x, truth in pairs])
    counts = np.sum(inside, axis=0)
    print(counts.tolist())
    assert np.all((counts >= binom.ppf(1e-3, 40, 0.9)) & (counts <= binom.ppf(1.0 - 1e-3, 40, 0.9)))


def test_data_are_not_said_to_leave_the_correlation_time_unknown():
    tests = spring_tests(DAYS, np.linspace(0.9, 1.1, 6))
    population = fmu.Population(correlation_time="inferred", by="day")
    assert fmu.identifiability(spring_problem(tests, population)).names == ("k mean",)


@pytest.mark.parametrize("T", [np.int64(5), np.float32(5.0), 5])
def test_a_correlation_time_of_any_number_type_is_known(T):
    problem = spring_problem(spring_tests(DAYS), fmu.Population(correlation_time=T, by="day"))
    assert not [name for name in problem.names if "correlation time" in name]
