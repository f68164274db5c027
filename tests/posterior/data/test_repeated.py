"""Repeated tests: means, and an uncertainty that covers what it should with few tests too."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import chi2, f, kstest, norm, t

from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.data.repeated import RepeatedTests, mean_shapes, shapes_sd

TESTS = np.array([[10.0, 20.1, 30.3], [10.2, 20.0, np.nan], [10.1, 20.5, 30.0]])


def test_each_mode_has_the_scatter_of_its_own_values():
    mean, sd, covariance = RepeatedTests(TESTS, "each").mean()
    assert covariance is None
    assert_allclose(mean, [10.1, 20.2, 30.15])
    factor = t.ppf(0.975, [2, 2, 1]) / norm.ppf(0.975)
    scatter = [np.std(TESTS[:, 0], ddof=1), np.std(TESTS[:, 1], ddof=1), 0.3 / np.sqrt(2)]
    assert_allclose(sd, scatter / np.sqrt([3, 3, 2]) * factor)


@pytest.mark.parametrize(("n", "factor"), [(2, 6.5), (3, 2.2), (5, 1.4), (25, 1.05)])
def test_factors_that_the_documentation_names(n, factor):
    values = np.random.default_rng(n).normal(10.0, 0.1, (n, 1))
    sd = RepeatedTests(values).mean()[1][0]
    assert sd == pytest.approx(factor * values.std(ddof=1) / np.sqrt(n), rel=0.02)


def test_pooled_scatter_is_one_relative_scatter():
    mean, sd, _ = RepeatedTests(TESTS, "pooled").mean()
    relative = [np.nanstd(TESTS[:, i], ddof=1) / mean[i] for i in range(3)]
    c = np.sqrt((2 * relative[0] ** 2 + 2 * relative[1] ** 2 + relative[2] ** 2) / 5)
    assert_allclose(sd, c * mean / np.sqrt([3, 3, 2]) * t.ppf(0.975, 5) / norm.ppf(0.975))


@pytest.mark.parametrize(
    ("scatter", "n"),
    [
        ("each", 2),
        pytest.param("each", 3, marks=pytest.mark.validate),
        ("each", 6),
        ("pooled", 2),
        pytest.param("pooled", 3, marks=pytest.mark.validate),
        pytest.param("pooled", 6, marks=pytest.mark.validate),
    ],
)
def test_intervals_cover_the_truth(scatter, n):
    """95 % intervals over 4000 or 1000 repetitions: the standard error of the share is 0.35 or 0.7 %.

    Where nothing is pooled, the repetitions are further modes.
    """
    repetitions, modes = (1000, 2) if scatter == "pooled" else (1, 8000)
    truth, rng = np.tile([10.0, 25.0], modes // 2), np.random.default_rng(n)
    limit, inside = norm.ppf(0.975), []
    for _ in range(repetitions):
        mean, sd, _ = RepeatedTests(truth * (1.0 + 0.01 * rng.standard_normal((n, modes))), scatter).mean()
        inside.append(np.abs(mean - truth) < limit * sd)
    shares = np.mean(np.reshape(inside, (-1, 2)), axis=0)
    assert_allclose(shares, 0.95, atol=5 * np.sqrt(0.95 * 0.05 / (repetitions * modes / 2)))


def test_joint_covariance_is_that_of_the_posterior_of_the_mean():
    """Against draws from the posterior under the prior ∝ |Σ|^(−(d+1)/2): Σ inverse Wishart, the mean normal."""
    from scipy.stats import invwishart

    rng = np.random.default_rng(0)
    n, truth = 12, np.array([[1.0, 0.8], [0.8, 1.0]])
    values = rng.multivariate_normal([10.0, 20.0], truth, n)
    mean, sd, covariance = RepeatedTests(values, "joint").mean()
    assert sd is None
    centred = values - values.mean(axis=0)
    sigma = invwishart(n - 1, centred.T @ centred).rvs(20000, random_state=rng)
    draws = mean + np.einsum("nij,nj->ni", np.linalg.cholesky(sigma / n), rng.standard_normal((20000, 2)))
    assert_allclose(np.cov(draws.T), covariance, rtol=0.08)


def test_joint_covariance_of_many_tests_is_the_sample_covariance_over_n():
    values = np.random.default_rng(1).multivariate_normal([10.0, 20.0], [[1.0, 0.5], [0.5, 1.0]], 5000)
    assert_allclose(RepeatedTests(values, "joint").mean()[2], np.cov(values.T) / 5000, rtol=1e-3)


@pytest.mark.parametrize(("scatter", "nu"), [("each", [2, 2, 1]), ("pooled", [5, 5, 5])])
def test_one_more_test_scatters_as_students_t(scatter, nu):
    """With the sd of single tests, √n times that of the mean but for the factors of few tests."""
    tests = RepeatedTests(TESTS, scatter)
    sd = RepeatedTests(TESTS, scatter).mean().sd_hz
    s = sd * np.sqrt([3, 3, 2]) * norm.ppf(0.975) / t.ppf(0.975, nu)
    drawn = tests.simulate(np.random.default_rng(5), 20000)
    for share in (0.05, 0.25, 0.75, 0.9):
        below = np.mean(drawn < s * t.ppf(share, nu), axis=0)
        assert_allclose(below, share, atol=5 * np.sqrt(share * (1 - share) / 20000))


def test_one_more_test_of_modes_that_move_together():
    """Against draws of Σ from its posterior, as for the mean."""
    from scipy.stats import invwishart

    rng = np.random.default_rng(6)
    n, values = 12, np.random.default_rng(0).multivariate_normal([10.0, 20.0], [[1.0, 0.8], [0.8, 1.0]], 12)
    centred = values - values.mean(axis=0)
    sigma = invwishart(n - 1, centred.T @ centred).rvs(20000, random_state=rng)
    expected = np.einsum("nij,nj->ni", np.linalg.cholesky(sigma), rng.standard_normal((20000, 2)))
    drawn = RepeatedTests(values, "joint").simulate(rng, 20000)
    assert_allclose(np.cov(drawn.T), np.cov(expected.T), rtol=0.1)
    difference = np.quantile(drawn @ [1.0, -1.0], [0.05, 0.95]) / np.quantile(expected @ [1.0, -1.0], [0.05, 0.95])
    assert_allclose(difference, 1.0, atol=0.08)


@pytest.mark.parametrize("n", [3, 10, 100])
def test_the_interval_of_one_more_test_holds_new_tests(n):
    """100 new tests after each of 200 sets of n: 90 % lie in it, but 92 % for n = 3, as is documented.

    In the interval of the mean, which was called that of a new measurement, lie 10 to 90 %.
    """
    rng = np.random.default_rng(n)
    inside, of_mean = [], []
    for _ in range(200):
        tests = RepeatedTests(10.0 + 0.1 * rng.standard_normal((n, 1)))
        mean, sd, _ = tests.mean()
        model = mean + sd * rng.standard_normal((1000, 1))  # what a model that can follow the mean believes
        new = 10.0 + 0.1 * rng.standard_normal(100)
        for found, drawn in (
            (inside, model + tests.simulate(rng, 1000)),
            (of_mean, model + sd * rng.standard_normal((1000, 1))),
        ):
            low, high = np.quantile(drawn, [0.05, 0.95])
            found.append(np.mean((new > low) & (new < high)))
    error = np.std(inside) / np.sqrt(200)
    assert abs(np.mean(inside) - {3: 0.922}.get(n, 0.9)) < 4 * error < 0.05
    if n == 100:
        assert np.mean(of_mean) < 0.25


def test_single_tests_stay_in_the_data():
    data = ModalData.from_tests(TESTS)
    assert data.as_dict()["tests"] == {
        "frequencies_hz": [[10.0, 20.1, 30.3], [10.2, 20.0, None], [10.1, 20.5, 30.0]], "scatter": "pooled"
    }  # fmt: skip
    with pytest.raises(ValueError, match=r"tests: must be of 2 modes \(got 3\)"):
        ModalData([10.0, 20.0], tests=RepeatedTests(TESTS))


def test_scatter_of_shapes_is_that_of_the_error_of_their_mean():
    """u = φ + σ noise at unit length: the mean of n directions errs by σ/√n across φ, in every one of q − 1."""
    rng, phi, sigma, n = np.random.default_rng(7), np.array([3.0, 4.0, 12.0, 0.0, 2.0]), 0.02, 4
    phi = phi / np.linalg.norm(phi)
    told, errors = [], []
    for _ in range(300):
        signs = rng.choice([-1.0, 1.0], (n, 1)) * rng.uniform(0.1, 9.0, (n, 1))
        shapes = signs * (phi + sigma * rng.standard_normal((n, 5)))
        told.append(shapes_sd(shapes[:, :, None])[0])
        mean = mean_shapes(shapes[:, :, None])[:, 0]
        errors.append(mean - (mean @ phi) * phi)
    true = np.sqrt(np.sum(np.square(errors)) / (300 * 4))
    assert true == pytest.approx(sigma / np.sqrt(n), rel=5 / np.sqrt(2 * 1200))
    factor = t.ppf(0.975, 12) / norm.ppf(0.975)  # of (n − 1)(q − 1) degrees of freedom
    assert np.sqrt(np.mean(np.square(told))) / factor == pytest.approx(true, rel=5 / np.sqrt(1200))


def test_shapes_that_do_not_scatter_tell_no_deviation():
    shapes = np.tile([[1.0], [0.5], [0.2]], (3, 1, 1)) * np.array([1.0, -2.0, 7.0])[:, None, None]
    assert shapes_sd(shapes) is None
    assert shapes_sd(shapes[:1]) is None
    assert shapes_sd(shapes[:, :1]) is None


def test_shapes_are_averaged_in_one_scale_and_sign():
    one, other = np.array([3.0, 4.0, 0.0]), np.array([0.0, -4.0, 3.0])
    shapes = np.full((3, 3, 2), np.nan)
    shapes[0, :, 0], shapes[1, :, 0], shapes[2, :, 0] = 2.0 * one, -one, 0.1 * other * -1
    shapes[1, :, 1] = other
    mean = mean_shapes(shapes)
    expected = 2 * one / 5 - other / 5
    assert_allclose(mean[:, 0], expected / np.linalg.norm(expected))
    assert_allclose(mean[:, 1], other / 5)


def test_order_of_tests_changes_the_sign_only():
    rng = np.random.default_rng(2)
    shapes = rng.choice([-1.0, 1.0], (5, 1, 1)) * ([[1.0], [2.0], [3.0]] + 0.1 * rng.normal(size=(5, 3, 1)))
    assert_allclose(np.abs(mean_shapes(shapes)), np.abs(mean_shapes(shapes[::-1])), rtol=1e-12)


def test_data_from_tests():
    shapes = np.tile([[1.0, 1.0, 1.0], [0.5, -1.0, 0.2]], (3, 1, 1))
    sensors = ((1, "x"), (2, "x"))
    data = ModalData.from_tests(TESTS, shapes, scatter="pooled", numbers=(1, 2, 4), sensors=sensors)
    mean, sd, _ = RepeatedTests(TESTS, "pooled").mean()
    assert_allclose(data.frequencies_hz, mean)
    assert_allclose(data.sd_hz, sd)
    assert_allclose(data.shapes, mean_shapes(shapes))
    assert data.numbers == (1, 2, 4)
    assert data.sensors == sensors
    joint = ModalData.from_tests(np.random.default_rng(3).normal(10.0, 1.0, (6, 2)), scatter="joint")
    assert joint.covariance_hz2.shape == (2, 2)


def test_a_missed_mode_is_left_out_of_the_tests_too():
    data = ModalData.from_tests(TESTS, scatter="each")
    left = data.with_frequencies(np.array([np.nan, *np.asarray(data.frequencies_hz)[1:]]))
    assert left.labels == data.labels[1:]
    assert_allclose(left.tests.frequencies_hz, TESTS[:, 1:])
    assert_allclose(left.tests.mean().sd_hz, left.sd_hz)


@pytest.mark.parametrize("scatter", ["pooled", "joint"])
def test_a_missed_mode_changes_the_scatter_that_modes_share(scatter):
    values = np.random.default_rng(1).normal(100.0, [0.1, 0.1, 1.0], (7, 3))
    data = ModalData.from_tests(values, scatter=scatter)
    left = data.with_frequencies(np.array([99.0, 101.0, np.nan]))
    fewer = ModalData.from_tests(values[:, :2], scatter=scatter)
    for name in ("sd_hz", "covariance_hz2"):
        assert_array_equal(getattr(left, name), getattr(fewer, name))
    assert left.tests.gave(left.sd_hz, left.covariance_hz2)
    uncertain = {"sd_hz": [1.0, 2.0, 3.0]} if scatter == "pooled" else {"covariance_hz2": np.diag([1.0, 4.0, 9.0])}
    own = ModalData(data.frequencies_hz, **uncertain, tests=data.tests)
    left = own.with_frequencies(np.array([99.0, np.nan, 101.0]))
    assert_array_equal(left.sd_hz if scatter == "pooled" else np.sqrt(np.diag(left.covariance_hz2)), [1.0, 3.0])


@pytest.mark.parametrize(
    ("frequencies", "scatter", "message"),
    [
        ([1.0, 2.0], "each", r"frequencies: must have shape \(n_tests, n_modes\) \(got \(2,\)\)"),
        ([[1.0], [2.0]], "all", r"scatter: must be one of .* \(got 'all'\)"),
        ([[1.0], [-2.0]], "each", r"frequencies\.1\.0: must be positive and finite, or NaN \(got -2\.0 Hz\)"),
        ([[1.0, 2.0]], "each", r"frequencies: every mode must have at least 2 values \(got 1 of mode 1\)"),
        (
            [[1.0, 2.0], [1.1, np.nan]],
            "pooled",
            r"frequencies: every mode must have at least 2 values \(got 1 of mode 2\)",
        ),
        ([[1.0, 2.0], [1.0, 2.1]], "each", r"frequencies: the values .* \(got 1\.0 Hz only, of mode 1\)"),
        (
            np.where(TESTS > 30.2, np.nan, TESTS)[:, :2].repeat(2, 0) * np.nan,
            "joint",
            r"frequencies: every mode .*",
        ),
        (TESTS, "joint", r'frequencies: must have no NaN where scatter is "joint"'),
        (TESTS[:, :2], "joint", r"frequencies: must be of at least 5 tests, 3 more than modes, .* \(got 3\)"),
    ],
)
def test_wrong_frequencies(frequencies, scatter, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        RepeatedTests(frequencies, scatter).mean()


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        (np.ones((2, 3)), r"shapes: must have shape \(n_tests, n_sensors, n_modes\) \(got \(2, 3\)\)"),
        (np.full((2, 3, 1), np.nan), r"shapes: every mode must be in a test \(got none of mode 1\)"),
        (np.array([[[1.0], [2.0]], [[0.0], [0.0]]]), r"shapes\.1: mode 1 must be finite and not zero, .*"),
        (np.array([[[1.0], [2.0]], [[np.nan], [1.0]]]), r"shapes\.1: mode 1 must be finite and not zero, .*"),
        (
            np.array([[[1.0], [0.0]], [[1.0], [0.1]], [[0.0], [1.0]]]),
            r"shapes\.2: mode 1 must have a MAC of at least 0\.5 .* is it the same mode\?",
        ),
    ],
)
def test_wrong_shapes(shapes, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        mean_shapes(shapes)


@pytest.mark.parametrize(("scatter", "n"), [("each", 2), ("each", 3), ("pooled", 3)])
def test_errors_of_the_mean_are_normal_scores(scatter, n):
    """By themselves they have the tails of Student's distribution: far errors are 3 to 30 times as frequent.

    Where nothing is pooled, the repetitions are further modes.
    """
    rng, scores, plain = np.random.default_rng(8), [], []
    repetitions, modes = (1500, 2) if scatter == "pooled" else (1, 4000)
    for _ in range(repetitions):
        tests = RepeatedTests(100.0 + rng.standard_normal((n, modes)), scatter)
        mean, sd, _ = tests.mean()
        plain.append((mean - 100.0) / sd)
        scores.append(tests.normal_scores(plain[-1]))
    assert kstest(np.ravel(scores), "norm").pvalue > 1e-3
    far = np.size(scores) * 2.0 * norm.sf(3.3)  # 3 or 4 are expected
    assert np.sum(np.abs(scores) > 3.3) < far + 4.0 * np.sqrt(far)
    assert np.sum(np.abs(plain) > 3.3) > far + 4.0 * np.sqrt(far)


def test_the_scores_of_far_errors():
    values = np.random.default_rng(1).normal(100.0, 1.0, (3, 1))
    scores = RepeatedTests(values, "each").normal_scores(np.array([[-np.inf], [-1e6], [0.0], [1e6], [np.inf]]))
    assert np.all(np.diff(scores[:, 0]) > 0)
    assert scores[2, 0] == 0.0
    many = RepeatedTests(np.random.default_rng(1).normal(100.0, 1.0, (2000, 2)), "joint")
    scores = many.normal_scores(np.array([[0.0, 0.0], [0.01, -0.02], [3.0, 4.0], [3e5, 4e5]]))
    assert np.all(scores[0] == 0.0)
    assert_allclose(scores[1], [0.01, -0.02], rtol=1e-2)  # the F distribution is nearly the chi-square one
    assert np.all(np.isfinite(scores))
    assert scores[3, 0] > 5.0 * scores[2, 0] > 10.0


@pytest.mark.parametrize("used", [None, np.array([0, 2])])
def test_scores_of_modes_that_share_a_scatter_by_f_distributions(used):
    z, at = np.array([[0.3, -1.2, 2.5], [4.0, 0.5, -3.0]]), [0, 1, 2] if used is None else used
    q, k = np.sum(z[:, at] ** 2, axis=1), len(at)
    g = t.ppf(0.975, 5) / norm.ppf(0.975)
    pooled = RepeatedTests(TESTS, "pooled").normal_scores(z, used)
    assert_allclose(chi2.sf(np.sum(pooled[:, at] ** 2, axis=1), k), f.sf(g**2 * q / k, k, 5), rtol=1e-9)
    assert_allclose(pooled / z, (pooled[:, :1] / z[:, :1]).repeat(3, axis=1))


@pytest.mark.parametrize("used", [[0, 1, 2, 3], [0, 2]])
def test_scores_of_modes_with_a_joint_scatter_by_regression(used):
    """A mode's score is that of the t-value of the constant in its regression on the modes before it."""
    rng, truth = np.random.default_rng(1), np.array([99.0, 101.0, 100.5, 100.0])
    tests = RepeatedTests(100.0 + rng.standard_normal((9, 4)) @ rng.standard_normal((4, 4)), "joint")
    mean, _, C = tests.mean()
    z, errors = np.zeros(4), tests.frequencies_hz - truth
    z[used] = np.linalg.solve(np.linalg.cholesky(C[np.ix_(used, used)]), (mean - truth)[used])
    expected = []
    for i, mode in enumerate(used):
        columns = np.column_stack([np.ones(9), errors[:, used[:i]]])
        constant = np.linalg.lstsq(columns, errors[:, mode])[0]
        left = errors[:, mode] - columns @ constant
        variance = left @ left / (8 - i) * np.linalg.inv(columns.T @ columns)[0, 0]
        expected.append(norm.ppf(t.cdf(constant[0] / np.sqrt(variance), 8 - i)))
    assert_allclose(tests.normal_scores(z, None if len(used) == 4 else np.array(used))[used], expected, rtol=1e-8)


@pytest.mark.parametrize(("scatter", "n"), [("pooled", 2), ("joint", 8)])
@pytest.mark.parametrize("used", [None, np.arange(3)])
def test_squared_scores_of_all_modes_sum_to_chi_square(scatter, n, used):
    """Scores of single modes took 7 to 9 % below 1 %, as all modes share one estimated scatter.

    With one common factor, 0.02 to 9 % of a mode's scores with a joint scatter exceeded the limit of 1 %.
    """
    rng, squares, every, repetitions = np.random.default_rng(3), [], [], 600
    for _ in range(repetitions):
        tests = RepeatedTests(100.0 + 0.1 * rng.standard_normal((n, 5)), scatter)
        mean, sd, covariance = tests.mean()
        C = np.diag(np.square(sd)) if covariance is None else np.array(covariance)
        if used is not None:
            C[3:, :3] = C[:3, 3:] = 0.0
        scores = tests.normal_scores(np.linalg.solve(np.linalg.cholesky(C), mean - 100.0), used)[used]
        squares.append(np.sum(scores**2))
        every.append(scores.ravel())
    p = chi2.sf(squares, scores.size)
    if scatter == "joint":
        far = np.mean(np.abs(every) > norm.isf(0.005), axis=0)
        assert_allclose(far, 0.01, atol=5 * np.sqrt(0.0099 / repetitions))
        assert_allclose(np.var(every, axis=0), 1.0, atol=5 * np.sqrt(2 / repetitions))
    for level in (0.01, 0.05):
        error = np.sqrt(level * (1 - level) / repetitions)
        assert np.mean(p < level) == pytest.approx(level, abs=5 * error)


def test_the_scatter_is_pooled_if_a_mode_has_fewer_than_ten_values():
    values = np.random.default_rng(1).normal(100.0, 1.0, (10, 2))
    missed = np.where(np.arange(20).reshape(10, 2) == 3, np.nan, values)
    assert RepeatedTests(values).scatter == "each"
    assert RepeatedTests(missed).scatter == "pooled"
    assert_allclose(ModalData.from_tests(missed).sd_hz, RepeatedTests(missed, "pooled").mean().sd_hz)


@pytest.mark.parametrize(
    ("scatter", "unequal", "n", "share"),
    [
        ("pooled", 0.0, 2, 0.95),
        pytest.param("pooled", 0.0, 5, 0.95, marks=pytest.mark.validate),
        ("pooled", 1.0, 2, 0.90),
        pytest.param("pooled", 1.0, 5, 0.93, marks=pytest.mark.validate),
        ("each", 0.0, 2, 0.76),
        pytest.param("each", 0.0, 3, 0.82, marks=pytest.mark.validate),
        ("each", 0.0, 5, 0.88),
    ],
)
def test_intervals_of_a_parameter_that_all_modes_determine(scatter, unequal, n, share):
    """95 % intervals of six modes; `unequal` is the sd of the logarithms of their true scatters."""
    rng, limit, inside = np.random.default_rng(4), norm.ppf(0.975), []
    for _ in range(1200):
        true = 0.1 * np.exp(unequal * rng.standard_normal(6))
        mean, sd, _ = RepeatedTests(100.0 + true * rng.standard_normal((n, 6)), scatter).mean()
        weight = sd**-2.0
        inside.append(abs(weight @ (mean - 100.0)) < limit * np.sqrt(weight.sum()))
    assert np.mean(inside) == pytest.approx(share, abs=5 * np.sqrt(share * (1.0 - share) / 1200))


@pytest.mark.parametrize(("scatter", "n"), [("each", 2), ("each", 3), ("pooled", 2), ("joint", 7)])
def test_errors_of_a_new_mean_are_students(scatter, n):
    """And those of modes that share a scatter are far together."""
    tests = RepeatedTests(np.random.default_rng(1).normal(100.0, 1.0, (n, 2)), scatter)
    z = tests.standard_errors(np.random.default_rng(2), 20_000)
    nu = {"each": n - 1, "pooled": 2 * (n - 1), "joint": n - 2}[scatter]
    scale = norm.ppf(0.975) / t.ppf(0.975, nu) if scatter != "joint" else np.sqrt((n - 4) / (n - 2))
    assert kstest(z.ravel() / scale, t(nu).cdf).pvalue > 1e-3
    together = np.mean(np.all(np.abs(z / scale) > t.ppf(0.975, nu), axis=1))
    assert (together > 0.0025 + 5 * np.sqrt(0.0025 / 20_000)) == (scatter != "each")


def test_which_standard_deviations_the_tests_gave():
    tests = RepeatedTests(TESTS)
    assert tests.gave(tests.mean().sd_hz, None)
    assert not tests.gave(2.0 * tests.mean().sd_hz, None)
    assert not tests.gave(None, np.eye(3))
    joint = RepeatedTests(np.random.default_rng(1).normal(100.0, 1.0, (8, 2)), "joint")
    assert joint.gave(None, joint.mean().covariance_hz2)
    assert not joint.gave([1.0, 1.0], None)


@pytest.mark.parametrize("shape", [(2, 4, 2), (3, 4, 3), (3, 2)])
def test_shapes_are_of_the_tests_and_modes_of_the_frequencies(shape):
    rng = np.random.default_rng(1)
    with pytest.raises(ValueError, match=r"shapes: must have shape \(3, n_sensors, 2\) \(got \("):
        ModalData.from_tests(rng.normal(10.0, 0.1, (3, 2)), shapes=1.0 + 0.01 * rng.standard_normal(shape))
