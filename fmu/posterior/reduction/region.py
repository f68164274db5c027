"""Find the region in which a reduced model must be accurate: most of the prior and the posterior."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fmu.posterior.ascent import GaussNewton
from fmu.posterior.density import Posterior
from fmu.posterior.maxima import local_maxima
from fmu.posterior.parameters import Parameter, box
from fmu.posterior.reduction.tolerance import PLAUSIBLE
from fmu.types import FloatArray

_TRIED = 7  # bisection steps along each direction
# Largest share of the posterior outside a box; range of the log-probability below the highest maximum in which
# maxima are considered; number of draws at each maximum.
_OUTSIDE, _RELEVANT, _DRAWN = 0.02, 10.0, 512
# The box is extended to a bound if the distance to the bound is at most the first value times the width of the
# box, and the log-density of the prior decreases by no more than the second value up to the bound (for a normal
# prior, within six standard deviations).
_NEAR, _NOT_RARE = 0.5, 10.0


def training_box(parameters: Sequence[Parameter]) -> tuple[FloatArray, FloatArray]:
    """Return the lower and upper limits of the box in which a reduced model is first trained, shape (n,) each.

    The prior's box (`fmu.posterior.parameters.box`) is extended to bounds that are near and not much less
    probable. It then also covers the few draws in a hundred thousand that lie outside the prior's box on that
    side.
    """
    ends, bounds = np.array(box(parameters)), np.array([[p.lower, p.upper] for p in parameters]).T
    is_near = np.abs(bounds - ends) <= _NEAR * (ends[1] - ends[0])
    for j, parameter in enumerate(parameters):
        with np.errstate(divide="ignore", invalid="ignore"):  # a log-normal prior has no density at 0
            fall = parameter.prior.log_pdf(ends[:, j]) - parameter.prior.log_pdf(bounds[:, j])
        is_near[:, j] &= fall <= _NOT_RARE
    lower, upper = np.where(is_near, bounds, ends)
    return lower, upper


def plausible_points(problem: Posterior, n: int, rng: np.random.Generator, depth: float = PLAUSIBLE) -> FloatArray:
    """Return points inside the bounds at which the log-probability is within `depth` of its maximum.

    The points lie on rays from every plausible local maximum, in random directions drawn from the Laplace
    approximation. On each ray, the point is where the log-probability has decreased by a random amount, or at the
    bounds.

    Parameters
    ----------
    problem : Posterior
    n : int
        Number of points per maximum.
    rng : Generator
    depth : float
        Largest decrease from the highest maximum's log-probability.

    Returns
    -------
    ndarray, shape (n · m, ndim)
        For the m local maxima that lie within `depth` of the highest one.
    """
    maxima = local_maxima(problem, starts=8)
    points = []
    for maximum in maxima:
        allowed = maximum.log_prob - (maxima[0].log_prob - depth)
        if allowed < 0:
            continue
        direction, curvature = _laplace_directions(problem, maximum.theta, n, rng)
        floor = maximum.log_prob - rng.uniform(0.0, allowed, size=n)
        with np.errstate(divide="ignore", invalid="ignore"):
            walls = (
                np.where(direction > 0, problem.upper - maximum.theta, problem.lower - maximum.theta) / direction
            )
        near, far = np.zeros(n), np.minimum(np.min(np.where(direction == 0, np.inf, walls), axis=1), 100.0)
        # the first step is where the Laplace approximation reaches the floor
        step = np.minimum(np.sqrt(2.0 * (maximum.log_prob - floor) / curvature), far)
        for _ in range(_TRIED):
            above = problem.log_prob(_along(problem, maximum.theta, direction, step)) >= floor
            near, far = np.where(above, step, near), np.where(above, far, step)
            step = 0.5 * (near + far)
        points.append(_along(problem, maximum.theta, direction, near))
    return np.concatenate(points)


def is_narrower(problem: Posterior, trained: FloatArray) -> bool:
    """Return True if the box `trained` (2, n) is narrower than the bounds of its parameters."""
    n = trained.shape[1]
    return not (np.array_equal(trained[0], problem.lower[:n]) and np.array_equal(trained[1], problem.upper[:n]))


def posterior_box(problem: Posterior, trained: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return the limits of a wider box for the posterior, or None if the box `trained` (2, n) is large enough.

    Each limit has the shape (n,). The wider box contains `trained`, draws from the Laplace approximations at the
    highest maximum and at other maxima less than `_RELEVANT` nats lower, and some `plausible_points`. The identity
    is added to each precision matrix in scaled coordinates. `trained` is large enough if at most the share
    `_OUTSIDE` of these draws lies outside it.
    """
    n, rng, quadratic = trained.shape[1], np.random.default_rng(0), GaussNewton(problem)
    maxima = local_maxima(problem, starts=8)
    draws = []
    for maximum in maxima:
        if maximum.log_prob > maxima[0].log_prob - _RELEVANT:
            hessian = quadratic((maximum.theta[None] - problem.offset) / problem.scale)[2][0]
            root = np.linalg.cholesky(hessian + np.eye(problem.ndim))
            z = np.linalg.solve(root.T, rng.standard_normal((problem.ndim, _DRAWN))).T * problem.scale
            draws.append(np.clip(maximum.theta + z, problem.lower, problem.upper)[:, :n])
    theta = np.concatenate(draws)
    is_outside = np.any((theta < trained[0]) | (theta > trained[1]), axis=1)
    if np.mean(is_outside) <= _OUTSIDE:
        return None
    theta = np.concatenate([theta, trained, plausible_points(problem, 64, rng)[:, :n]])
    return theta.min(axis=0), theta.max(axis=0)


def _along(problem: Posterior, origin: FloatArray, direction: FloatArray, step: FloatArray) -> FloatArray:
    return np.clip(origin + step[:, None] * direction, problem.lower, problem.upper)


def _laplace_directions(
    problem: Posterior, theta: FloatArray, n: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return random directions (n, ndim) and the curvature of −log P along each direction, (n,).

    The directions have the covariance of the Gauss–Newton approximation. The prior's precision is taken to be the
    identity in scaled coordinates. Where theta is at a bound, the directions point inwards.
    """
    information = problem.quadratic(theta[None])[2][0]
    precision = information * np.outer(problem.scale, problem.scale) + np.eye(problem.ndim)
    z = np.linalg.solve(np.linalg.cholesky(precision).T, rng.standard_normal((problem.ndim, n))).T
    z = np.where(theta <= problem.lower, np.abs(z), np.where(theta >= problem.upper, -np.abs(z), z))
    return z * problem.scale, np.einsum("ni,ij,nj->n", z, precision, z)
