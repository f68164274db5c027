"""Approximate the density of the main parameters with all scores integrated out, without solving the model.

Test t's likelihood L_t is expanded to second order in the parameter values, which are linear in the scores z_t.
The integral over the scores is then the integral of a normal density (Laplace's method; Tierney & Kadane 1986, *J.
Am. Stat. Assoc.* 81, 82–86). Let m be the main parameters, and let Λ_t and P be the scores' precision with and
without the test's data. The approximate density Q(m) is

    log Q(m) = log p(m) + Σ_t [log L_t(ẑ_t) − ½ ẑ_tᵀ P ẑ_t − ½ log det Λ_t + ½ log det P],

where ẑ_t are the most probable scores. Q has no funnel: it is smooth where a population's standard deviation is
small. A step of the main parameters in Q keeps u_t = Λ_t^½ (z_t − ẑ_t) fixed. These are the scores' distances from
ẑ_t in units of their uncertainty given main parameters and data. Acceptance depends on how the approximation error
changes, not on its size (Osmundsen, Kleppe & Liesenfeld 2021, *J. Comput. Graph. Stat.* 30, 906–919).
"""

from __future__ import annotations

import numpy as np

from fmu.posterior.joint.conditional.scores import REGULAR, Linear, ScoresGivenMain
from fmu.posterior.priors.joint import JointPrior
from fmu.posterior.problem import UpdatingProblem
from fmu.posterior.scaled import ScaledDensity
from fmu.types import FloatArray, IntArray

_STEP, _CURVATURE = 1e-4, 2.0
_LEAST, _MOST = 1e-3, 1e3
"""Limits of the unit for a population's standard deviation, relative to its typical value."""


class MarginalOfMain:
    """Approximate density of the main parameters with the scores integrated out, at given error parameters.

    The density is expressed in coordinates w. A population's standard deviation s has w = arsinh(s/c), where c is
    the typical standard deviation of a parameter value given only its own test's data. A partial correlation ρ has
    w = artanh(ρ). For every other parameter, w is the scaled value.

    Parameters
    ----------
    problem : UpdatingProblem
        A problem with populations and standard normal scores.
    scores : ScoresGivenMain
    theta : ndarray, shape (1, ndim)
        A typical point.

    Attributes
    ----------
    columns : ndarray of int, shape (d,)
        Indices in theta of the main parameters without the error parameters, the outlier share, correlation times
        and dates of sudden losses.
    lower, upper : ndarray, shape (d,)
        Bounds of w.
    """

    def __init__(self, problem: UpdatingProblem, scores: ScoresGivenMain, theta: FloatArray) -> None:
        self.layout, self.given, of = problem.layout, scores, scores.scores
        outliers = self.layout.outliers
        times = [one.drawn.in_time.column for one in of.every if one.drawn.in_time is not None]
        others = [*of.columns[of.scored].tolist(), *(outliers.of_share if outliers else ())]
        others += [column for column in times if column is not None]
        losses = [one for value_of in self.layout.values_of if (one := value_of.sudden_loss) is not None]
        others += [one.date for one in losses]
        self.columns: IntArray = np.setdiff1d(np.arange(problem.n_structural), others)
        self.prior = JointPrior([problem.parameters[k] for k in self.columns])
        scaled = ScaledDensity(problem)
        self._offset, self._scale = scaled.offset[self.columns], scaled.scale[self.columns]
        place = {int(column): k for k, column in enumerate(self.columns)}
        copula = self.layout.correlation
        self._of_widths = np.stack([one.drawn.widths for one in of.every], axis=1)
        every = [(k, column) for k, one in enumerate(of.every) for column in np.unique(one.drawn.widths).tolist()]
        self._widths = np.array([place[column] for _, column in every])
        self._populations = [k for k, _ in every]
        self._partial = np.array([place[k] for k in (copula.columns if copula else ())], dtype=np.int64)
        self._units = self._units_of_widths(theta)
        self._low, self._high = scaled.theta_lower[self.columns], scaled.theta_upper[self.columns]
        self.lower, self.upper = (self._to_w(ends[None])[0] for ends in (self._low, self._high))

    def _units_of_widths(self, theta: FloatArray) -> FloatArray:
        linear, scored = self.given.linearise(theta), self.given.scores.scored
        left = np.einsum("tij,tji->ti", linear.inverse[0], linear.of_prior[0])
        columns = self.columns[self._widths]
        here = scored & (self._of_widths == columns[:, None, None])
        each = np.arange(len(columns)), self._populations
        removed = np.where(here, 1.0 - left, 0.0).sum(axis=1)[each] / here.sum(axis=1)[each]
        removed = np.clip(removed, _LEAST**2, 1.0 - _LEAST**2)
        widths = theta[0, columns]
        return np.asarray(widths * np.clip(np.sqrt((1.0 - removed) / removed), _LEAST, _MOST))

    def _to_w(self, main: FloatArray) -> FloatArray:
        w = (main - self._offset) / self._scale
        w[:, self._widths] = np.arcsinh(main[:, self._widths] / self._units)
        w[:, self._partial] = np.arctanh(main[:, self._partial])
        return w

    def coordinates(self, theta: FloatArray) -> FloatArray:
        """Return the coordinates w, shape (n, d), at theta (n, ndim)."""
        return self._to_w(theta[:, self.columns])

    def theta_at(self, w: FloatArray, theta: FloatArray) -> FloatArray:
        """Return a copy of theta with the main parameters set from w (n, d), clipped to the bounds."""
        main = self._offset + self._scale * w
        main[:, self._widths] = self._units * np.sinh(w[:, self._widths])
        main[:, self._partial] = np.tanh(w[:, self._partial])
        found = theta.copy()
        found[:, self.columns] = np.clip(main, self._low, self._high)
        return found

    def log_prob_and_grad(
        self, w: FloatArray, theta: FloatArray, scales: FloatArray = REGULAR
    ) -> tuple[FloatArray, FloatArray, Linear]:
        """Return the log-density (n,) at w, its gradient (n, d), and the linearised score densities.

        The log-density lacks a normalising constant. The gradient is exact if the bounds have no influence and the
        parameter values are linear functions of the scores.

        Parameters
        ----------
        w : ndarray, shape (n, d)
        theta : ndarray, shape (n, ndim)
            Supplies the inferred error parameters, and the main parameters that w does not contain.
        scales : ndarray, shape (n, n_tests, p), optional
            Prior standard deviations of the scores (`Linear`).
        """
        at = self.theta_at(w, theta)
        linear = self.given.linearise(at, scales)
        main = at[:, self.columns]
        value = np.einsum("nt->n", self.given.log_evidence(linear)) + self.prior.log_pdf(main)
        gradient = self._gradient(linear, at)[:, self.columns] + self.prior.log_pdf_gradient(main)
        by_w = np.broadcast_to(self._scale, w.shape).copy()
        of_width, rho = w[:, self._widths], main[:, self._partial]
        by_w[:, self._widths] = self._units * np.cosh(of_width)
        by_w[:, self._partial] = 1.0 - rho**2
        gradient = gradient * by_w
        gradient[:, self._widths] += np.tanh(of_width)
        gradient[:, self._partial] -= 2.0 * rho
        value = value + np.log(by_w[:, self._widths]).sum(axis=1) + np.log1p(-(rho**2)).sum(axis=1)
        return value, gradient, linear

    def rough_covariance(self, theta: FloatArray, scales: FloatArray = REGULAR) -> FloatArray:
        """Return a rough covariance matrix of w, shape (d, d): the inverse curvature at theta (1, ndim).

        The curvature is computed from gradient differences, and increased so that the inverse is finite.
        `_CURVATURE` is added for standard deviations, whose curvature may vanish near zero, and for correlations;
        for both, w is of order one. For every parameter, the reciprocal variance of a uniform distribution between
        the bounds is added.
        """
        w, d = self.coordinates(theta), len(self.columns)
        h = _STEP * np.minimum(1.0, np.minimum(w - self.lower, self.upper - w)[0])
        h = np.where(h > 0.0, h, _STEP)
        moves = np.concatenate([np.diag(h), -np.diag(h)])
        slopes = self.log_prob_and_grad(w + moves, np.repeat(theta, 2 * d, axis=0), scales)[1]
        hessian = (slopes[d:] - slopes[:d]) / (2.0 * h[:, None])
        values, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T))
        size = np.abs(values)
        added = 12.0 / (self.upper - self.lower) ** 2
        added[np.concatenate([self._widths, self._partial])] += _CURVATURE
        return np.linalg.inv((vectors * np.maximum(size, 1e-9 * size.max())) @ vectors.T + np.diag(added))

    def _gradient(self, linear: Linear, theta: FloatArray) -> FloatArray:
        """Return the gradient of the summed log-evidence with respect to the main parameters, shape (n, ndim).

        Entries for scores are meaningless, and entries for error parameters are zero.
        """
        of, n = self.given.scores, len(self.layout.parameters)
        moved = linear.slopes * linear.step
        pull = self.given.pull_of_values(linear)
        noise = np.zeros((*pull.shape[:2], theta.shape[1] - n))
        full = np.concatenate([linear.at, theta[:, n:]], axis=1)
        gradient = self.layout.gradient(full, np.concatenate([pull, noise], axis=2), np.arange(pull.shape[1]))
        left = np.einsum("ntij,ntji->nti", linear.inverse, linear.of_prior)
        by_log_slope = np.where(of.scored, pull[:, :, of.parameters] * moved - (1.0 - left), 0.0)
        for k, one in enumerate(of.every):
            of_slope, widths = by_log_slope[:, :, k], one.drawn.widths
            for column in np.unique(widths):
                gradient[:, column] += of_slope[:, widths == column].sum(axis=1) / theta[:, column]
            if not one.drawn.family.of_logarithm:
                for slope in one.factor(linear.at)[1]:
                    terms = of_slope * slope.values
                    for column in np.unique(slope.columns):
                        gradient[:, column] += terms[:, slope.columns == column].sum(axis=1)
        copula = self.layout.correlation
        if copula is not None:
            z = linear.z + linear.step
            moments = linear.inverse + z[..., :, None] * z[..., None, :]
            if linear.scales is not REGULAR:
                moments = moments / (linear.scales[..., :, None] * linear.scales[..., None, :])
            gradient[:, list(copula.columns)] = copula.gradient_of_moments(linear.at, moments)
        return gradient
