"""Leave modes out of a hierarchical posterior, one after another, and integrate out the scores of their tests.

Let y_t be the data of test t, y_t,-i these data without the datum y_i, and z_t the scores of the test. The main
parameters ("main") are all parameters except scores. Scores are informed mostly by the data of their own test. The
weights 1 / p(y_i | main, z_t) of the posterior draws would therefore be uneven. Weights w of the main parameters
alone,

w = p(y_t,-i | main) / p(y_t | main),

are much more even (Merkle, Furr & Rabe-Hesketh 2019, *Psychometrika* 84, 802–829). They contain two integrals over
z_t. Each has an unbiased estimate: 1 / p(y_t | main) from the scores z_t of the posterior draw itself, and
p(y_t,-i | main) from new scores z′_t,

w = q(z_t) / [L_t(z_t) p(z_t)] · L_t,-i(z′_t) p(z′_t) / q′(z′_t), z′_t ~ q′,

where L_t and L_t,-i are the likelihoods of the test with and without the datum (Gelfand & Dey 1994, *J. R. Stat.
Soc. B* 56, 501–514). The densities q and q′ approximate the density of the scores given the main parameters
(`fmu.posterior.joint.conditional`). Good approximations make the weights even, but the weights are exact for any q
and q′. A weighted draw consists of the main parameters and z′_t, and the datum is predicted from it.

Tests are independent given the main parameters, so that one solve per draw suffices to leave out one mode of every
test. The errors of the model, which all tests share, are drawn given all data and treated as main parameters.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.analysis.convergence.effective import ess_bulk
from fmu.analysis.held_out.prediction import Draws
from fmu.analysis.held_out.weights import FEWEST, Smoothed, smooth
from fmu.posterior.discrepancy.given_errors import LikelihoodGivenErrors, with_errors_as_parameters
from fmu.posterior.errors.likelihood import ModalLikelihood
from fmu.posterior.joint.conditional.both import conditionals, scores_about
from fmu.posterior.joint.conditional.scores import REGULAR, Normal, ScoresGivenMain
from fmu.posterior.joint.varies.base import sum_by_test
from fmu.progress.phases import by_parts
from fmu.types import FloatArray

if TYPE_CHECKING:
    from fmu.posterior.problem import UpdatingProblem

_PHASE = "modes left out"
_MOST = 2000
"""Largest number of draws that are weighted."""
_NU = 5.0
"""Degrees of freedom of the Student distributions q′."""
_NARROW = 0.7
"""Variances of q relative to the normal approximation: the tails of q must be lighter than those of L_t p."""
_EXPANSIONS = 2
"""Number of expansions of a likelihood; each is about the most probable scores of the one before it."""
_STEPS = 2
"""Number of Newton steps to the most probable scores, if the model has errors."""


def leave_out_by_tests(
    problem: UpdatingProblem, theta: FloatArray, walkers: int, rng: np.random.Generator, most: float
) -> dict[int, tuple[Draws, Smoothed]]:
    """Weight a hierarchical posterior's draws so that they represent the posterior without one of the used modes.

    Parameters
    ----------
    problem : UpdatingProblem
    theta : ndarray, shape (chains, n, ndim)
        Draws from the posterior, SI units.
    walkers : int
        Number of walkers in each ensemble, as for `ess_bulk`.
    rng : Generator
    most : float
        Largest number of solves of all tests.

    Returns
    -------
    dict
        The draws, with new scores, and their weights, for each mode that was used in updating, keyed by mode
        index. A mode is missing if its weights have no tail. The dict is empty if `most` does not suffice for 100
        draws, or if there is no normal approximation, as for values correlated in time, a soft pairing, and
        frequency response functions.
    """
    layout = problem.layout.remove_centring()
    standard, every = problem.with_layout(layout), _rounds(problem)
    whole = with_errors_as_parameters(standard)
    likelihood: Any = whole.likelihood
    has_errors = isinstance(likelihood, LikelihoodGivenErrors)
    cost = (1 + len(every)) * (1 + has_errors * (1 + _STEPS))
    every_th = int(np.ceil(theta.shape[0] * theta.shape[1] / max(1.0, min(_MOST, most / cost))))
    thinned = theta[:, :: max(1, every_th)]
    chains, n, _ = thinned.shape
    is_modal = isinstance(likelihood, ModalLikelihood) and not problem.model.is_soft
    if chains * n < FEWEST or cost * chains * n > most or not is_modal or layout.in_time is not None:
        return {}
    known, n_tests = conditionals(problem), len(problem.tests)
    of = known.scores.scores

    def complete(rows: FloatArray) -> FloatArray:
        """Return the rows with standard normal scores, and with errors of the model drawn given the data."""
        rows = problem.layout.standardise_scores(rows)
        if not isinstance(likelihood, LikelihoodGivenErrors):
            return rows
        at = layout.of_model(rows)
        return np.concatenate([rows, likelihood.draw(rng, likelihood.of.observed(at), at)], axis=1)

    main = np.concatenate(by_parts(_PHASE, complete, thinned.reshape(-1, problem.ndim)))
    z, scales, outliers = of.take(main), REGULAR, layout.outliers
    if outliers is not None:
        scales = outliers.draw_scales(rng, main, z)
    steps = _STEPS if has_errors else 0
    normal = _approximate(whole, known.scores, main, scales, steps)
    terms = np.concatenate(by_parts(_PHASE, whole.terms_of_tests, main))
    log_q = normal.log_density(normal.straighten(z)) / _NARROW + normal.log_det_factor
    log_p = sum_by_test(terms, likelihood.test_of_terms, n_tests) + known.scores.log_prior(main, scales)
    found = {}
    for left_out in every:
        kept = [label for k, label in enumerate(problem.data.labels) if problem.data.use[k] and k not in left_out]
        others = with_errors_as_parameters(standard.using(kept))
        of_others: Any = others.likelihood
        given = _expand(others, known.typical, known.scales)
        proposal = _approximate(others, given, main, scales, steps)
        new = proposal.draw(rng, _NU)
        at = of.put(main, proposal.bend(new))

        def solve(rows: FloatArray, of_others: Any = of_others) -> FloatArray:
            """Return the tests' log-likelihoods with and without the modes, and the frequencies, side by side."""
            of_model = layout.of_model(rows)
            seen = likelihood.observed(of_model)
            both = (
                sum_by_test(one.terms_of_observed(seen, of_model), one.test_of_terms, n_tests)
                for one in (likelihood, of_others)
            )
            return np.concatenate([*both, seen.frequencies], axis=1)

        solved = np.concatenate(by_parts(_PHASE, solve, at))
        with_modes, without, hz = np.split(solved, [n_tests, 2 * n_tests], axis=1)
        log_new = without + known.scores.log_prior(at, scales)
        log_w = log_new - proposal.log_density(new, _NU) - proposal.log_det_factor + log_q - log_p
        draws = Draws(whole, at, hz)
        for k, t in left_out.items():
            of_mode = np.where(np.isfinite(log_w[:, t]), log_w[:, t], -np.inf)
            efficiency = min(1.0, ess_bulk(of_mode.reshape(chains, n), walkers) / (chains * n))
            gain = np.where(np.isfinite(of_mode), with_modes[:, t] - without[:, t], -np.inf)
            try:
                found[k] = draws, smooth(of_mode, gain, efficiency)
            except ValueError:  # the weights have no tail
                continue
    return found


def _rounds(problem: UpdatingProblem) -> list[dict[int, int]]:
    """Return dicts that map mode indices to test indices; each dict has at most one mode of each test."""
    test, use = problem.model.test_of_modes, np.array(problem.data.use)
    of_tests = [np.flatnonzero(use & (test == t)).tolist() for t in range(len(problem.tests))]
    n = max(2, *map(len, of_tests))  # so that modes of other tests are kept
    places = [[(t + i) % n for t in range(len(of_tests))] for i in range(n)]
    return [
        {of[j]: t for t, (of, j) in enumerate(zip(of_tests, row, strict=True)) if j < len(of)} for row in places
    ]


def _expand(problem: UpdatingProblem, typical: FloatArray, scales: FloatArray) -> ScoresGivenMain:
    """Return the density of the scores, expanded about the most probable scores at the point `typical`."""
    for _ in range(_EXPANSIONS):
        found = scores_about(problem, typical, scales)
        normal = found.approximate(typical, scales)
        typical = found.scores.put(typical, normal.bend(normal.mean))
    return found


def _approximate(
    problem: UpdatingProblem, given: ScoresGivenMain, main: FloatArray, scales: FloatArray, steps: int
) -> Normal:
    """Return the normal approximation of the scores at `main` (n, ndim), its mean improved by Newton steps."""
    normal = given.approximate(main, scales)
    for _ in range(steps):
        at = given.scores.put(main, normal.bend(normal.mean))
        slopes = np.concatenate(by_parts(_PHASE, lambda rows: problem.log_prob_and_grad(rows)[1], at))
        gradient = given.scores.take(slopes)
        gradient = np.where(np.isfinite(gradient).all(axis=2, keepdims=True), gradient, 0.0)
        step = normal.scatter(np.linalg.solve(normal.factor, gradient[..., None])[..., 0])
        normal = normal._replace(mean=normal.mean + step)
    return normal
