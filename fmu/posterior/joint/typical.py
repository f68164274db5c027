"""A point in the middle of a hierarchical posterior, whose maximum lies far from its mass."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from fmu.posterior.joint.layout import Layout
from fmu.posterior.joint.varies.population import Drawn
from fmu.posterior.maxima import GaussNewton, ascend
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.scaled import ScaledDensity
from fmu.types import FloatArray, IntArray

_MOST_ROUNDS, _SETTLED = 50, 0.01
_ROUGH = 0.01
_STEP = 1e-4
_MAY_VANISH = 0.1
"""The smallest probable variance of a population, relative to the typical one, if it cannot be zero."""
_LEAST_SD = 1e-3
"""Of a population, relative to the middle of its prior."""


def typical_point(problem: UpdatingProblem) -> tuple[FloatArray, FloatArray]:
    """Return a theta where most of the posterior is, and −∇² log P there, both in scaled coordinates.

    The highest density of a hierarchical posterior says nothing: it depends on the coordinates, and lies where the
    populations are far too wide or far too narrow. Here their means and standard deviations have the most probable
    values after the tests' own values are integrated out, approximately (expectation–maximisation with Gaussian
    values; Dempster, Laird & Rubin 1977, *J. R. Stat. Soc. B* 39, 1–38); everything else is most probable given
    those.

    Parameters
    ----------
    problem : UpdatingProblem
        With a population.

    Returns
    -------
    position : ndarray, shape (ndim,)
    hessian : ndarray, shape (ndim, ndim)
        By Gauss–Newton; by differences of the gradient for means and standard deviations.
    """
    u, _ = _search(problem)
    scaled = ScaledDensity(problem)
    hessian = GaussNewton(problem)(u[None])[2][0]
    for k in problem.layout.scales:
        h = np.zeros(problem.ndim)
        h[k] = _STEP * min(1.0, u[k] - scaled.lower[k], scaled.upper[k] - u[k])
        behind, ahead = scaled.log_prob_and_grad(np.stack([u - h, u + h]))[1]
        hessian[k] = hessian[:, k] = (behind - ahead) / (2.0 * h[k])
    return u, hessian


def centre_scores(problem: UpdatingProblem) -> Layout:
    """Return the layout in which every score refers to what is easiest to sample.

    With the variance C that a test alone leaves to its value, the best weight of the centred form is σ²/(σ² + C)
    where the population has the variance σ². That must hold for the smallest σ that is probable, where a centred
    form has its funnel: σ exp(−2/√(2 Σ w²)), as log σ has the information 2 Σ w² with the weights there.
    If σ may vanish, nothing is centred.

    Parameters
    ----------
    problem : UpdatingProblem
        Its scores are not centred yet.
    """
    u, variance = _search(problem)
    theta = ScaledDensity(problem).to_theta(u)
    weights = {}
    for one in problem.layout.drawn:
        # a standard normal score keeps the variance C/(σ² + C) after the measurement
        w = np.where(one.scored, 1.0 - np.clip(variance[one.columns], 0.0, 1.0), 0.0)
        smallest = np.exp(-4.0 / np.sqrt(2.0 * max(np.sum(w**2), np.finfo(float).tiny)))  # of σ², relative
        if smallest < _MAY_VANISH:
            smallest = 0.0
        reference = (float(theta[one.centre]), float(theta[one.width]))
        weights[one.centre] = smallest * w / (smallest * w + 1.0 - w), reference

    values_of = tuple(one.refer_to(weights) for one in problem.layout.values_of)
    return replace(problem.layout, values_of=values_of)


def _search(problem: UpdatingProblem) -> tuple[FloatArray, FloatArray]:
    """Return the typical point, scaled, and what the tests leave of the scores' variances, (ndim,)."""
    quadratic, scaled = GaussNewton(problem), ScaledDensity(problem)
    held = np.array(problem.layout.scales)
    theta = problem.start.copy()
    variance = np.ones(problem.ndim)
    for _ in range(_MOST_ROUNDS):
        end = ascend(
            lambda u: _holding(quadratic(u), held),
            scaled.to_scaled(theta)[None],
            scaled.lower,
            scaled.upper,
            tolerance=_ROUGH,
        )
        theta = scaled.to_theta(end.position[0])
        variance = _variances(end.hessian[0]) * scaled.scale**2
        moved = [_most_probable(problem, one, theta, variance) for one in problem.layout.drawn]
        if problem.layout.correlation is not None:
            _correlate(problem.layout, theta, variance)
        if max(moved, default=0.0) < _SETTLED:
            break
    return scaled.to_scaled(theta), variance


def _variances(hessian: FloatArray) -> FloatArray:
    """Return the variances of a Gaussian, (ndim,); a direction that nothing informs is as wide as its bounds."""
    try:
        return np.diag(np.linalg.inv(hessian))
    except np.linalg.LinAlgError:
        return np.diag(np.linalg.inv(hessian + np.eye(len(hessian))))


def _holding(
    found: tuple[FloatArray, FloatArray, FloatArray], columns: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return value, gradient and Hessian with some coordinates held."""
    value, gradient, hessian = found
    gradient[:, columns] = 0.0
    hessian[:, columns] = 0.0
    hessian[:, :, columns] = 0.0
    hessian[:, columns, columns] = 1.0
    return value, gradient, hessian


def _correlate(layout: Layout, theta: FloatArray, variance: FloatArray) -> None:
    """Give the populations the correlation that the scores now have, and what the tests leave uncertain in it."""
    correlation: Any = layout.correlation
    found = [one.population_scores(theta[None]) for one in layout.drawn]
    z = np.stack([z[0] for z, _ in found], axis=1)
    left = [
        variance[one.columns] * slopes[0][0] ** 2 for one, (_, slopes) in zip(layout.drawn, found, strict=True)
    ]
    both = correlation.scored.all(axis=1)
    if both.sum() > 1:
        moments = z[both].T @ z[both] + np.diag(np.stack(left, axis=1)[both].sum(axis=0))
        theta[list(correlation.columns)] = correlation.of_scores(moments)


def _most_probable(problem: UpdatingProblem, one: Drawn, theta: FloatArray, variance: FloatArray) -> float:
    """Give a population the centre and width that its values now have; return how far they moved, in widths."""
    columns = one.columns[one.scored]
    value, by_score = one(theta[None])[0][0, one.scored], one(theta[None])[1][0].values[0, one.scored]
    x, spread = (np.log(value), by_score / value) if one.population.of_logarithm else (value, by_score)
    old = theta[[one.centre, one.width]]
    middle = np.mean(x)
    width = np.sqrt(np.var(x) + np.mean(variance[columns] * spread**2))
    width = max(width, _LEAST_SD * problem.start[one.width])
    low, high = problem.lower[one.centre], problem.upper[one.centre]
    margin = 1e-3 * (high - low) if np.isfinite(high - low) else 0.0
    centre = np.exp(middle) if one.population.of_logarithm else middle
    theta[one.centre] = np.clip(centre, low + margin, high - margin)
    theta[one.width] = np.clip(width, problem.lower[one.width], problem.upper[one.width])
    theta[columns] = one.scores_of(value, theta)
    before, after = (np.log(c) if one.population.of_logarithm else c for c in (old[0], theta[one.centre]))
    return float(max(abs(after - before), abs(width - old[1])) / width)
