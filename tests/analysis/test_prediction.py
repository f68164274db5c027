import numpy as np
import pytest

import fmu
from fmu.analysis.convergence import effective
from fmu.analysis.held_out.modes import leave_one_out
from fmu.analysis.prediction import as_replicates, expectation, predict_frequencies
from fmu.analysis.trace.conversion import to_trace
from tests.shear_building import frequencies_hz, shear_building

# The model of conftest.py: f = 100 + SLOPES @ theta.
SLOPES = np.array([[2.0, 1.0], [0.5, -1.0], [1.0, 3.0]])


@pytest.fixture
def trace(make_result, problem):
    return to_trace(make_result(np.random.default_rng(41).standard_normal((4, 500, 2))), problem)


def draws_of(trace):
    return np.stack([trace["posterior"][name].to_numpy() for name in ("E1", "rho")], axis=-1)


def test_expectation_is_the_mean_over_the_draws(trace):
    x = draws_of(trace)
    found = expectation(trace, lambda theta: theta[:, 0] ** 2 + theta[:, 1])
    g = x[..., 0] ** 2 + x[..., 1]
    assert found.value == pytest.approx(g.mean(), rel=1e-13)
    assert found.mcse == pytest.approx(effective.mcse_mean(g), rel=1e-12)
    assert isinstance(found.value, float)


def test_expectation_of_several_functions_at_once(trace):
    found = expectation(trace, lambda theta: np.stack([theta[:, 1], theta.prod(axis=1)], axis=1))
    assert found.value.shape == found.mcse.shape == (2,)
    by_name = expectation(trace, "rho")
    assert (found.value[0], found.mcse[0]) == (pytest.approx(by_name.value), pytest.approx(by_name.mcse))


def test_expectation_of_the_frequencies(trace):
    found = expectation(trace, "model_frequency")
    mean = draws_of(trace).mean(axis=(0, 1))
    np.testing.assert_allclose(found.value, 100 + SLOPES @ mean, rtol=1e-13)


@pytest.mark.parametrize("walkers", [1, 10])
def test_standard_error_is_the_scatter_over_replicates(make_trace, ar1, walkers):
    """The first of 120 replicates is a parameter of the trace, the others take its place in the function."""
    x = ar1(np.random.default_rng(42), (4, 400, walkers, 120), 0.6).reshape(4, -1, 120)
    trace = make_trace(x[..., :2], walkers=walkers)
    values, errors = expectation(trace, lambda theta: np.exp(0.5 * x.reshape(-1, 120)))
    first = expectation(trace, lambda theta: np.exp(0.5 * theta[:, 0]))
    assert (first.value, first.mcse) == pytest.approx((values[0], errors[0]), rel=1e-12)
    assert np.mean(errors) == pytest.approx(np.std(values), rel=5 / np.sqrt(2 * 120))
    assert np.mean(values) == pytest.approx(np.exp(0.125), abs=5 * np.mean(errors) / np.sqrt(120))


def test_standard_error_of_what_no_draw_tells_is_nan(trace):
    found = expectation(trace, lambda theta: (theta[:, 0] > 100).astype(float))
    assert found.value == 0.0
    assert np.isnan(found.mcse)


def test_unknown_variable(trace, make_trace):
    with pytest.raises(
        ValueError, match=r"G: must be a callable or one of E1, rho, frequency, model_frequency \(got 'E9'\)"
    ):
        expectation(trace, "E9")
    with pytest.raises(ValueError, match=r"one of x0, x1 \(got 'frequency'\)"):
        expectation(make_trace(np.zeros((2, 5, 2))), "frequency")


@pytest.mark.parametrize(
    "G", [lambda theta: 1.0, lambda theta: theta[:-1, 0], lambda theta: np.zeros((len(theta), 2, 2))]
)
def test_wrong_shape(trace, G):
    with pytest.raises(ValueError, match=r"G: must map \(2000, 2\) to \(2000,\) or \(2000, k\) \(got shape"):
        expectation(trace, G)


def test_value_that_is_not_finite(trace):
    with pytest.raises(ValueError, match=r"G: must be finite at every draw \(got nan at \["):
        expectation(trace, lambda theta: np.where(theta[:, 0] > 1, np.nan, 0.0))


def test_predictive_distribution_of_a_linear_model(trace):
    table = predict_frequencies(trace, ci_prob=0.9)
    assert list(table.columns) == [
        "measured",
        "mean",
        "mcse_mean",
        "sd",
        "eti90_lb",
        "eti90_ub",
        "noisy_sd",
        "noisy_eti90_lb",
        "noisy_eti90_ub",
    ]
    assert list(table.index) == ["W1", "W2", "T1"]
    np.testing.assert_array_equal(table["measured"], [101.0, 99.5, 102.0])
    sd = np.sqrt(np.sum(SLOPES**2, axis=1))  # theta is standard normal here
    noisy_sd = np.sqrt(sd**2 + 0.5 / np.array([0.5, 1.0, 2.0]))  # σ² = 1/(2β)
    assert np.all(np.abs(table["mean"] - 100) < 5 * table["mcse_mean"])
    np.testing.assert_allclose(table["mcse_mean"], sd / np.sqrt(2000), rtol=0.2)
    np.testing.assert_allclose(table["sd"], sd, rtol=5 / np.sqrt(4000))
    np.testing.assert_allclose(table["noisy_sd"], noisy_sd, rtol=5 / np.sqrt(4000))
    # Standard error of the 5 % quantile of 2000 draws: sqrt(0.05 0.95 / 2000) / 0.1031 = 0.047 sd.
    for prefix, width in (("", sd), ("noisy_", noisy_sd)):
        np.testing.assert_allclose(table[f"{prefix}eti90_lb"], 100 - 1.645 * width, atol=5 * 0.047 * width.max())
        np.testing.assert_allclose(table[f"{prefix}eti90_ub"], 100 + 1.645 * width, atol=5 * 0.047 * width.max())


def test_trace_without_frequencies(make_trace):
    with pytest.raises(ValueError, match="model_frequency"):
        predict_frequencies(make_trace(np.zeros((2, 5, 2))))


def exact_posterior(kept):
    """Mean and covariance given the modes `kept` of the linear problem, its bounds too far away to matter."""
    A, precision, error = SLOPES[kept], 2 * np.array([0.5, 1.0, 2.0])[kept], np.array([1.0, -0.5, 2.0])[kept]
    covariance = np.linalg.inv(np.diag([1.0, 0.25]) + A.T @ (precision[:, None] * A))
    return covariance @ A.T @ (precision * error), covariance


def test_leaving_one_mode_out_of_a_linear_model(make_result, problem):
    mean, covariance = exact_posterior([0, 1, 2])
    draws = np.random.default_rng(44).multivariate_normal(mean, covariance, size=(4, 5000))
    table = leave_one_out(to_trace(make_result(draws), problem))
    assert list(table.index) == ["W1", "W2", "T1"]
    for i, label in enumerate(table.index):
        mean, covariance = exact_posterior([k for k in range(3) if k != i])
        variance = SLOPES[i] @ covariance @ SLOPES[i] + 0.5 / np.array([0.5, 1.0, 2.0])[i]
        error = np.array([1.0, -0.5, 2.0])[i] - SLOPES[i] @ mean
        exact = -0.5 * (error**2 / variance + np.log(2 * np.pi * variance))
        assert (table.loc[label, "method"] == "importance weights") == (table.loc[label, "pareto_k"] <= 0.5)
        if table.loc[label, "pareto_k"] < 0.5:
            assert table.loc[label, "elpd"] == pytest.approx(exact, abs=0.05)
    assert (table["pareto_k"] < 0.5).sum() >= 2


def test_a_mode_that_the_others_do_not_determine_is_not_reliable(make_result, problem):
    """The third frequency alone is known so well that the posterior without it is many times as wide."""
    sharp = type(problem)(problem.model, problem.data, problem.parameters, beta=[1e-3, 1e-3, 1e4])
    A, precision = SLOPES, 2 * np.array([1e-3, 1e-3, 1e4])
    covariance = np.linalg.inv(np.diag([1.0, 0.25]) + A.T @ (precision[:, None] * A))
    mean = covariance @ A.T @ (precision * [1.0, -0.5, 2.0])
    draws = np.random.default_rng(45).multivariate_normal(mean, covariance, size=(4, 500))
    row = leave_one_out(to_trace(make_result(draws), sharp)).loc["T1"]
    assert row["method"] == ""
    assert np.isnan(row["elpd"])


def test_leaving_out_needs_a_likelihood(make_trace):
    with pytest.raises(ValueError, match="log-likelihood of the modes"):
        leave_one_out(make_trace(np.zeros((2, 5, 2))))


@pytest.mark.parametrize("draws", [np.zeros((2, 50, 2)), np.random.default_rng(46).standard_normal((2, 3, 2))])
def test_draws_that_tell_nothing_of_what_was_left_out(make_result, problem, draws):
    table = leave_one_out(to_trace(make_result(draws), problem))
    assert not table["method"].any()
    assert table["elpd"].isna().all()
    assert list(table.index) == ["W1", "W2", "T1"]


def test_a_new_measurement_has_the_error_of_the_structure_that_other_tests_tell():
    """Also of a mode that only the other test used; the error z ~ N(0, 1) of a mode is Gaussian given its data."""
    model, sd, sigma = shear_building(["k", "k"], 1e3, 1.0), 0.003, 0.05
    f = frequencies_hz(model, np.ones(1))[0] * [1.03, 0.98]
    uses = {"a": (True, True), "b": (True, False)}
    tests = [fmu.Test(name, fmu.ModalData(f, sd_hz=sd * f, use=use)) for name, use in uses.items()]
    error = fmu.Discrepancy("modes", sd=sigma, correlation=0.0)
    problem = fmu.JointProblem(
        model, tests, [fmu.Parameter("k", 1.0, 0.5, 2.0)], pairing="index", discrepancy=error
    )
    trace = fmu.sample(problem, draws=400, warmup=60, chains=4, progress=False)
    table = predict_frequencies(trace)
    computed = trace["posterior_predictive"]["model_frequency"].to_numpy()
    for mode, n in enumerate((2, 1, 2, 1)):  # the number of tests that used the mode
        hz = np.tile(f, 2)[mode]
        precision = 1.0 + n * (sigma / sd) ** 2
        mean = computed[..., mode] + (1.0 - 1.0 / precision) * (hz - computed[..., mode])
        expected = np.sqrt(mean.var() + (sigma * hz) ** 2 / precision + (sd * hz) ** 2)
        row = table.iloc[mode]
        se = 5.0 / np.sqrt(2 * computed[..., 0].size)
        assert row["noisy_sd"] == pytest.approx(expected, rel=se)
        middle = 0.5 * (row["noisy_eti90_lb"] + row["noisy_eti90_ub"])
        assert middle == pytest.approx(mean.mean(), abs=5.0 * 1.5 * expected / np.sqrt(computed[..., 0].size))
        similar = np.sqrt(computed[..., mode].var() + (sigma * hz) ** 2 + (sd * hz) ** 2)
        assert row["similar_sd"] == pytest.approx(similar, rel=se)
    replicates = as_replicates(table, np.array([True, True, True, False]))
    assert list(replicates["noisy_sd"]) == [*table["similar_sd"][:3], table["noisy_sd"].iloc[3]]
    assert not [name for name in replicates if name.startswith("similar_")]
