"""Modes that cross or veer: their mean and the square of their distance are learnt, and give both back."""

from functools import cache

import numpy as np
import pytest

from fmu.fem.pairing.modal_model import ModalModel
from fmu.fem.surrogate.close_pairs import ClosePairs
from fmu.fem.surrogate.coordinates import Coordinates
from fmu.fem.surrogate.surrogate_model import Design, SurrogateModel
from tests.gradients import assert_gradient, differences

LOWER, UPPER = np.array([0.5, 0.5]), np.array([2.0, 2.0])


class Crossing(ModalModel):
    """Two modes of squared frequencies k1 and k2 with a weak coupling, and one far above, by number."""

    n_parameters, n_modes, by_shape, name = 2, 3, False, "crossing"

    def __init__(self, coupling):
        self.coupling = coupling

    def configuration(self):
        return self.coupling

    def frequencies(self, theta):
        middle, half = theta.mean(axis=1), 0.5 * (theta[:, 0] - theta[:, 1])
        root = np.sqrt(half**2 + self.coupling**2)
        return np.sqrt(np.stack([middle - root, middle + root, 20.0 + theta[:, 0]], axis=1))


@cache
def surrogate(coupling, by_shape=False, n=30):
    """Return a surrogate, and the model that it has learnt; its modes are followed `by_shape`, or have numbers."""
    truth = Crossing(coupling)
    truth.by_shape = by_shape
    theta = np.random.default_rng(1).uniform(LOWER, UPPER, (n, 2))
    design = Design(theta, truth.frequencies(theta), np.empty((n, 0, 3)))
    return SurrogateModel(truth, design, Coordinates.of_box(LOWER, UPPER, np.array([True, True]))), truth


def error_of(model, truth, theta):
    """Return the root-mean-square error of the frequencies of both modes."""
    return np.sqrt(np.mean((model.frequencies(theta) - truth.frequencies(theta))[:, :2] ** 2))


@pytest.mark.parametrize("coupling", [0.0, 0.05])
def test_both_modes_are_right_on_either_side_and_between(coupling):
    model, truth = surrogate(coupling)
    assert model.pairs.first == (0,)
    theta = np.random.default_rng(2).uniform(0.6, 1.8, (300, 2))
    assert error_of(model, truth, theta) < 1e-3
    assert np.array_equal(model.frequencies(theta), model.observed(theta).frequencies)


def test_modes_that_are_followed_are_no_pairs_and_learnt_less_well():
    (model, truth), (plain, _) = surrogate(0.05), surrogate(0.05, by_shape=True)
    assert plain.pairs.first == ()
    theta = np.random.default_rng(2).uniform(0.6, 1.8, (300, 2))
    assert error_of(model, truth, theta) < 0.1 * error_of(plain, truth, theta)


def test_derivatives_are_those_of_frequencies_and_variances():
    """Variances end in rounding, which long steps do not show."""
    model, _ = surrogate(0.05)
    theta, h = np.array([[1.0, 1.13], [1.2, 0.9], [0.8, 1.5]]), 1e-3
    seen = model.observed(theta, gradient=True)
    assert_gradient(seen.frequency_slopes, model.frequencies, theta, h, rtol=1e-3, atol=2e-4)
    slopes = differences(lambda theta: model.observed(theta).frequency_variance, theta, h)
    largest = np.abs(slopes).max(axis=(0, 1))
    np.testing.assert_allclose(seen.frequency_variance_slopes / largest, slopes / largest, atol=0.02)


def test_where_the_distance_is_uncertain_both_are_finite_and_in_order():
    pairs = ClosePairs((0,))
    y = np.array([[1.0, d] for d in (-1.0, -1e-6, 0.0, 1e-30, 1e-6, 1.0)])
    for v in (0.0, 1e-12, 1e-3):
        z, variance = pairs.values(y, np.full_like(y, v))
        assert np.all(np.isfinite(z))
        assert np.all(np.isfinite(variance))
        assert np.all(z[:, 0] <= z[:, 1])
        dz, dv = pairs.slopes(y, np.full_like(y, v), np.ones((6, 2, 1)), np.ones((6, 2, 1)))
        assert np.all(np.isfinite(dz))
        assert np.all(np.isfinite(dv))
    np.testing.assert_allclose(pairs.values(y[-1:], np.full((1, 2), 1e-20))[0], [[0.0, 2.0]])


def test_weights_are_those_of_the_variances():
    rng = np.random.default_rng(3)
    pairs, y, v = ClosePairs((1,)), rng.uniform(0.5, 1.0, (4, 3)), rng.uniform(0.0, 0.01, (4, 3))
    by_z = rng.uniform(size=(4, 3))
    of_learnt = pairs.weights(y, v, by_z)
    np.testing.assert_allclose(np.sum(of_learnt * v, axis=1), np.sum(by_z * pairs.values(y, v)[1], axis=1))


def test_only_modes_that_stay_in_order_and_come_close_are_pairs():
    z = np.array([[0.0, 1.0, 2.0, 3.0], [0.0, 1.0, 1.01, 3.0], [0.0, 0.9, 2.0, 2.05]])
    assert ClosePairs.of(z).first == (1,)  # the next pair shares a mode with it, and comes less close
    assert ClosePairs.of(z[:, [0, 2, 1, 3]]).first == ()  # not by number: each is followed
    assert ClosePairs.of(np.array([[0.0, 1.0], [0.0, 0.8]])).first == ()
