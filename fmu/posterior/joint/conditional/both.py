"""The conditional densities of a hierarchical problem, which Gibbs steps alternate between."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from fmu.box import find_inside
from fmu.posterior.joint.conditional.bend import find_bend
from fmu.posterior.joint.conditional.expansion import OfTests, expand
from fmu.posterior.joint.conditional.main import MainGivenValues
from fmu.posterior.joint.conditional.scores import ScoresGivenMain
from fmu.posterior.joint.conditional.shift import MainGivenScores
from fmu.posterior.joint.typical import typical_point
from fmu.posterior.priors.joint import JointPrior
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.scaled import ScaledDensity
from fmu.types import FloatArray

_STEP = 1e-4
_INFORMED = 0.5
_HALVINGS = 30
_BENT = 0.1
"""Smallest coefficient of a parabola that is taken into account."""
_SCORES = 400
"""Number of draws of the scores of a test over which second derivatives are averaged."""


class Conditionals(NamedTuple):
    """The conditional densities of a hierarchical problem, in which all scores are standard normal a priori.

    Attributes
    ----------
    scores : ScoresGivenMain
    main : MainGivenValues
    shift : MainGivenScores
    curvatures : tuple of two ndarray
        Minus the second derivatives of `main` and `shift` at the typical point, by their coordinates.
    noise : ndarray, shape (n_noise,)
        Relative standard deviations of the inferred standard deviations of errors; at most one.
    noise_prior : JointPrior
        Prior of these standard deviations.
    is_enough : bool
        Whether steps by `scores` and `main` alone reach all parameters but these deviations, and mix well.
    typical : ndarray, shape (1, ndim)
        The typical point, with standard normal scores.
    """

    scores: ScoresGivenMain
    main: MainGivenValues
    shift: MainGivenScores
    curvatures: tuple[FloatArray, FloatArray]
    noise: FloatArray
    noise_prior: JointPrior
    is_enough: bool
    typical: FloatArray


_KNOWN: WeakKeyDictionary[UpdatingProblem, Conditionals] = WeakKeyDictionary()


def conditionals(problem: UpdatingProblem) -> Conditionals:
    """Return the conditional densities of a problem with populations; they are computed once per problem."""
    if problem not in _KNOWN:
        _KNOWN[problem] = _compute(problem)
    return _KNOWN[problem]


def scatter_about_typical(
    problem: UpdatingProblem, rng: np.random.Generator, n: int, dispersion: float
) -> FloatArray:
    """Return `n` points about the typical point of a hierarchical posterior, (n, ndim), with finite densities.

    The main parameters scatter by what both of their conditional densities leave open, the scores by theirs, all
    of this times `dispersion`. A point outside the bounds or without a finite density is moved halfway to the
    typical point until it is inside.
    """
    known = conditionals(problem)
    centre = np.repeat(known.typical, n, axis=0)
    values, noises = known.main.values(centre), [rng.standard_normal((n, len(one))) for one in known.curvatures]
    steps = [
        dispersion * noise @ np.linalg.cholesky(np.linalg.inv(curvature)).T
        for noise, curvature in zip(noises, known.curvatures, strict=True)
    ]
    of_scores = rng.standard_normal((n, *known.scores.scores.scored.shape))
    of_noise = dispersion * known.noise * rng.standard_normal((n, len(known.noise)))
    share, found = np.ones((n, 1)), problem.layout.restore_scores(centre)
    left = np.arange(n)
    for _ in range(_HALVINGS):
        w = known.main.coordinates(centre[left], values[left]) + share[left] * steps[0][left]
        theta = known.main.theta_at(w, centre[left], values[left])
        low, high = known.shift.lower, known.shift.upper
        w = known.shift.coordinates(theta) + share[left] * steps[1][left]
        w = np.where(w < low, 2.0 * low - w, np.where(w > high, 2.0 * high - w, w))  # reflected at the bounds
        theta = known.shift.theta_at(w, theta)
        theta[:, problem.n_structural :] *= np.exp(share[left] * of_noise[left])
        inside = find_inside(theta, problem.lower, problem.upper)[0] & np.all((w > low) & (w < high), axis=1)
        theta[~inside] = centre[left][~inside]
        normal = known.scores.approximate(theta)
        z = normal.bend(normal.mean + normal.scatter(share[left, :, None] * dispersion * of_scores[left]))
        theta = problem.layout.restore_scores(known.scores.scores.put(theta, z))
        good = inside & np.isfinite(problem.log_prob(theta))
        found[left[good]] = theta[good]
        share[left] *= 0.5
        left = left[~good]
        if not len(left):
            break
    return found


def _compute(problem: UpdatingProblem) -> Conditionals:
    assert isinstance(problem.likelihood, OfTests)  # of several tests
    plain = problem.with_layout(problem.layout.remove_centring())
    own = ScaledDensity(problem).to_theta(typical_point(problem))[None]
    theta = problem.layout.standardise_scores(own)
    expansion = expand(plain.layout, problem.likelihood, theta[0])
    scores, main = _bend(ScoresGivenMain(plain.layout, expansion), plain, theta), MainGivenValues(plain)
    shift = MainGivenScores(plain, expansion)
    normal, n = scores.approximate(theta), int(np.ceil(_SCORES / len(problem.tests)))
    noise = np.random.default_rng(0).standard_normal((n, *normal.mean.shape[1:]))
    typical = scores.scores.put(np.repeat(theta, n, axis=0), normal.bend(normal.mean + normal.scatter(noise)))
    values = main.values(typical)
    curvatures = (
        _curvature(
            lambda w: main.log_prob_and_grad(w, typical, values)[1],
            main.coordinates(typical, values),
            main.lower,
            main.upper,
        ),
        _curvature(
            lambda w: shift.log_prob_and_grad(w, typical)[1], shift.coordinates(typical), shift.lower, shift.upper
        ),
    )
    is_enough = main.others == 0 and scores.least_information(theta) > _INFORMED
    s = theta[:, problem.n_structural :]
    found = sum((term.information(s)[0] for term in problem.likelihood.terms_of), np.zeros((s.size, s.size)))
    noise = 1.0 / np.sqrt(1.0 + np.diag(found) * s[0] ** 2)
    noise_prior = JointPrior(problem.parameters[problem.n_structural :])
    return Conditionals(scores, main, shift, curvatures, noise, noise_prior, is_enough, theta)


def _bend(straight: ScoresGivenMain, plain: UpdatingProblem, theta: FloatArray) -> ScoresGivenMain:
    """Return the density of the scores with bent approximations, if some are bent noticeably."""

    def gradient(z: FloatArray) -> FloatArray:
        slopes = plain.log_prob_and_grad(straight.scores.put(np.repeat(theta, len(z), axis=0), z))[1]
        return straight.scores.take(slopes)

    normal = straight.approximate(theta)
    precision = normal.factor[0] @ np.swapaxes(normal.factor[0], 1, 2)
    at = straight.scores.put(theta, normal.mean)[:, : len(plain.layout.parameters)]
    slopes = np.stack([one.slope(at)[0] for one in straight.scores.every], axis=1)
    found = find_bend(gradient, normal.mean[0], precision, np.where(normal.scored, slopes, 1.0))
    is_bent = np.all(np.isfinite(found.curvature)) and np.max(np.abs(found.curvature)) > _BENT
    return ScoresGivenMain(straight.layout, straight.expansion, found) if is_bent else straight


def _curvature(
    gradient: Callable[[FloatArray], FloatArray], w: FloatArray, lower: FloatArray, upper: FloatArray
) -> FloatArray:
    """Return minus the second derivatives of a log-density of w by differences of its `gradient`, (d, d).

    They are averaged over the points w, shape (n, d). The curvature of a normal distribution with the standard
    deviation of the uniform distribution between the bounds is added, so that the inverse is finite in a direction
    about which neither the data nor the prior say anything.
    """
    d = w.shape[1]
    hessian = np.empty((d, d))
    h = _STEP * np.minimum(1.0, np.minimum(w - lower, upper - w).min(axis=0))
    for k in range(d):
        move = h[k] * (np.arange(d) == k)
        hessian[k] = (gradient(w - move) - gradient(w + move)).mean(axis=0) / (2.0 * h[k])
    return _definite(0.5 * (hessian + hessian.T)) + np.diag(12.0 / (upper - lower) ** 2)


def _definite(curvature: FloatArray) -> FloatArray:
    """Return a symmetric matrix with positive eigenvalues: their absolute values, at least 1e-9 of the largest."""
    values, vectors = np.linalg.eigh(curvature)
    size = np.abs(values)
    return np.asarray((vectors * np.maximum(size, 1e-9 * size.max())) @ vectors.T)
