"""Draws from Gaussians in a box against integrals over a grid, far tails included."""

import numpy as np
import pytest
from scipy.integrate import simpson
from scipy.special import log_ndtr, logsumexp
from scipy.stats import kstest, truncnorm

from fmu.samplers.mixture.truncated_normal import SequentialNormal, log_mass

COVARIANCE = np.array([[1.0, 0.8], [0.8, 2.0]])
LOWER, UPPER = np.array([0.0, -1.0]), np.array([1.0, 3.0])
INSIDE, OUTSIDE, FAR, BOTH = (0.2, 0.3), (5.0, -3.0), (-30.0, 1.0), (60.0, -80.0)


def on_grid(mean):
    """Return log of the mass in the box of exp(−d'Pd/2), and the mean there, by Simpson's rule."""
    x, y = (np.linspace(a, b, 1201) for a, b in zip(LOWER, UPPER, strict=True))
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    log_p = log_gaussian(points, mean)
    p = np.exp(log_p - log_p.max())
    total = simpson(simpson(p, y), x)
    first = [simpson(simpson(p * points[..., k], y), x) / total for k in range(2)]
    return np.log(total) + log_p.max(), first, points.reshape(-1, 2)[np.argmax(log_p)]


def log_gaussian(u, mean):
    d = u - np.asarray(mean)
    return -0.5 * np.einsum("...i,ij,...j", d, np.linalg.inv(COVARIANCE), d)


def proposal(mean, densest):
    return SequentialNormal(np.array(mean), np.linalg.inv(COVARIANCE), LOWER, UPPER)


@pytest.mark.parametrize("mean", [INSIDE, OUTSIDE, FAR, BOTH])
def test_weighted_draws_have_the_mass_and_the_mean(mean):
    log_total, first, densest = on_grid(mean)
    q = proposal(mean, densest)
    u = q.draw(np.random.default_rng(1), 20_000)
    assert np.all((u >= LOWER) & (u <= UPPER))
    log_w = log_gaussian(u, mean) - q.log_density(u)
    assert logsumexp(log_w) - np.log(len(u)) == pytest.approx(log_total, abs=0.02)
    w = np.exp(log_w - logsumexp(log_w))
    assert 1.0 / np.sum(w**2) > 0.6 * len(u)
    sd = np.sqrt(w @ (u - w @ u) ** 2)
    np.testing.assert_allclose((w @ u - first) / sd, 0.0, atol=5 / np.sqrt(0.6 * len(u)))


def test_density_is_that_of_the_draws():
    """Without correlation the draws are exactly truncated normals, whatever the tilting."""
    q = SequentialNormal(np.array([-3.0, 0.5]), np.diag([4.0, 1.0]), LOWER, UPPER)
    u = q.draw(np.random.default_rng(2), 5000)
    expected = 0.0
    for k, (mean, sd) in enumerate([(-3.0, 0.5), (0.5, 1.0)]):
        one = truncnorm((LOWER[k] - mean) / sd, (UPPER[k] - mean) / sd, mean, sd)
        assert kstest(u[:, k], one.cdf).pvalue > 1e-3
        expected = expected + one.logpdf(u[:, k])
    np.testing.assert_allclose(q.log_density(u), expected, atol=1e-9)


def test_tilting_is_what_makes_a_correlated_corner_tractable():
    mean = np.array([20.0, 20.0, -20.0])
    precision = np.linalg.inv(0.98 + 0.02 * np.eye(3))
    q = SequentialNormal(mean, precision, np.zeros(3), np.ones(3))

    def effective(q):
        u = q.draw(np.random.default_rng(3), 4000)
        d = u - mean
        log_w = -0.5 * np.einsum("ni,ij,nj->n", d, precision, d) - q.log_density(u)
        return np.exp(2 * logsumexp(log_w) - logsumexp(2 * log_w))

    tilted = effective(q)
    q.tilt = np.zeros(3)
    assert tilted > 1000
    assert effective(q) < 0.5 * tilted


def test_no_walls_is_the_gaussian_itself():
    infinite = np.full(2, np.inf)
    q = SequentialNormal(np.zeros(2), np.linalg.inv(COVARIANCE), -infinite, infinite)
    u = q.draw(np.random.default_rng(4), 20_000)
    np.testing.assert_allclose(np.cov(u.T), COVARIANCE, atol=0.1)
    np.testing.assert_allclose(np.ptp(log_gaussian(u, (0, 0)) - q.log_density(u)), 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("a", "b"), [(-1.0, 2.0), (3.0, np.inf), (-np.inf, -40.0), (-np.inf, np.inf), (50.0, 50.1)]
)
def test_log_mass(a, b):
    # ∫ φ from a to b, referred to φ at the end that is nearer to 0
    x = np.linspace(max(a, -60.0), min(b, 60.0), 400_001)
    log_phi = -0.5 * x**2 - 0.5 * np.log(2 * np.pi)
    expected = np.log(simpson(np.exp(log_phi - log_phi.max()), x)) + log_phi.max()
    assert log_mass(np.array(a), np.array(b)) == pytest.approx(expected, rel=1e-6, abs=1e-8)
    if b == np.inf:
        assert log_mass(np.array(a), np.array(b)) == pytest.approx(log_ndtr(-a), rel=1e-12, abs=1e-15)


@pytest.mark.parametrize("centre", [-18688930762644.508, 18688930762644.508])
def test_a_box_far_out_in_the_tail_is_drawn_from_at_its_wall(centre):
    """The logarithm of the mass is -2e26 there, and its rounding 3e10."""
    precision = np.array([[1.0, 0.3], [0.3, 1.0]])
    normal = SequentialNormal(np.full(2, centre), precision, np.zeros(2), np.ones(2))
    u = normal.draw(np.random.default_rng(1), 20)
    assert np.all(np.abs(u - float(centre > 0)) < 10 * np.spacing(abs(centre)))
    assert not np.isnan(normal.log_density(u)).any()
