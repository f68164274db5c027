"""Find maxima of a hierarchical posterior with Newton-type steps that exploit the block structure of its Hessian.

Let m be the main parameters and z_t the scores in test t. The negative second derivatives of the log-density have
the blocks

    H_mm,  H_zm,t  and  H_zz,t,

and zeros between the scores of two different tests (correlation in time is ignored there). Systems with this
matrix are solved with the Schur complement H_mm − Σ H_zm,tᵀ H_zz,t⁻¹ H_zm,t. The cost is proportional to the
number of tests.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fmu.posterior.ascent import FIRST_DAMPING, MOST_DAMPING, adjust_damping, find_pressed
from fmu.posterior.joint.conditional.expansion import information_by_test, likelihood_of_tests
from fmu.posterior.joint.conditional.scores import Scores
from fmu.posterior.priors.joint import JointPrior
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.scaled import ScaledDensity
from fmu.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class BlockHessian:
    """Negative second derivatives of a log-density for d main parameters and p scores per test, in scaled units.

    Attributes
    ----------
    main : ndarray, shape (d, d)
        Block of the main parameters.
    cross : ndarray, shape (n_tests, p, d)
        Mixed derivatives with respect to a score and a main parameter; zero for a score that the test does not
        have.
    scores : ndarray, shape (n_tests, p, p)
        Block of each test's scores. A score that the test does not have gets a row and column of the identity
        matrix.
    """

    main: FloatArray
    cross: FloatArray
    scores: FloatArray

    def damp(self, damping: float | FloatArray, held: BoolArray) -> BlockHessian:
        """Return a copy whose diagonal is multiplied by 1 + damping.

        The rows and columns of main parameters that are True in `held`, shape (d,), are replaced by rows and
        columns of the identity matrix, so that these parameters do not move.
        """
        main, cross, scores = self.main.copy(), np.where(held, 0.0, self.cross), self.scores.copy()
        k, i = np.arange(len(main)), np.arange(scores.shape[1])
        main[k, k] *= 1.0 + damping
        scores[:, i, i] *= 1.0 + damping
        main[held], main[:, held] = 0.0, 0.0
        main[held, held] = 1.0
        return BlockHessian(main, cross, scores)

    def solve(self, of_main: FloatArray, of_scores: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Solve H x = b for the right-hand sides `of_main` (d,) and `of_scores` (n_tests, p).

        Return the two parts of x, with the same shapes.
        """
        reduced = np.linalg.solve(self.scores, np.concatenate([self.cross, of_scores[..., None]], axis=2))
        schur = self._complement(reduced[..., :-1])
        right = of_main - np.einsum("tik,ti->k", self.cross, reduced[..., -1])
        main = np.linalg.solve(schur, right) if len(right) else right
        return main, reduced[..., -1] - reduced[..., :-1] @ main

    def _complement(self, left: FloatArray) -> FloatArray:
        """Return the Schur complement (d, d), given `left` = H_zz⁻¹ H_zm of each test.

        A small multiple of the identity is added so that the result is not singular.
        """
        schur = self.main - np.einsum("tik,til->kl", self.cross, left)
        return schur + 1e-12 * (1.0 + np.trace(self.main)) * np.eye(len(schur))

    def score_variances(self) -> FloatArray:
        """Return each score's variance, shape (n_tests, p): the diagonal entry of the inverse Hessian."""
        inverse = np.linalg.inv(self.scores)
        left = inverse @ self.cross
        schur = self._complement(left)
        shared = np.einsum("tik,kl,til->ti", left, np.linalg.inv(schur), left) if len(schur) else 0.0
        return np.asarray(np.einsum("tii->ti", inverse) + shared)


class BlockForm:
    """Second-order expansion of a hierarchical posterior in block form.

    Parameters
    ----------
    problem : UpdatingProblem
        A problem with populations, in the non-centred form.
    columns : ndarray of int, shape (d,)
        Indices in theta of the main parameters that may move. The other main parameters stay fixed.
    """

    def __init__(self, problem: UpdatingProblem, columns: IntArray) -> None:
        self.problem, self.columns = problem, columns
        self.scores, self.scaled = Scores.of(problem.layout), ScaledDensity(problem)
        self._prior = JointPrior([problem.parameters[k] for k in columns])

    def gradient(self, theta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Return the log-density at theta (ndim,), and its scaled gradients.

        The gradient with respect to the main parameters `columns` has the shape (d,), and the gradient with
        respect to the scores has the shape (n_tests, p).
        """
        value, gradient = self.problem.log_prob_and_grad(theta)
        gradient = gradient * self.scaled.scale
        of_scores = np.where(self.scores.scored, gradient[self.scores.columns], 0.0)
        return float(value), gradient[self.columns], of_scores

    def hessian(self, theta: FloatArray) -> BlockHessian:
        """Return the Gauss–Newton approximation of the negative Hessian at theta (ndim,), in scaled units.

        It includes the Fisher information on the inferred parameters of errors in modes, but not on the inferred
        parameters of errors in FRFs.
        """
        problem, layout = self.problem, self.problem.layout
        n, d = len(layout.parameters), len(self.columns)
        n_tests, p = self.scores.scored.shape
        information = information_by_test(layout, likelihood_of_tests(problem), theta)
        by_main = np.zeros((n_tests, len(layout.structural), d))
        by_score = np.zeros((n_tests, p))
        place = np.full(problem.ndim, -1)
        place[self.columns] = np.arange(d)
        tests = np.arange(n_tests)
        for j, value_of in enumerate(layout.values_of):
            for slope in value_of(theta[None, :n])[1]:
                at = place[slope.columns]
                here = at >= 0
                by_main[tests[here], j, at[here]] += slope.values[0, here]
        scale = self.scaled.scale
        for k, one in enumerate(self.scores.every):
            by_score[:, k] = one.slope(theta[None, :n])[0]
        by_score = np.where(self.scores.scored, by_score * scale[self.scores.columns], 0.0)
        by_main *= scale[self.columns]
        numbers = self.scores.parameters
        turned = np.einsum("tij,tjk->tik", information, by_main)
        main = np.einsum("tik,til->kl", by_main, turned) + self._of_prior(theta)
        cross = by_score[..., None] * turned[:, numbers]
        scores = by_score[..., None] * information[:, numbers[:, None], numbers] * by_score[:, None]
        z = self.scores.take(theta[None, :n])
        scores = scores + np.eye(p) + layout.precision_of_scores(theta[None, :n], z)[0]
        return BlockHessian(main, cross, scores)

    def _of_prior(self, theta: FloatArray) -> FloatArray:
        """Return the scaled −∇² log prior, (d, d), plus the Fisher information on parameters of modal errors."""
        problem, scale = self.problem, self.scaled.scale
        found = self._prior.quadratic(theta[None, self.columns], scale[self.columns])[1][0]
        noise = np.flatnonzero(self.columns >= problem.n_structural)
        if len(noise):
            s, likelihood = theta[None, problem.n_structural :], problem.likelihood
            with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
                of_noise = sum(term.information(s, likelihood.used)[0] for term in likelihood.terms_of)
            size = scale[self.columns[noise]]
            found[np.ix_(noise, noise)] += of_noise * size[:, None] * size
        return found

    def climb(self, theta: FloatArray, tolerance: float, most_steps: int = 100) -> tuple[FloatArray, BlockHessian]:
        """Maximise the log-density over the scores and the main parameters `columns`, starting at theta (ndim,).

        Return theta at the highest point found, and the Hessian there. The search takes Levenberg–Marquardt steps.
        It ends when the predicted gain is below `tolerance`, after `most_steps` steps, or when the damping becomes
        too large. The diagonal is damped as in `fmu.posterior.ascent.ascend`.
        """
        damping = np.asarray(FIRST_DAMPING)
        value, of_main, of_scores = self.gradient(theta)
        hessian = self.hessian(theta)
        low, high = self.scaled.theta_lower[self.columns], self.scaled.theta_upper[self.columns]
        for _ in range(most_steps):
            held = find_pressed(theta[self.columns], -of_main, low, high)
            free = np.where(held, 0.0, of_main)
            main, scores = hessian.damp(0.0, held).solve(free, of_scores)
            if 0.5 * (free @ main + np.sum(of_scores * scores)) < tolerance or damping > MOST_DAMPING:
                break
            main, scores = hessian.damp(damping, held).solve(free, of_scores)
            moved = self._move(theta, main, scores)
            new_value, *new = self.gradient(moved)
            predicted = max(0.5 * float(free @ main + np.sum(of_scores * scores)), float(np.finfo(float).tiny))
            ratio = (new_value - value) / predicted if np.isfinite(new_value) else -np.inf
            better, damping = adjust_damping(damping, ratio)
            if better:
                theta, value, (of_main, of_scores) = moved, new_value, new
                hessian = self.hessian(theta)
        return theta, hessian

    def _move(self, theta: FloatArray, main: FloatArray, scores: FloatArray) -> FloatArray:
        """Return theta (ndim,) after the scaled steps `main` and `scores`, clipped to the bounds."""
        found, scored = theta.copy(), self.scores.scored
        found[self.columns] += main * self.scaled.scale[self.columns]
        found[self.scores.columns[scored]] += (scores * self.scaled.scale[self.scores.columns])[scored]
        return np.clip(found, self.scaled.theta_lower, self.scaled.theta_upper)
