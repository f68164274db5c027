"""The Gauss–Newton ascent on quadratics whose maximum inside a box is known, and on what hinders it."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import lsq_linear

from fmu.posterior.ascent import Ascent, GaussNewton, ascend, decrement, is_close
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.maxima import leaders
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal
from fmu.posterior.problem import UpdatingProblem
from tests.gradients import differences


def quadratic(J, b):
    """V = |Ju − b|²/2, with its exact Hessian."""

    def V(u):
        r = u @ J.T - b
        return 0.5 * np.sum(r**2, axis=1), r @ J, np.broadcast_to(J.T @ J, (len(u), J.shape[1], J.shape[1])).copy()

    return V


@pytest.mark.parametrize("seed", range(8))
def test_least_squares_in_a_box(seed):
    """Ill-conditioned, its unconstrained minimum outside: SciPy's active-set solver gives the truth."""
    rng = np.random.default_rng(seed)
    J = rng.standard_normal((6, 4)) @ np.diag([30.0, 5.0, 1.0, 0.3])
    b = J @ rng.uniform(-1.0, 2.0, 4) + rng.standard_normal(6)
    truth = lsq_linear(J, b, (0.0, 1.0), method="bvls", tol=1e-14).x
    assert np.any((truth == 0.0) | (truth == 1.0))
    ends = ascend(quadratic(J, b), rng.uniform(size=(40, 4)), np.zeros(4), np.ones(4), tolerance=1e-14)
    assert ends.stationary.all()
    assert ends.steps < 40
    assert_allclose(ends.position, np.broadcast_to(truth, (40, 4)), atol=1e-5)


def test_a_direction_that_nothing_determines_stops_nobody():
    J, b = np.array([[1.0, 1.0]]), np.array([0.8])
    ends = ascend(quadratic(J, b), np.array([[0.0, 0.0], [1.0, 1.0]]), np.zeros(2), np.ones(2))
    assert ends.stationary.all()
    assert_allclose(ends.position.sum(axis=1), 0.8, atol=1e-4)


def test_ascents_that_join_another_one_find_the_same_with_fewer_steps():
    """A curved valley, and its mirror image beyond a ridge."""
    count = []

    def V(u):
        count.append(len(u))
        x, y = u.T
        r = np.stack([5.0 * (y - x**2), x**2 - 1.0], axis=1)
        rows = [-10.0 * x, np.full_like(x, 5.0)], [2.0 * x, 0.0 * x]
        J = np.moveaxis(np.array(rows), 2, 0)
        return 0.5 * np.sum(r**2, axis=1), np.einsum("nij,ni->nj", J, r), np.einsum("nij,nik->njk", J, J)

    points = np.random.default_rng(1).uniform(-3.0, 3.0, (60, 2))
    found, evaluations = [], []
    for join in (False, True):
        count.clear()
        ends = ascend(V, points, np.full(2, -3.0), np.full(2, 3.0), tolerance=1e-4, join=join)
        found.append(leaders(ends))
        evaluations.append(sum(count))
    assert evaluations[1] < 0.9 * evaluations[0]
    assert not ends.stationary.all()
    for position, starts in found:
        order = np.argsort(position[:, 0])
        assert_allclose(position[order], [[-1.0, 1.0], [1.0, 1.0]], atol=0.05)
        assert_array_equal(starts[order], found[0][1][np.argsort(found[0][0][:, 0])])


def test_a_point_far_below_is_not_close():
    """An ascent that passes a saddle on its way to a maximum does not end there."""
    u, V = np.array([[0.1], [0.1], [0.1]]), np.array([-50.0, 0.1, 0.6])
    assert_array_equal(is_close(u, V, np.zeros(1), 0.0, np.eye(1), 0.5), [False, True, False])


def test_a_start_without_a_value_stays_and_is_not_stationary():
    def V(u):
        value, g, H = quadratic(np.eye(2), np.full(2, 0.5))(u)
        return np.where(u[:, 0] > 0.9, np.inf, value), g, H

    ends = ascend(V, np.array([[0.95, 0.1], [0.1, 0.1]]), np.zeros(2), np.ones(2))
    assert_array_equal(ends.stationary, [False, True])
    assert_array_equal(ends.position[0], [0.95, 0.1])
    assert_allclose(ends.position[1], 0.5, atol=1e-4)


def test_a_step_that_promises_nothing_is_taken_if_it_helps():
    """The ratio of the decrease to the predicted one overflows."""

    def V(u):
        n = len(u)
        return np.where(u[:, 0] == 0.0, 1e3, 0.0), np.full((n, 1), 1e-9), np.full((n, 1, 1), 1e300)

    end = ascend(V, np.zeros((1, 1)), -np.ones(1), np.ones(1), tolerance=0.0, max_steps=1)
    assert end.value[0] == 0.0


@pytest.mark.parametrize("most", [0, 1, 2, 100])
def test_steps_are_limited_and_counted(most):
    """One evaluation at the start, and one in each step."""
    V, calls = quadratic(np.eye(2), np.full(2, 0.5)), []

    def counted(u):
        calls.append(len(u))
        return V(u)

    ends = ascend(counted, np.zeros((1, 2)), np.zeros(2), np.ones(2), max_steps=most)
    assert ends.stationary.all() == (most >= 2)  # the decrement is 1e-10 after the second step
    assert len(calls) == 1 + ends.steps
    assert (ends.steps == most) == (most < 100)


def test_decrement_ignores_the_pressed_coordinates_alone():
    u, g, H = np.array([[0.0, 0.5], [0.5, 0.5]]), np.array([[3.0, 2.0]] * 2), np.array([np.diag([1.0, 4.0])] * 2)
    # the first point is pressed against the wall at u₀ = 0
    assert_allclose(decrement(u, g, H, np.zeros(2), np.ones(2)), [0.5, 5.0])


def test_problem_as_least_squares(chain):
    """V is −log P up to a constant; slope and Gauss–Newton curvature as differences have them."""
    parameters = [
        Parameter("k0", 1.0, 0.1, 4.0, prior=Normal(0.5, mean=1.0)),
        Parameter("k1", 1.0, 0.1, 4.0),
    ]
    problem = UpdatingProblem.reduced(
        chain, ModalData([0.1, 0.2]), parameters, pairing="index", beta=[300.0, 100.0]
    )
    V = GaussNewton(problem)
    u = np.array([[0.3, 0.4], [0.8, 0.1]])
    value, gradient, hessian = V(u)
    theta = problem.offset + problem.scale * u
    log_prob = problem.log_prob(theta)
    assert value[0] - value[1] == pytest.approx(log_prob[1] - log_prob[0], rel=1e-10)
    assert_allclose(gradient, -problem.log_prob_and_grad(theta)[1] * problem.scale, rtol=1e-10)
    J = differences(problem.frequencies, theta, 1e-5) * problem.scale * np.sqrt([[[600.0], [200.0]]])
    expected = np.einsum("nmk,nml->nkl", J, J) + np.diag([problem.scale[0] ** 2 / 0.25, 0.0])
    assert_allclose(hessian, expected, rtol=1e-5, atol=1e-6)


def test_ends_near_one_summit_have_one_leader_and_failed_ones_none():
    """Near by the curvature of the highest: along its flat direction a long way, across it a short one."""
    steep = np.diag([1e4, 1.0])
    position = np.array([[0.5, 0.5], [0.5, 1.4], [0.53, 0.5], [0.5, 1.6], [0.1, 0.1]])
    value = np.array([1.0, 1.1, 1.2, 1.3, np.inf])
    found, starts = leaders(Ascent(position, value, np.stack([steep] * 5), np.ones(5, dtype=bool), 1))
    assert_array_equal(found, position[[0, 2, 3]])
    assert_array_equal(starts, [2, 1, 1])
    lower = value + np.array([0.0, 0.6, 0.0, 0.0, 0.0])  # as close, but no longer as high
    _, starts = leaders(Ascent(position, lower, np.stack([steep] * 5), np.ones(5, dtype=bool), 1))
    assert_array_equal(starts, [1, 1, 2])
    nothing, _ = leaders(Ascent(position, np.full(5, np.inf), np.stack([steep] * 5), np.ones(5, dtype=bool), 1))
    assert nothing.shape == (0, 2)
