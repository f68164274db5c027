"""The main parameters given the scores of all tests, by an approximation that needs no solve of the model."""

from __future__ import annotations

import numpy as np

from fmu.posterior.joint.conditional.expansion import Expansion
from fmu.posterior.joint.conditional.scores import Scores
from fmu.posterior.priors.joint import JointPrior
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.scaled import ScaledDensity
from fmu.types import FloatArray, IntArray


class MainGivenScores:
    """An approximate density of the main parameters given the scores and the standard deviations of errors.

    If populations are correlated, the scores that are given are independent of each other: the scores times the
    inverse Cholesky factor of their correlation matrix. The density of the correlations then contains the data, so
    that they too are moved by steps whose size does not depend on how little the tests say about their values. In
    place of the likelihood of each test it has the expansion, a quadratic in the values of the structural
    parameters, and needs no solve of the model.

    Parameters
    ----------
    problem : UpdatingProblem
        A problem with populations and standard normal scores.
    expansion : Expansion
        The log-likelihoods of the tests about `theta`.
    """

    def __init__(self, problem: UpdatingProblem, expansion: Expansion) -> None:
        self.layout, self.expansion, scores = problem.layout, expansion, Scores.of(problem.layout)
        self.scores = scores
        self.columns: IntArray = np.setdiff1d(np.arange(problem.n_structural), scores.columns[scores.scored])
        self.prior = JointPrior([problem.parameters[k] for k in self.columns])
        scaled = ScaledDensity(problem)
        self._offset, self._scale = scaled.offset[self.columns], scaled.scale[self.columns]
        self._low, self._high = scaled.theta_lower[self.columns], scaled.theta_upper[self.columns]
        self.lower, self.upper = scaled.lower[self.columns], scaled.upper[self.columns]

    def coordinates(self, theta: FloatArray) -> FloatArray:
        """Return the main parameters of theta (n, ndim), scaled, shape (n, n_columns)."""
        return (theta[:, self.columns] - self._offset) / self._scale

    def theta_at(self, w: FloatArray, theta: FloatArray) -> FloatArray:
        """Return theta with the scaled main parameters w and the same independent scores as `theta`."""
        return self._set_main(w, theta, self._independent_scores(theta))

    def log_prob_and_grad(self, w: FloatArray, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the log-density (n,) of w, (n, n_columns), and its gradient; theta has the scores."""
        u = self._independent_scores(theta)
        at = self._set_main(w, theta, u)
        known, n = self.expansion, len(self.layout.parameters)
        away = self.layout.values(at[:, :n]) - known.values
        weight = known.weigh(at[:, n:])
        turned, pull = weight * np.einsum("tij,ntj->nti", known.information, away), weight * known.slope
        value = np.einsum("nti,nti->n", away, pull - 0.5 * turned)
        noise = np.zeros((*away.shape[:2], at.shape[1] - n))
        slopes = np.concatenate([pull - turned, noise], axis=2)
        gradient = self.layout.gradient(at, slopes, np.arange(away.shape[1]))
        copula = self.layout.correlation
        if copula is not None:
            gradient[:, copula.columns] = copula.chain_scores(at, u, self.scores.take(gradient))
        main = at[:, self.columns]
        slope = gradient[:, self.columns] + self.prior.log_pdf_gradient(main)
        return value + self.prior.log_pdf(main), slope * self._scale

    def _independent_scores(self, theta: FloatArray) -> FloatArray:
        """Return independent standard normal scores, (n, n_tests, p), in place of the scores of theta."""
        z, copula = self.scores.take(theta), self.layout.correlation
        return z if copula is None else copula.whiten(theta, z)

    def _set_main(self, w: FloatArray, theta: FloatArray, u: FloatArray) -> FloatArray:
        """Return theta with the scaled main parameters w and the scores that have the independent scores u."""
        found, copula = theta.copy(), self.layout.correlation
        found[:, self.columns] = np.clip(self._offset + self._scale * w, self._low, self._high)
        return found if copula is None else self.scores.put(found, copula.correlate(found, u))
