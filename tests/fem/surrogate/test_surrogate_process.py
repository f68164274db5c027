"""Gaussian processes: derivatives, batches, what they learn of lengths and scatter; failed regions."""

import re

import numpy as np
import pytest
from scipy.stats import qmc

from fmu.fem.surrogate.coordinates import Coordinates
from fmu.fem.surrogate.feasibility import Feasibility, failed_region
from fmu.fem.surrogate.process import LEAST_SCATTER, Process
from tests.gradients import assert_gradient


def values(x):
    """Two smooth quantities of three parameters, of which the last has no effect."""
    return np.stack([np.log(3.0 + x[:, 0] + 0.5 * x[:, 1]), 0.3 * x[:, 0] - 0.1 * x[:, 1] ** 2], axis=1)


@pytest.fixture(scope="module")
def points():
    return np.random.default_rng(1).uniform(-1.0, 1.0, (40, 3))


@pytest.fixture(scope="module")
def process(points):
    found = Process(points, values(points))
    found.most = np.inf
    return found


def test_it_predicts_a_smooth_function_within_what_it_expects(process):
    x = np.random.default_rng(2).uniform(-1.0, 1.0, (200, 3))
    expected, variance = process.predict(x)
    error = expected - values(x)
    assert np.max(np.abs(error)) < 1e-3
    assert np.mean(error**2 / variance) < 4.0


def test_derivatives_are_those_of_values_and_variances(points):
    process = Process(points[:12], values(points[:12]))  # with many more, variances are of the size of rounding
    process.most = np.inf
    x, h = np.random.default_rng(3).uniform(-1.0, 1.0, (5, 3)), 1e-3
    _, _, slopes, by_variance = process.predict_with_slopes(x)
    scale = np.max(np.abs(by_variance))
    assert_gradient(slopes, lambda x: process.predict(x)[0], x, h, rtol=1e-7, atol=1e-5)
    assert_gradient(by_variance, lambda x: process.predict(x)[1], x, h, rtol=1e-7, atol=1e-3 * scale)


def test_a_row_of_a_batch_has_the_bits_of_a_single_point(process):
    x = np.random.default_rng(4).uniform(-1.0, 1.0, (37, 3))
    together = process.predict_with_slopes(x)
    for i in (0, 15, 16, 36):
        alone = process.predict_with_slopes(x[i : i + 1])
        assert all(np.array_equal(one[i], other[0]) for one, other in zip(together, alone, strict=True))
    assert all(map(np.array_equal, process.predict(x), together))
    assert np.array_equal(process.values(x), together[0])


def test_no_variance_is_larger_than_those_at_the_draws(points):
    process = Process(points[:12], values(points[:12]))
    process.limit(points[:20])
    x = np.random.default_rng(8).uniform(-3.0, 3.0, (50, 3))
    _, variance, _, by_variance = process.predict_with_slopes(x)
    largest = np.max(process.predict(points[:20], limited=False)[1], axis=0)
    np.testing.assert_allclose(np.max(variance, axis=0), largest)
    assert not by_variance[variance == variance.max(axis=0)].any()


def test_a_parameter_without_effect_has_a_long_length(process):
    length = process.kernel.get_params()["k1__k2__k2__length_scale"]
    assert length[2] > 10.0 * max(length[:2])


def test_scatter_of_the_answers_is_estimated(points):
    noisy = values(points)[:, :1] + 1e-3 * np.random.default_rng(5).standard_normal((len(points), 1))
    assert Process(points, noisy).scatter == pytest.approx(1e-3, rel=0.4)


def test_a_solved_point_reduces_the_covariance_around_it(points):
    few = Process(points[:10], values(points[:10]))
    covariance, scatter = few.covariance(points[10:30])
    column = covariance[:, 0]
    left = covariance - np.outer(column, column) / (column[0] + scatter)
    assert left[0, 0] < 1e-3 * covariance[0, 0]
    np.testing.assert_allclose(
        np.diag(covariance) * few.unit[0] ** 2,
        few.predict(points[10:30], limited=False)[1][:, 0],
        rtol=1e-4,
        atol=1e-12,
    )


def test_coordinates_are_logarithms_where_the_box_is_positive():
    map_of = Coordinates.of_box(np.array([1.0, -1.0]), np.array([100.0, 3.0]), np.array([True, True]))
    theta = np.array([[10.0, 1.0], [1.0, -1.0], [100.0, 3.0], [0.0, 5.0]])
    x = map_of.to_x(theta)
    np.testing.assert_allclose(x[:3], [[0.0, 0.0], [-1.0, -1.0], [1.0, 1.0]], atol=1e-14)
    assert np.all(np.isfinite(x))
    np.testing.assert_allclose(map_of.to_theta(x[:3]), theta[:3])
    h = np.array([1e-6, 1e-6])
    np.testing.assert_allclose(
        map_of.slope(theta[:1]), (map_of.to_x(theta[:1] + h) - map_of.to_x(theta[:1] - h)) / (2 * h), rtol=1e-6
    )


def test_a_corner_that_fails_is_learnt_and_told():
    x = np.random.default_rng(6).uniform(-1.0, 1.0, (80, 2))
    failed = (x[:, 0] > 0.4) & (x[:, 1] > 0.2)
    feasible = Feasibility(x, failed)
    assert np.array_equal(feasible(x), ~failed)
    fresh = np.random.default_rng(7).uniform(-1.0, 1.0, (500, 2))
    assert np.mean(feasible(fresh) == ~((fresh[:, 0] > 0.4) & (fresh[:, 1] > 0.2))) > 0.93
    said = failed_region(x, failed, ("stiffness", "mass"))
    assert "stiffness is above" in said
    assert "mass is above" in said
    assert "below" not in said


def test_two_corners_that_fail_are_both_named():
    x = np.random.default_rng(6).uniform(-1.0, 1.0, (120, 2))
    failed = ((x[:, 0] > 0.4) & (x[:, 1] > 0.2)) | ((x[:, 0] < -0.6) & (x[:, 1] < -0.3))
    said = failed_region(x, failed, ("stiffness", "mass"))
    assert said.startswith(f"of its {failed.sum()} failures ")
    assert all(f"{name} is {side}" in said for name in ("stiffness", "mass") for side in ("above", "below"))
    counts = [int(number) for number in re.findall(r"(\d+) (?:where|elsewhere)", said)]
    assert sum(counts) == failed.sum()


def test_without_failures_everything_can_be_solved():
    x = np.zeros((3, 2))
    assert Feasibility(x, np.zeros(3, dtype=bool))(10.0 + x).all()


def springs(d, n):
    """Points of a box of four decades, and the logarithm of the stiffness of springs in a row: exact."""
    x = 2.0 * qmc.Sobol(d, rng=np.random.default_rng(3)).random_base2(int(np.log2(n))) - 1.0
    return x, -np.log(1.0 + np.sum(10.0 ** (-2.0 * x), axis=1))[:, None]


@pytest.mark.parametrize(("d", "n"), [(2, 32), (4, 32), pytest.param(4, 64, marks=pytest.mark.validate)])
def test_what_is_not_yet_learnt_is_no_scatter(d, n):
    """Of these exact functions up to a fifth of the spread was taken for scatter of the solver."""
    assert Process(*springs(d, n)).relative_scatter == pytest.approx(np.sqrt(LEAST_SCATTER), rel=1e-3)


def test_scatter_is_found_where_there_is_some():
    x, y = springs(2, 64)
    noise = 1e-2 * y.std() * np.random.default_rng(5).standard_normal(y.shape)
    assert Process(x, y + noise).relative_scatter == pytest.approx(1e-2, rel=0.4)
