"""Collect the densities of a hierarchical problem from which its sampler proposes scores and main parameters."""

from __future__ import annotations

from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np

from fmu.box import find_inside
from fmu.posterior.ascent import GaussNewton
from fmu.posterior.discrepancy.given_errors import LikelihoodGivenErrors, with_errors_as_parameters
from fmu.posterior.joint.blocks import BlockForm
from fmu.posterior.joint.conditional.bend import find_bend
from fmu.posterior.joint.conditional.dates import DateOfEvent, undated_events
from fmu.posterior.joint.conditional.expansion import expand, likelihood_of_tests
from fmu.posterior.joint.conditional.given_values import PopulationsGivenValues
from fmu.posterior.joint.conditional.marginal import MarginalOfMain
from fmu.posterior.joint.conditional.regression import FittedNormal, fit_normal, reflect
from fmu.posterior.joint.conditional.scores import REGULAR, Scores, ScoresGivenMain
from fmu.posterior.joint.conditional.walks import WalksGivenValues
from fmu.posterior.joint.typical import typical_point
from fmu.posterior.priors.joint import JointPrior
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.scaled import ScaledDensity
from fmu.types import FloatArray

_HALVINGS = 30
_BENT = 0.1
"""Ridges are treated as straight if no coefficient of a parabola exceeds this value."""
_DRAWS = 400
"""Number of draws whose mean is the second typical point, and of draws for the candidates' acceptance rate."""
_FARTHEST = 1.5
"""Largest loss of log-density at a scattered point, divided by (d + √d) times the squared dispersion."""
_RARELY = 0.5
"""All populations also take random walks if the smallest acceptance rate of candidates is below this value."""
_CLIMBED = 0.01
"""Largest increase of the log-density that is left in the search for the most probable scores."""


class Conditionals(NamedTuple):
    """The score density and the main-parameter density of a hierarchical problem.

    The scores are standard normal a priori and treated as independent in time.

    Attributes
    ----------
    scores : ScoresGivenMain
    marginal : MarginalOfMain
    normal : FittedNormal
        The normal distribution closest to `marginal`.
    noise : ndarray, shape (n_noise,)
        Posterior standard deviation of each inferred error parameter divided by its value; no entry exceeds 1.
    by_errors : ndarray, shape (d, n_errors)
        Changes of the main parameters that make up for model errors of unit size, at fixed scores.
    sizes : ndarray, shape (n_errors,)
        Standard deviations of the model errors at the typical point.
    noise_prior : JointPrior
        Prior of the error parameters.
    populations : PopulationsGivenValues
    walks : WalksGivenValues or None
        Random-walk steps for all populations. They are needed if a population has no candidates in `populations`,
        or if its candidates are rarely accepted. Otherwise, and if values are correlated in time, `walks` is None.
    events : tuple of DateOfEvent
        Sudden losses at unknown dates.
    typical : ndarray, shape (1, ndim + n_errors)
        The typical point, with standard normal scores, followed by the model errors if there is a discrepancy.
    scales : ndarray, shape (1, n_tests, p) or (1, 1, 1)
        Prior standard deviations of the scores at the typical point. They differ from 1 only for outliers.
    """

    scores: ScoresGivenMain
    marginal: MarginalOfMain
    normal: FittedNormal
    noise: FloatArray
    by_errors: FloatArray
    sizes: FloatArray
    noise_prior: JointPrior
    populations: PopulationsGivenValues
    walks: WalksGivenValues | None
    events: tuple[DateOfEvent, ...]
    typical: FloatArray
    scales: FloatArray


_KNOWN: WeakKeyDictionary[UpdatingProblem, Conditionals] = WeakKeyDictionary()


def conditionals(problem: UpdatingProblem) -> Conditionals:
    """Return the conditional densities of a problem with populations. They are cached for each problem."""
    if problem not in _KNOWN:
        _KNOWN[problem] = _compute(problem)
    return _KNOWN[problem]


def scatter_about_typical(
    problem: UpdatingProblem, rng: np.random.Generator, n: int, dispersion: float
) -> FloatArray:
    """Return `n` starting points about the typical point of a hierarchical posterior, shape (n, ndim).

    Main parameters are drawn from their fitted normal distribution and scores from their normal approximations,
    both widened by the factor `dispersion`. Error parameters are multiplied by log-normal factors. Correlation
    times are drawn from their priors, and dates of sudden losses are proposed by `DateOfEvent`. A point is
    accepted if it is inside the bounds, its density is finite, and its main parameters are about as probable as
    draws from the normal distribution. Otherwise it is moved halfway to the typical point, repeatedly. After
    `_HALVINGS` rejections it is the typical point, with the drawn times and dates.
    """
    known = conditionals(problem)
    marginal, given = known.marginal, known.scores
    centre = np.repeat(known.typical, n, axis=0)
    for k in problem.layout.in_time.columns if problem.layout.in_time else ():
        one = problem.parameters[k]
        centre[:, k] = one.prior.draw(rng, n, one.lower, one.upper)
    for event in known.events:
        centre = event.propose(rng, given, centre, known.scales)[0]
    step = dispersion * rng.standard_normal((n, len(known.normal.mean))) @ known.normal.factor.T
    of_scores = dispersion * rng.standard_normal((n, *given.scores.scored.shape))
    of_noise = dispersion * known.noise * rng.standard_normal((n, len(known.noise)))
    of_errors = dispersion * known.sizes * rng.standard_normal((n, len(known.sizes)))
    share, found = np.ones((n, 1)), problem.layout.restore_scores(centre)
    middle, d = marginal.coordinates(centre), len(known.normal.mean)
    highest = marginal.log_prob_and_grad(middle, centre, known.scales)[0]
    least = highest - _FARTHEST * dispersion**2 * (d + np.sqrt(d))
    left = np.arange(n)
    for _ in range(_HALVINGS):
        low, high = marginal.lower, marginal.upper
        w = reflect(middle[left] + share[left] * step[left], low, high)[0]
        theta = marginal.theta_at(w, centre[left])
        theta[:, problem.n_structural : problem.ndim] *= np.exp(share[left] * of_noise[left])
        inside = find_inside(theta[:, : problem.ndim], problem.lower, problem.upper)[0] & np.all(
            (w > low) & (w < high), axis=1
        )
        inside &= marginal.log_prob_and_grad(w, theta, known.scales)[0] > least[left]
        theta[~inside] = centre[left][~inside]
        normal = given.approximate(theta, known.scales)
        theta = given.scores.put(theta, normal.restore(share[left, :, None] * of_scores[left]))
        theta[:, marginal.columns] += share[left] * of_errors[left] @ known.by_errors.T
        theta = problem.layout.restore_scores(theta)
        good = inside & np.isfinite(problem.log_prob(theta[:, : problem.ndim]))
        found[left[good]] = theta[good]
        share[left] *= 0.5
        left = left[~good]
        if not len(left):
            break
    return found[:, : problem.ndim]


def _compute(problem: UpdatingProblem) -> Conditionals:
    problem = problem.with_layout(problem.layout.without_time())
    marginal_of_errors = problem.with_layout(problem.layout.remove_centring())
    plain = with_errors_as_parameters(marginal_of_errors)
    own = ScaledDensity(problem).to_theta(typical_point(problem))[None]
    first = _with_errors(plain, problem.layout.standardise_scores(own))
    scales = _scales(plain, first)
    scores, marginal = _about(plain, first, scales)
    normal = _fit(marginal, first, marginal.rough_covariance(first, scales), scales)
    # the first typical point may have standard deviations near zero, where the mean of the density is far from it
    theta = marginal.theta_at(normal.draws(_DRAWS, marginal.lower, marginal.upper).mean(axis=0)[None], first)
    found = scores.approximate(theta, scales)
    theta = scores.scores.put(theta, found.bend(found.mean))
    if np.isfinite(plain.log_prob(theta))[0]:
        theta = BlockForm(plain, np.array([], dtype=np.int64)).climb(theta[0], _CLIMBED)[0][None]
        scales = _scales(plain, theta)
        scores, marginal = _about(plain, theta, scales)
        normal = _fit(marginal, theta, normal.covariance, scales)
    else:
        theta = first
    s, columns = theta[:, problem.n_structural : problem.ndim], marginal.columns
    if plain.ndim > problem.ndim:
        scaled, of_noise = ScaledDensity(plain), slice(problem.n_structural, problem.ndim)
        hessian = GaussNewton(plain)(scaled.to_scaled(theta))[2][0]
        information = (hessian / np.outer(scaled.scale, scaled.scale))[of_noise, of_noise]
        sizes = _given_errors(plain).sizes(theta[:, problem.n_structural :])[0]
        # the prior of a correlation has no curvature
        of_main = hessian[np.ix_(columns, columns)] + np.eye(len(columns))
        slopes = scaled.scale[columns, None] * _slopes_by_errors(plain, theta)[columns]
        by_errors = scaled.scale[columns, None] * np.linalg.solve(of_main, slopes) / sizes
    else:
        every = (term.information(s, problem.likelihood.used)[0] for term in problem.likelihood.terms_of)
        information, by_errors = sum(every, np.zeros((s.size, s.size))), np.empty((len(columns), 0))
        sizes = np.empty(0)
    noise = 1.0 / np.sqrt(1.0 + np.diag(information) * s[0] ** 2)
    noise_prior = JointPrior(problem.parameters[problem.n_structural :])
    populations = PopulationsGivenValues(plain.layout, problem.parameters)
    walks = None
    if all(one.in_time is None for one in plain.layout.drawn):
        main = marginal.theta_at(normal.draws(_DRAWS, marginal.lower, marginal.upper), np.repeat(theta, _DRAWS, 0))
        if _acceptance(populations, scores, main, scales) < _RARELY:
            walks = WalksGivenValues(plain.layout, problem.parameters)
    events = undated_events(plain.layout, problem.parameters, theta[0])
    return Conditionals(
        scores, marginal, normal, noise, by_errors, sizes, noise_prior, populations, walks, events, theta, scales
    )


def _acceptance(
    populations: PopulationsGivenValues, scores: ScoresGivenMain, theta: FloatArray, scales: FloatArray
) -> float:
    """Return the smallest acceptance rate of the populations' candidates at the main parameters theta, (n, ndim).

    It is zero if a population has no candidates.
    """
    if populations.n_populations < len(scores.layout.drawn):
        return 0.0
    rng, normal = np.random.default_rng(2), scores.approximate(theta, scales)
    z = normal.restore(rng.standard_normal(normal.mean.shape) * normal.scored)
    log_ratio = populations.propose(rng, scores.scores.put(theta, z)).log_ratio
    return float(np.exp(np.minimum(log_ratio, 0.0)).mean(axis=0).min())


def _given_errors(plain: UpdatingProblem) -> LikelihoodGivenErrors:
    assert isinstance(plain.likelihood, LikelihoodGivenErrors)  # for the type checker
    return plain.likelihood


def _with_errors(plain: UpdatingProblem, theta: FloatArray) -> FloatArray:
    """Return theta, (1, n), extended by the most probable model errors if these are parameters."""
    if plain.ndim == theta.shape[1]:
        return theta
    errors = _given_errors(plain).likeliest(plain.layout.of_model(theta))
    return np.concatenate([theta, errors], axis=1)


def _slopes_by_errors(plain: UpdatingProblem, theta: FloatArray) -> FloatArray:
    """Return the derivatives of ∇log P with respect to model errors, (ndim, n_errors), at theta (1, ndim).

    They are central differences with steps of 1.
    """
    n = _given_errors(plain).n_errors
    steps = np.eye(plain.ndim)[-n:]
    slopes = plain.log_prob_and_grad(np.concatenate([theta + steps, theta - steps]))[1]
    return 0.5 * (slopes[:n] - slopes[n:]).T


def _scales(plain: UpdatingProblem, theta: FloatArray) -> FloatArray:
    """Return the most probable prior sds of the scores at theta, (1, n_tests, p) or (1, 1, 1)."""
    outliers = plain.layout.outliers
    return REGULAR if outliers is None else outliers.likeliest_scales(theta, Scores.of(plain.layout).take(theta))


def scores_about(plain: UpdatingProblem, theta: FloatArray, scales: FloatArray) -> ScoresGivenMain:
    """Return the score density, expanded about theta, shape (1, ndim).

    The scores of `plain` are standard normal, and any errors of its model are parameters. `scales` is as in
    `Conditionals`.
    """
    expansion = expand(plain.layout, likelihood_of_tests(plain), theta[0])
    return _bend(ScoresGivenMain(plain.layout, expansion), plain, theta, scales)


def _about(
    plain: UpdatingProblem, theta: FloatArray, scales: FloatArray
) -> tuple[ScoresGivenMain, MarginalOfMain]:
    """Return the score density and the main-parameter density, expanded about theta, shape (1, ndim)."""
    scores = scores_about(plain, theta, scales)
    return scores, MarginalOfMain(plain, scores, theta)


def _fit(marginal: MarginalOfMain, theta: FloatArray, covariance: FloatArray, scales: FloatArray) -> FittedNormal:
    """Return the normal distribution closest to the main-parameter density. The search starts at theta."""

    def gradient(w: FloatArray) -> FloatArray:
        return marginal.log_prob_and_grad(w, np.repeat(theta, len(w), axis=0), scales)[1]

    centre = marginal.coordinates(theta)[0]
    return fit_normal(gradient, centre, covariance, marginal.lower, marginal.upper)


def _bend(
    straight: ScoresGivenMain, plain: UpdatingProblem, theta: FloatArray, scales: FloatArray
) -> ScoresGivenMain:
    """Return the score density. Its ridges are parabolas if at least one of them is noticeably curved."""

    def gradient(z: FloatArray) -> FloatArray:
        slopes = plain.log_prob_and_grad(straight.scores.put(np.repeat(theta, len(z), axis=0), z))[1]
        return straight.scores.take(slopes)

    normal = straight.approximate(theta, scales)
    precision = normal.factor[0] @ np.swapaxes(normal.factor[0], 1, 2)
    at = straight.scores.put(theta, normal.mean)[:, : len(plain.layout.parameters)]
    slopes = np.stack([one.slope(at)[0] for one in straight.scores.every], axis=1)
    found = find_bend(gradient, normal.mean[0], precision, np.where(normal.scored, slopes, 1.0))
    curvature = np.max(np.abs(found.curvature), axis=(1, 2, 3))
    bend = found if np.isfinite(curvature).all() and np.max(curvature) > _BENT else None
    return ScoresGivenMain(straight.layout, straight.expansion, bend, curvature)
