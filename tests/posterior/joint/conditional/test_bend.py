"""Parabolas that the densities of scores follow: the map, its inverse and its determinant, and the search."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fmu.posterior.joint.conditional.bend import Bend, Curve, find_bend

N, P = 3, 4


@pytest.fixture(scope="module")
def bent():
    """Return the bend of three skewed densities with coordinates of unequal sizes, their means and slopes."""
    rng = np.random.default_rng(1)
    precision = np.empty((N, P, P))
    for t in range(N):
        axes = np.linalg.qr(rng.standard_normal((P, P)))[0]
        precision[t] = (axes * [1.0, 4.0, 25.0, 400.0]) @ axes.T
    values, vectors = np.linalg.eigh(precision)
    Q = rng.normal(0.0, 0.5, (N, P, P, P))
    Q = 0.5 * (Q + np.swapaxes(Q, 2, 3))
    for j in range(P):
        Q[:, j, j:], Q[:, j, :, j:] = 0.0, 0.0
    forward, inverse = np.sqrt(values)[..., None] * np.swapaxes(vectors, 1, 2), vectors / np.sqrt(values)[:, None]
    slopes = rng.uniform(0.5, 2.0, (N, P))
    return Bend(forward, inverse, Q, slopes), rng.standard_normal((N, P)), precision


def test_straightened_scores_bent_again_are_the_scores_at_any_slopes(bent):
    of, mean, _ = bent
    rng = np.random.default_rng(2)
    curve = Curve(of, np.repeat(mean[None], 5, axis=0), rng.uniform(0.5, 2.0, (5, N, P)))
    z = mean + rng.standard_normal((5, N, P))
    assert np.max(np.abs(curve.bend(z) - z)) > 0.1
    assert_allclose(curve.straighten(curve.bend(z)), z, rtol=1e-9, atol=1e-9)
    assert_allclose(curve.bend(curve.straighten(z)), z, rtol=1e-9, atol=1e-9)


def test_the_map_keeps_volumes(bent):
    of, mean, _ = bent
    rng, h = np.random.default_rng(3), 1e-5
    stretch = rng.uniform(0.5, 2.0, (1, N, P))
    curve, z = Curve(of, mean[None], stretch), mean + rng.standard_normal((1, N, P))
    columns = [(curve.bend(z + h * e) - curve.bend(z - h * e))[0] / (2.0 * h) for e in np.eye(P)]
    assert_allclose(np.linalg.det(np.stack(columns, axis=2)), 1.0, rtol=1e-6)


def test_the_parabolas_of_a_bent_normal_density_are_found(bent):
    """Where the last coordinate alone is bent, gradients one standard deviation away give Q without an error."""
    of, mean, precision = bent
    Q = of.curvature.copy()
    Q[:, :-1] = 0.0  # only the last coordinate follows the others
    curve = Curve(of._replace(curvature=Q), mean[None], np.ones((1, N, P)))

    def log_density(z):
        away = curve.straighten(z) - mean
        return -0.5 * np.einsum("nti,tij,ntj->nt", away, precision, away)

    def gradient(z, h=1e-5):
        return np.stack([(log_density(z + h * e) - log_density(z - h * e)) / (2.0 * h) for e in np.eye(P)], axis=2)

    found = find_bend(gradient, mean, precision, of.slopes)
    order = np.abs(np.einsum("tij,tjk->tik", found.forward, of.inverse))
    assert_allclose(order, np.broadcast_to(np.eye(P), order.shape), atol=1e-9)  # the same axes, up to signs
    z = mean + 0.5 * np.random.default_rng(4).standard_normal((6, N, P))
    again = Curve(found, mean[None], np.ones((1, N, P)))
    assert_allclose(again.straighten(z), curve.straighten(z), atol=1e-6)


def test_the_map_found_for_a_density_that_parabolas_do_not_give_has_an_inverse():
    """Log f = −½ (z₁² + 4 z₂²) + 0.8 z₁² z₂ + 0.3 z₁ z₂²: the last term is no parabola of the second score."""

    def gradient(z):
        one, other = z[..., 0], z[..., 1]
        by_one, by_other = 1.6 * one * other + 0.3 * other**2, 0.8 * one**2 + 0.6 * one * other
        return np.stack([by_one - one, by_other - 4.0 * other], axis=-1)

    found = find_bend(gradient, np.zeros((1, 2)), np.diag([1.0, 4.0])[None], np.ones((1, 2)))
    assert_allclose(found.curvature[0, 1, 0, 0], 0.4)
    curve = Curve(found, np.zeros((5, 1, 2)), np.ones((5, 1, 2)))
    z = np.random.default_rng(1).standard_normal((5, 1, 2))
    assert_allclose(curve.bend(curve.straighten(z)), z, rtol=1e-9, atol=1e-9)
