import numpy as np
import pytest

from fmu.samplers.trajectory import CentralDifference, ExactGradient
from tests.samplers.targets import ALL, Counting, SkewedGumbel, TruncatedGaussian


def points(target, n=20):
    return target.sample_prior(np.random.default_rng(1), n)


@pytest.mark.parametrize("kind", ALL, ids=lambda kind: kind.name)
def test_central_difference_agrees_with_the_exact_gradient(kind):
    target = kind()
    spread = np.sqrt(np.diag(target.covariance))
    x = points(target)
    if np.isfinite(target.lower).all():
        x = np.clip(x, target.lower + 0.1 * spread, target.upper - 0.1 * spread)
    exact = ExactGradient(target).slope(x, with_log_prob=True)
    central = CentralDifference(target, spread, 1e-5).slope(x, with_log_prob=True)
    np.testing.assert_allclose(central.gradient, exact.gradient, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(central.log_prob, exact.log_prob, rtol=1e-12)
    assert central.finite.all()
    assert exact.finite.all()


def test_the_error_of_the_central_difference_falls_as_h_squared():
    target = SkewedGumbel()
    x = points(target)
    exact = ExactGradient(target).slope(x, with_log_prob=False).gradient
    error = [
        np.abs(CentralDifference(target, np.ones(3), h).slope(x, with_log_prob=False).gradient - exact).max()
        for h in (0.04, 0.02)
    ]
    assert error[0] / error[1] == pytest.approx(4, rel=0.02)


def test_delta_scales_each_coordinate():
    """On a cubic the error is Δᵢ² h² f''' / 6, which tells the coordinates' perturbations apart."""

    class Cubic(TruncatedGaussian):
        def value_and_slope(self, x):
            return np.sum(x**3, axis=1), 3 * x**2

    delta, h = np.array([0.5, 2.0]), 0.01
    gradient = CentralDifference(Cubic(), delta, h).slope(np.array([[0.2, 2.0]]), with_log_prob=False).gradient
    np.testing.assert_allclose(gradient - [[0.12, 12.0]], [(h * delta) ** 2], rtol=1e-6)


def test_one_sided_at_a_wall_and_never_outside():
    target = TruncatedGaussian()
    density = Counting(target)
    x = np.array([[-1.0, 2.0], [1.0, 0.0], [1.0 - 1e-7, 5.0]])
    central = CentralDifference(density, np.ones(2), 1e-5).slope(x, with_log_prob=True)
    exact = ExactGradient(target).slope(x, with_log_prob=True)
    np.testing.assert_allclose(central.gradient, exact.gradient, atol=1e-4)
    assert density.n_solves == 3 * 5


@pytest.mark.parametrize(("with_log_prob", "solves"), [(False, 4), (True, 5)])
def test_cost_of_a_central_difference(with_log_prob, solves):
    density = Counting(TruncatedGaussian())
    found = CentralDifference(density, np.ones(2), 1e-5).slope(points(density, 7), with_log_prob=with_log_prob)
    assert np.all(found.n_solves == solves)
    assert density.n_solves == 7 * solves
    assert density.n_gradients == 0


def test_what_is_not_finite_is_said_so():
    class Broken(TruncatedGaussian):
        def value_and_slope(self, x):
            value, slope = super().value_and_slope(x)
            return np.where(x[:, 0] > 0, np.nan, value), slope

    x = np.array([[-0.5, 1.0], [0.5, 1.0]])
    for target in (ExactGradient(Broken()), CentralDifference(Broken(), np.ones(2), 1e-5)):
        np.testing.assert_array_equal(target.slope(x, with_log_prob=True).finite, [True, False])
