"""The main parameters given the values of the structural parameters in all tests, which fix the likelihood."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmu.box import find_inside
from fmu.posterior.joint.conditional.scores import Scores
from fmu.posterior.joint.varies.base import Slope
from fmu.posterior.joint.varies.population import Drawn
from fmu.posterior.joint.varies.truncated_normal import Slopes
from fmu.posterior.priors.joint import JointPrior
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.scaled import ScaledDensity
from fmu.types import BoolArray, FloatArray, IntArray


class MainGivenValues:
    """The density of main parameters given the values of the structural parameters in all tests.

    It includes the parameters that act only through values that scatter, `columns` in theta: means, standard
    deviations and correlations of populations, and laws of covariates of parameters that scatter. The value of the
    likelihood depends on the values only and is left out.

    The density is one of coordinates w in which it is close to a normal distribution: for the centre m and width s
    of a population, or the logarithm of a median, w is (m − v̄)/s and log s, where v̄ is the mean of the values; for
    all other parameters w is scaled.

    Parameters
    ----------
    problem : UpdatingProblem
        A problem with populations and standard normal scores.

    Attributes
    ----------
    lower, upper : ndarray, shape (n_columns,)
        Bounds of w; infinite for centres and widths, beyond whose bounds the log-density is −inf.
    others : int
        Number of main parameters that are not included, without inferred standard deviations of errors.
    """

    def __init__(self, problem: UpdatingProblem) -> None:
        layout, parameters, scaled = problem.layout, problem.parameters, ScaledDensity(problem)
        self.layout, self.scores = layout, Scores.of(layout)
        at = np.array([[p.start for p in parameters]])
        main = set(range(len(layout.parameters))) - set(self.scores.columns[self.scores.scored].tolist())
        for one in layout.values_of:
            if not isinstance(one.base, Drawn):
                main -= {int(k) for slope in one(at[:, : len(layout.parameters)])[1] for k in slope.columns}
        self.columns: IntArray = np.array(sorted(main))
        self.others = problem.n_structural - len(self.columns) - int(self.scores.scored.sum())
        self.prior = JointPrior([parameters[k] for k in self.columns])
        self._offset, self._scale = scaled.offset[self.columns], scaled.scale[self.columns]
        self._low, self._high = scaled.theta_lower[self.columns], scaled.theta_upper[self.columns]
        self.lower, self.upper = scaled.lower[self.columns], scaled.upper[self.columns]
        place = {int(column): k for k, column in enumerate(self.columns)}
        self._pairs = [(place[one.drawn.centre], place[one.drawn.width]) for one in self.scores.every]
        self._positive = [k for j, pair in enumerate(self._pairs) for k in pair[0 if self._is_log(j) else 1 :]]
        for pair in self._pairs:
            self.lower[list(pair)], self.upper[list(pair)] = -np.inf, np.inf

    def values(self, theta: FloatArray) -> FloatArray:
        """Return the values that scatter, shape (n, n_tests, p), at theta (n, ndim)."""
        values: FloatArray = self.layout.values(theta[:, : len(self.layout.parameters)])
        return values[:, :, self.scores.parameters]

    def with_values(self, theta: FloatArray, values: FloatArray) -> FloatArray:
        """Return a copy of theta in which the scores are those of the values, (n, n_tests, p)."""
        of = theta[:, : len(self.layout.parameters)]
        z = [one.scores(of, values[:, :, k]) for k, one in enumerate(self.scores.every)]
        return self.scores.put(theta, np.stack(z, axis=2))

    def coordinates(self, theta: FloatArray, values: FloatArray) -> FloatArray:
        """Return w, (n, n_columns), at theta (n, ndim) with the values (n, n_tests, p)."""
        main = theta[:, self.columns]
        w = (main - self._offset) / self._scale
        for k, (centre, width) in enumerate(self._pairs):
            m = np.log(main[:, centre]) if self._is_log(k) else main[:, centre]
            w[:, centre], w[:, width] = (m - self._middle(k, values)) / main[:, width], np.log(main[:, width])
        return w

    def theta_at(self, w: FloatArray, theta: FloatArray, values: FloatArray) -> FloatArray:
        """Return a copy of theta with the main parameters at w; the inverse of `coordinates`."""
        main = np.clip(self._offset + self._scale * w, self._low, self._high)
        with np.errstate(over="ignore", under="ignore"):
            for k, (centre, width) in enumerate(self._pairs):
                main[:, width] = np.exp(w[:, width])
                m = self._middle(k, values) + main[:, width] * w[:, centre]
                main[:, centre] = np.exp(m) if self._is_log(k) else m
        found = theta.copy()
        found[:, self.columns] = main
        return found

    def _is_log(self, k: int) -> bool:
        return self.scores.every[k].drawn.population.of_logarithm

    def _middle(self, k: int, values: FloatArray) -> FloatArray:
        v = values[:, self.scores.scored[:, k], k]
        return np.mean(np.log(v) if self._is_log(k) else v, axis=1)

    def log_prob_and_grad(
        self, w: FloatArray, theta: FloatArray, values: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the log-density (n,) of w and its gradient, (n, n_columns).

        Parameters
        ----------
        w : ndarray, shape (n, n_columns)
        theta : ndarray, shape (n, ndim)
            Supplies the other parameters; the scores have no influence.
        values : ndarray, shape (n, n_tests, p)
            A value that the bounds of its parameter exclude gives the log-density −inf.
        """
        at = self.theta_at(w, theta, values)
        main = at[:, self.columns]
        inside = find_inside(main, self._low, self._high)[0] & np.all(main[:, self._positive] > 0.0, axis=1)
        at[~inside] = theta[~inside]
        main = at[:, self.columns]
        total, gradient = self._at_theta(at, values)
        by_w = gradient * self._scale
        for k, (centre, width) in enumerate(self._pairs):
            s, is_log = main[:, width], self._is_log(k)
            by_m = gradient[:, centre] * (main[:, centre] if is_log else 1.0) + float(is_log)
            by_w[:, centre] = s * by_m
            by_w[:, width] = s * (gradient[:, width] + w[:, centre] * by_m) + 2.0
            total = total + 2.0 * w[:, width]
            if is_log:
                total = total + np.log(main[:, centre])
        return np.where(inside, total, -np.inf), by_w

    def _at_theta(self, theta: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the log-density of the main parameters themselves, and its gradient."""
        of = theta[:, : len(self.layout.parameters)]
        total = self.prior.log_pdf(theta[:, self.columns])
        gradient = np.zeros_like(theta)
        gradient[:, self.columns] = self.prior.log_pdf_gradient(theta[:, self.columns])
        inside = np.ones(len(theta), dtype=bool)
        copula, z = self.layout.correlation, np.zeros_like(values)
        links = []
        for k, one in enumerate(self.scores.every):
            drawn, scored = one.drawn, self.scores.scored[:, k]
            factor, by_factor = one.factor(of)
            value = np.where(scored, values[:, :, k] / factor, drawn.reference[0])
            within = ((value > drawn.lower) & (value < drawn.upper) & (factor > 0.0)).all(axis=1)
            inside &= within
            link = _Link(drawn, scored, np.where(within[:, None], value, drawn.reference[0]), by_factor)
            links.append(link)
            ends = link.ends(of)
            p, slopes = drawn.population.log_pdf(link.value, *ends, drawn.lower, drawn.upper)
            total = total + np.einsum("nt->n", np.where(scored, p - np.log(np.abs(factor)), 0.0))
            link.chain(gradient, slopes, -1.0)
            if copula is not None:
                scores = drawn.population.scores(link.value, *ends, drawn.lower, drawn.upper)
                z[:, :, k] = np.where(scored, scores, 0.0)
        if copula is not None:
            by_test, by_score, by_correlation = copula.log_density(theta, z)
            total = total + np.einsum("nt->n", by_test)
            gradient[:, copula.columns] += by_correlation
            for k, link in enumerate(links):
                bounds = link.drawn.lower, link.drawn.upper
                by_z, by_centre, by_width = link.drawn.population.values(z[:, :, k], *link.ends(of), *bounds)[1]
                per = by_score[:, :, k] / by_z
                link.chain(gradient, (per, -per * by_centre, -per * by_width), 0.0)
        return np.where(inside, total, -np.inf), gradient[:, self.columns]


class _Link(NamedTuple):
    """The chain rule from the values of a population to theta; `value` is that before the factor, (n, n_tests)."""

    drawn: Drawn
    scored: BoolArray
    value: FloatArray
    by_factor: list[Slope]

    def ends(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the centre and the width of the population, (n, 1) each."""
        return theta[:, self.drawn.centre, None], theta[:, self.drawn.width, None]

    def chain(self, gradient: FloatArray, slopes: Slopes, of_jacobian: float) -> None:
        """Add derivatives by value, centre and width, (n, n_tests) each, to the gradient by theta (n, ndim).

        `of_jacobian` is the derivative of the log-density by the logarithm of the factor at a constant value.
        """
        by_value, *of_both = (np.where(self.scored, part, 0.0) for part in slopes)
        for column, part in zip((self.drawn.centre, self.drawn.width), of_both, strict=True):
            gradient[:, column] += np.einsum("nt->n", part)
        for slope in self.by_factor:
            terms = np.where(self.scored, (of_jacobian - by_value * self.value) * slope.values, 0.0)
            for column in np.unique(slope.columns):
                gradient[:, column] += terms[:, slope.columns == column].sum(axis=1)
