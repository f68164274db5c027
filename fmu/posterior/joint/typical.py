"""Find a typical point of a hierarchical posterior, because its maximum lies far from most of the probability."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from fmu.posterior.ascent import GaussNewton
from fmu.posterior.joint.blocks import BlockForm
from fmu.posterior.joint.conditional.dates import undated_events
from fmu.posterior.joint.conditional.expansion import expand, likelihood_of_tests
from fmu.posterior.joint.conditional.scores import Scores, ScoresGivenMain
from fmu.posterior.joint.layout import Layout
from fmu.posterior.joint.varies.drawn import Drawn
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.scaled import ScaledDensity
from fmu.types import FloatArray

_MOST_ROUNDS, _SETTLED = 50, 0.01
_ROUGH = 0.01
_STEP = 1e-4
_MAY_VANISH = 0.1
"""A population may have zero variance if its smallest probable variance is below this share of the typical one."""
_LEAST_SD = 1e-3
"""Smallest standard deviation of a population in the search, relative to its start value."""


def typical_point(problem: UpdatingProblem) -> FloatArray:
    """Return a point in the bulk of a hierarchical posterior, in scaled coordinates, shape (ndim,).

    The maximum of a hierarchical posterior density is not meaningful: it depends on the coordinates, and lies
    where the populations are far too wide or too narrow. At the typical point, the populations' means, standard
    deviations (within groups) and correlations approximately maximise the likelihood after each test's own values
    are integrated out (expectation–maximisation with Gaussian values; Dempster, Laird & Rubin 1977, *J. R. Stat.
    Soc. B* 39, 1–38). Of the priors of these parameters, only the bounds are used. All other parameters have their
    most probable values given these, but correlation times and the share of outliers keep their starting values.
    A model discrepancy is left out, and its inferred parameters keep their starting values, too.

    Parameters
    ----------
    problem : UpdatingProblem
        A problem with at least one population.
    """
    plain, likelihood = problem.with_layout(problem.layout.remove_centring()), problem.likelihood
    if likelihood.has_discrepancy:  # couples the tests
        plain = plain.with_likelihood(likelihood.easier()[0])
    theta = problem.layout.restore_scores(_search(plain)[0][None])[0]
    if likelihood.has_discrepancy:  # without it, the sizes of the model's errors have no effect
        sizes = {d for term in likelihood.terms_of for d in term.spread.sizes}
        others = problem.n_structural + np.setdiff1d(np.arange(len(likelihood.noise)), list(sizes))
        theta[others] = problem.start[others]
    return ScaledDensity(problem).to_scaled(theta)


def curvature_at(problem: UpdatingProblem, u: FloatArray) -> FloatArray:
    """Return an approximation of −∇² log P at a point u (ndim,) in scaled coordinates, shape (ndim, ndim).

    It is the Gauss–Newton Hessian, except that rows and columns for the parameters of the populations and of the
    score density (`Layout.scales`) are finite differences of the gradient. If such a parameter is at a bound, its
    row and column are NaN.
    """
    scaled = ScaledDensity(problem)
    hessian = GaussNewton(problem)(u[None])[2][0]
    for k in problem.layout.scales:
        h = np.zeros(problem.ndim)
        h[k] = _STEP * min(1.0, u[k] - scaled.lower[k], scaled.upper[k] - u[k])
        behind, ahead = scaled.log_prob_and_grad(np.stack([u - h, u + h]))[1]
        hessian[k] = hessian[:, k] = (behind - ahead) / (2.0 * h[k])
    return hessian


def centre_scores(problem: UpdatingProblem) -> Layout:
    """Return the layout in which the scores are centred so that the posterior is easiest to sample.

    Let C be a value's variance given its own test alone, and σ² the population's variance. The best weight for the
    centred form is then w = σ²/(σ² + C). The weight has to suit the smallest probable σ, because a centred form
    has a funnel at small σ. As the information on log σ is 2 Σ w², the smallest probable σ is taken as the
    estimated σ times exp(−2/√(2 Σ w²)). The scores of a population whose σ may be zero are not centred.

    Parameters
    ----------
    problem : UpdatingProblem
        A problem whose scores are not centred yet.
    """
    theta, variance = _search(problem)
    weights = {}
    for one in problem.layout.drawn:
        # a standard normal score keeps the variance C/(σ² + C) after the measurement
        w = np.where(one.scored, 1.0 - np.clip(variance[one.columns], 0.0, 1.0), 0.0)
        total = np.array([np.sum(w[one.widths == k] ** 2) for k in one.widths])
        smallest = np.exp(-4.0 / np.sqrt(2.0 * np.maximum(total, np.finfo(float).tiny)))  # relative to σ²
        smallest = np.where(smallest < _MAY_VANISH, 0.0, smallest)
        reference = (float(theta[one.centre]), theta[one.widths])
        weights[one.centre] = smallest * w / (smallest * w + 1.0 - w), reference

    values_of = tuple(one.refer_to(weights) for one in problem.layout.values_of)
    return replace(problem.layout, values_of=values_of)


def _search(problem: UpdatingProblem) -> tuple[FloatArray, FloatArray]:
    """Return the typical point (ndim,) of a problem without centring, and the score variances around it.

    The variances, shape (ndim,), hold for fixed population means, standard deviations and correlations. They are
    zero for parameters other than scores.
    """
    layout, scores = problem.layout, Scores.of(problem.layout)
    held = np.union1d(scores.columns[scores.scored], layout.scales).astype(np.int64)
    form = BlockForm(problem, np.setdiff1d(np.arange(problem.ndim), held))
    theta, variance = problem.start.copy(), np.zeros(problem.ndim)
    dates = [event.date for event in undated_events(layout, problem.parameters, theta)]
    for _ in range(_MOST_ROUNDS):
        theta, hessian = form.climb(theta, _ROUGH)
        columns = scores.columns[scores.scored]
        variance[columns] = hessian.score_variances()[scores.scored] * form.scaled.scale[columns] ** 2
        kappa = _weights(layout, theta)
        moved = [
            _most_probable(problem, one, theta, variance, weights)
            for one, weights in zip(layout.drawn, kappa, strict=True)
        ]
        if layout.correlation is not None:
            _correlate(layout, theta, variance)
        if max(moved, default=0.0) < _SETTLED:
            dated = _date_events(problem, theta) if dates else theta
            if np.array_equal(dated[dates], theta[dates]):
                break
            theta = dated
    return theta, variance


def _date_events(problem: UpdatingProblem, theta: FloatArray) -> FloatArray:
    """Return theta (ndim,) with the most probable dates and losses of sudden events."""
    given = ScoresGivenMain(problem.layout, expand(problem.layout, likelihood_of_tests(problem), theta))
    found = theta[None]
    for event in undated_events(problem.layout, problem.parameters, theta):
        found = event.likeliest(given, found)
    return found[0]


def _weights(layout: Layout, theta: FloatArray) -> FloatArray:
    """Return each test's weight in each population, shape (p, n_tests): 1, or less for probable outliers."""
    z = np.stack([one.population_scores(theta[None])[0] for one in layout.drawn], axis=2)
    return np.ones(z.shape[:0:-1]) if layout.outliers is None else layout.outliers.weights(theta[None], z)[0].T


def _correlate(layout: Layout, theta: FloatArray, variance: FloatArray) -> None:
    """Set the populations' partial correlations in `theta` to estimates from the scores' second moments.

    The moments include the scores' variances, which are in `variance` (ndim,). The estimates do not use the prior
    of the correlations, and are clipped to ±0.95. Only tests with a score in every population are used. If there
    are fewer than two of them, `theta` is not changed.
    """
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


def _most_probable(
    problem: UpdatingProblem, one: Drawn, theta: FloatArray, variance: FloatArray, of_tests: FloatArray
) -> float:
    """Set a population's centre and widths in `theta` to the most likely ones, given the values in the tests.

    Of the priors of the centre and the widths, only the bounds are used. The scores in `theta` are changed so that
    the values in the tests stay the same. `of_tests`, shape (n_tests,), contains the weights of the tests. Return
    the largest change of the centre or a width, relative to the new width.
    """
    columns, widths, before = one.columns[one.scored], one.widths[one.scored], theta[None].copy()
    value, by_score = one(theta[None])[0][0, one.scored], one(theta[None])[1][0].values[0, one.scored]
    x, spread = (np.log(value), by_score / value) if one.family.of_logarithm else (value, by_score)
    of_tests = of_tests[one.scored]
    last, weights = theta[one.centre], of_tests * (theta[widths[0]] / theta[widths]) ** 2
    middle = np.sum(weights * x) / np.sum(weights)
    centre = np.exp(middle) if one.family.of_logarithm else middle
    theta[one.centre] = _clip_inside(centre, problem.lower[one.centre], problem.upper[one.centre])
    last, new = (np.log(c) if one.family.of_logarithm else c for c in (last, theta[one.centre]))
    changes = []
    for k in np.unique(widths):
        here = widths == k
        squares = (x - middle)[here] ** 2, (variance[columns] * spread**2)[here]
        width = np.sqrt(sum(np.mean(of_tests[here] * square) for square in squares))
        width = max(width, _LEAST_SD * problem.start[k])
        width = _clip_inside(width, problem.lower[k], problem.upper[k], extent=max(width, problem.lower[k]))
        changes.append(float(max(abs(new - last), abs(width - theta[k])) / width))
        theta[k] = width
    theta[columns] = one.scores_at(one(before)[0], theta[None])[0, one.scored]
    return max(changes)


def _clip_inside(x: float, low: float, high: float, extent: float = np.inf) -> float:
    """Return x clipped to the bounds or, if both bounds are finite, to values at least a margin inside them.

    The margin is a thousandth of the distance between the bounds or, if less, a thousandth of `extent`.
    """
    margin = 1e-3 * min(high - low, extent) if np.isfinite(high - low) else 0.0
    return float(np.clip(x, low + margin, high - margin))
