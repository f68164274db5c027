"""The exact gradient of the log-probability against differences."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors.base import Normal, Uniform
from fmu.posterior.problem import UpdatingProblem
from tests.gradients import assert_gradient

# Big against the eigensolver's rounding (1e-9 of the lowest frequency), small against the box.
STEP = 0.01


def stencil(problem, theta):
    """Return theta shifted by k steps of the box in each coordinate, shape (ndim, 6, ndim)."""
    steps = np.array([1, 2, 3, -1, -2, -3]) * STEP
    return theta + np.eye(problem.ndim)[:, None, :] * steps[None, :, None] * problem.scale


def smooth_points(problem, n, seed):
    """Return points around which no paired mode changes its block or its rank."""
    rng = np.random.default_rng(seed)
    points = []
    while len(points) < n:
        theta = problem.lower + problem.scale * rng.uniform(3.1 * STEP, 1 - 3.1 * STEP, size=problem.ndim)
        modes = problem.model.modes(np.vstack([theta[None], *stencil(problem, theta)]))
        if np.all(modes.block == modes.block[0]) and np.all(modes.rank == modes.rank[0]):
            points.append(theta)
    return np.array(points)


@pytest.mark.parametrize("pairing", ["shape", "index"])
@pytest.mark.parametrize("case", ["cantilever-young", "cantilever-section"])
def test_gradient_of_the_cases(load_case, case, pairing):
    problem = load_case(case, pairing)
    theta = smooth_points(problem, 6, seed=2)
    _, gradient = problem.log_prob_and_grad(theta)
    assert_gradient(gradient, problem.log_prob, theta, STEP * problem.scale, order=6, of_largest=1e-6)


def test_gradient_by_number_belongs_to_the_modes_that_are_there(load_case):
    """On the two sides of a crossing the same number is another mode, with another slope."""
    problem = load_case("cantilever-section", "index")
    a, b = np.array([5.5e-9, 5.4e-9, 6.9e-4, 7.1e-4]), np.array([6.9e-9, 7.2e-9, 8.9e-4, 8.9e-4])
    low, high = 0.0, 1.0
    block = problem.model.modes(np.array([a, b])).block
    column = int(np.flatnonzero(block[0] != block[1])[0])
    for _ in range(40):
        middle = 0.5 * (low + high)
        same = problem.model.modes((a + middle * (b - a))[None]).block[0, column] == block[0, column]
        low, high = (middle, high) if same else (low, middle)
    sides = np.array([a + t * (b - a) for t in (low - 1e-6, high + 1e-6)])
    frequencies, slopes = problem.model.frequencies_and_gradient(sides)
    assert_allclose(frequencies[0, column], frequencies[1, column], rtol=1e-5)
    along = slopes[:, column] @ (b - a)
    assert abs(along[0] - along[1]) > 0.05 * abs(along).max()
    for side, exact in zip((low - 2e-3, high + 2e-3), along, strict=True):
        h = 1e-3
        around = problem.frequencies([a + (side + s * h) * (b - a) for s in (1, -1)])[:, column]
        assert (around[0] - around[1]) / (2 * h) == pytest.approx(exact, rel=0.02)


def test_gradient_on_the_bounds_is_the_one_from_inside(load_case):
    problem = load_case("cantilever-young", "shape")
    corner = np.where([True, False, True, False, True], problem.lower, problem.upper)
    _, gradient = problem.log_prob_and_grad(corner)
    inward = np.where(corner == problem.lower, 1.0, -1.0) * problem.scale
    for j in range(problem.ndim):
        step = np.zeros(problem.ndim)
        step[j] = 1e-3 * inward[j]
        f0, f1, f2 = problem.log_prob([corner, corner + step, corner + 2 * step])
        assert (4 * f1 - 3 * f0 - f2) / 2e-3 == pytest.approx(gradient[j] * inward[j], rel=1e-3, abs=1e-2)


def test_value_beside_the_gradient_is_the_log_probability(load_case):
    for case in ("cantilever-young", "cantilever-section"):
        for pairing in ("shape", "index"):
            problem = load_case(case, pairing)
            theta = problem.sample_prior(np.random.default_rng(1), 5)
            values, gradients = problem.log_prob_and_grad(theta)
            assert_allclose(values, problem.log_prob(theta), rtol=1e-6)
            single_value, single_gradient = problem.log_prob_and_grad(theta[2])
            assert_allclose(single_value, values[2], rtol=1e-12)
            assert_allclose(single_gradient, gradients[2], rtol=1e-9)


@pytest.mark.parametrize("reduction", [True, False])
@pytest.mark.parametrize("beta", [3.0, [1.0, 50.0]])
def test_gradient_with_priors_and_vector_beta(chain, beta, reduction):
    parameters = [
        Parameter("a", 2.0, 1.0, 4.0, prior=Normal(0.2, mean=1.7)),
        Parameter("b", 1.5, 0.5, 3.0, prior=Uniform()),
    ]
    problem = UpdatingProblem.reduced(
        chain, ModalData([0.1, 0.4], numbers=(1, 3)), parameters, pairing="index", beta=beta, reduction=reduction
    )
    theta = np.array([[1.2, 0.8], [3.1, 2.0], [2.0, 2.9]])
    gradient, step = problem.log_prob_and_grad(theta)[1], STEP * problem.scale
    assert_gradient(gradient, problem.log_prob, theta, step, order=6, rtol=1e-7, of_largest=1e-7)
