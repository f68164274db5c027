"""Density of each test's scores given the main parameters, if scores in different tests are independent.

The posterior density of test t's scores z_t, given the main parameters, is proportional to

    L_t(θ_t(main, z_t)) p(z_t | main),

where L_t is the likelihood of the test's data and θ_t are the structural parameters in the test.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmu.posterior.joint.conditional.bend import Bend, Curve
from fmu.posterior.joint.conditional.expansion import Expansion
from fmu.posterior.joint.layout import Layout
from fmu.posterior.joint.varies.base import InTests, Slope, sum_by_test
from fmu.posterior.joint.varies.drawn import Drawn
from fmu.types import BoolArray, FloatArray, IntArray

_FAR = 6.0
"""Largest absolute score at an expansion point, in population standard deviations."""
REGULAR: FloatArray = np.ones((1, 1, 1))
"""Prior standard deviations of the scores without outliers."""
_STRAIGHT: FloatArray = np.zeros(1)
"""Curvature of straight ridges."""
_INSIDE = 1e-9
"""Smallest distance between an expansion point and a bound, relative to the distance between the bounds."""


class Scattering(NamedTuple):
    """A structural parameter that scatters over the tests. Its values are draws from a population times a factor.

    Attributes
    ----------
    value_of : InTests
        The values in the tests.
    drawn : Drawn
        The values before the factor is applied.
    """

    value_of: InTests
    drawn: Drawn

    def factor(self, theta: FloatArray) -> tuple[FloatArray, list[Slope]]:
        """Return the factor on the values, (n, n_tests) or (1, 1), and the derivatives of its logarithm."""
        factors = self.value_of.factors(theta)
        slopes = [Slope(s.columns, s.values / one.values) for one in factors for s in one.slopes]
        return np.prod([one.values for one in factors], axis=0) if factors else np.ones((1, 1)), slopes

    def clip(self, theta: FloatArray, values: FloatArray) -> FloatArray:
        """Return the values without the factor, (n, n_tests), for `values` (n_tests,), clipped to the bounds."""
        low, high = self.drawn.family.lower, self.drawn.family.upper
        margin = _INSIDE * (high - low) if np.isfinite(high - low) else 0.0
        with np.errstate(divide="ignore"):  # a factor may be as good as 0 far from the draws
            base = np.clip(values / self.factor(theta)[0], low + margin, high - margin)
        return np.broadcast_to(base, (len(theta), len(values)))

    def slope(self, theta: FloatArray) -> FloatArray:
        """Return the derivatives of values with respect to scores, (n, n_tests), at theta (n, n_parameters)."""
        return self.of_score(self.value_of(theta)[1])

    def of_score(self, slopes: list[Slope]) -> FloatArray:
        """Select the derivatives with respect to the scores, (n, n_tests), from all derivatives of the values."""
        return next(slope.values for slope in slopes if slope.columns is self.drawn.columns)


class Scores(NamedTuple):
    """Scores of a layout, arranged by test and by its p populations.

    Attributes
    ----------
    every : tuple of Scattering
        The parameters that scatter.
    parameters : ndarray of int, shape (p,)
        Indices of these parameters among the structural parameters.
    columns : ndarray of int, shape (n_tests, p)
        Index of each score in theta; meaningless where there is no score.
    scored : ndarray of bool, shape (n_tests, p)
        Whether the test has the score.
    """

    every: tuple[Scattering, ...]
    parameters: IntArray
    columns: IntArray
    scored: BoolArray

    @classmethod
    def of(cls, layout: Layout) -> Scores:
        """Collect the scores of a layout with populations."""
        numbers = [j for j, one in enumerate(layout.values_of) if isinstance(one.base, Drawn)]
        every = tuple(Scattering(layout.values_of[j], of) for j, of in zip(numbers, layout.drawn, strict=True))
        columns = np.stack([one.columns for one in layout.drawn], axis=1)
        return cls(every, np.array(numbers), columns, np.stack([one.scored for one in layout.drawn], axis=1))

    def take(self, theta: FloatArray) -> FloatArray:
        """Return the scores at theta (n, ndim), shape (n, n_tests, p); zero where there is no score."""
        return np.where(self.scored, theta[:, self.columns], 0.0)

    def put(self, theta: FloatArray, z: FloatArray) -> FloatArray:
        """Return a copy of theta (n, ndim) with its scores set to z, shape (n, n_tests, p)."""
        found = theta.copy()
        found[:, self.columns[self.scored]] = z[:, self.scored]
        return found


class Linear(NamedTuple):
    """Each test's score density when the parameter values are linear in the scores about a centre.

    Attributes
    ----------
    at : ndarray, shape (n, n_parameters)
        Theta with the scores at the centre.
    z : ndarray, shape (n, n_tests, p)
        Scores at the centre.
    slopes : ndarray, shape (n, n_tests, p)
        Derivatives of parameter values with respect to scores.
    step : ndarray, shape (n, n_tests, p)
        The most probable scores minus `z`.
    largest : ndarray, shape (n, n_tests)
        Log-likelihood − ½ zᵀ P z at the most probable scores, where P is `of_prior`. The log-likelihood is
        relative to the expansion point.
    pull : ndarray, shape (n, n_tests, n_structural)
        Log-likelihood gradients with respect to the parameter values, at the centre.
    information : ndarray, shape (n, n_tests, n_structural, n_structural) or (1, …)
        The information of each test on the parameter values, given the model errors if there are any.
    weight : ndarray, shape (n, n_tests, 1) or (1, 1, 1)
        Factors from `Expansion.weigh`.
    factor, inverse : ndarray, shape (n, n_tests, p, p)
        Cholesky factors of the score precision matrices given the data, and the inverse precision matrices.
    of_prior : ndarray, shape (n, n_tests, p, p)
        Prior precision matrices of the scores.
    scales : ndarray, shape (n, n_tests, p) or (1, 1, 1)
        Prior standard deviations of the scores. They differ from 1 only for outliers.
    """

    at: FloatArray
    z: FloatArray
    slopes: FloatArray
    step: FloatArray
    largest: FloatArray
    pull: FloatArray
    information: FloatArray
    weight: FloatArray
    factor: FloatArray
    inverse: FloatArray
    of_prior: FloatArray
    scales: FloatArray

    def select(self, chosen: BoolArray, other: Linear) -> Linear:
        """Return these densities for the chains in which `chosen` (n,) is True, and `other` for the rest."""
        every = zip(self, other, strict=True)
        return Linear(*(np.where(chosen.reshape(-1, *(1,) * (x.ndim - 1)), x, y) for x, y in every))

    @property
    def log_det_factor(self) -> FloatArray:
        """Log-determinant of `factor`, the Cholesky factors of the precision matrices, shape (n, n_tests)."""
        return _log_det(self.factor)


class Normal(NamedTuple):
    """Normal distribution of each test's straightened scores.

    Attributes
    ----------
    mean : ndarray, shape (n, n_tests, p)
    factor : ndarray, shape (n, n_tests, p, p)
        Cholesky factor of the precision matrix.
    scored : ndarray of bool, shape (n_tests, p)
        Whether the test has the score. A missing score has zero mean and unit precision.
    curve : Curve, optional
        Maps straightened scores to scores. If it is None, the two are equal.
    """

    mean: FloatArray
    factor: FloatArray
    scored: BoolArray
    curve: Curve | None

    def bend(self, z: FloatArray) -> FloatArray:
        """Map straightened scores z to scores, both of shape (n, n_tests, p)."""
        return z if self.curve is None else self.curve.bend(z)

    def straighten(self, z: FloatArray) -> FloatArray:
        """Map scores z to straightened scores, both of shape (n, n_tests, p)."""
        return z if self.curve is None else self.curve.straighten(z)

    def scatter(self, noise: FloatArray) -> FloatArray:
        """Turn standard normal `noise` into deviations from the mean; both have shape (n, n_tests, p)."""
        return np.asarray(np.linalg.solve(np.swapaxes(self.factor, 2, 3), noise[..., None])[..., 0])

    def standardise(self, z: FloatArray) -> FloatArray:
        """Transform scores z to independent standard normal numbers, shape (n, n_tests, p)."""
        return np.einsum("ntji,ntj->nti", self.factor, self.straighten(z) - self.mean)

    def restore(self, u: FloatArray) -> FloatArray:
        """Transform standard normal numbers u to scores, shape (n, n_tests, p); the inverse of `standardise`."""
        return self.bend(self.mean + self.scatter(u))

    def draw(self, rng: np.random.Generator, nu: float) -> FloatArray:
        """Draw straightened scores, (n, n_tests, p), from the Student's t distributions of `log_density`.

        `nu` must be finite.
        """
        heavy = np.sqrt(nu / rng.chisquare(nu, self.mean.shape[:2]))
        return self.mean + self.scatter(heavy[..., None] * rng.standard_normal(self.mean.shape) * self.scored)

    def select(self, chosen: BoolArray, other: Normal) -> Normal:
        """Return these distributions for the tests that are `chosen`, (n, n_tests), and `other` for the rest.

        Both must have the same curve.
        """
        mean = np.where(chosen[..., None], self.mean, other.mean)
        factor = np.where(chosen[..., None, None], self.factor, other.factor)
        return self._replace(mean=mean, factor=factor)

    @property
    def log_det_factor(self) -> FloatArray:
        """Log-determinant of `factor`, (n, n_tests)."""
        return _log_det(self.factor)

    def log_density(self, z: FloatArray, nu: float = np.inf) -> FloatArray:
        """Return the log-density of each test's straightened scores z, shape (n, n_tests).

        `log_det_factor` and a constant are left out. If `nu` is finite, use Student's t with nu degrees of freedom
        and the same mean and factor.
        """
        turned = np.einsum("ntji,ntj->nti", self.factor, z - self.mean)
        square = np.einsum("nti,nti->nt", turned, turned)
        if np.isinf(nu):
            return -0.5 * square
        return -0.5 * (nu + self.scored.sum(axis=1)) * np.log1p(square / nu)


class ScoresGivenMain:
    """Density of the scores given the main parameters, and its normal approximation.

    Parameters
    ----------
    layout : Layout
        A layout with populations and standard normal scores (`Layout.remove_centring`). Scores in different tests
        are independent.
    expansion : Expansion
    bend : Bend, optional
        Parabolas along which the score densities are curved; if it is None, the ridges are straight.
    curvature : ndarray, shape (n_tests,) or (1,)
        Largest absolute coefficient of each test's parabolas; 0 by default. It may be nonzero although `bend` is
        None, if all ridges are nearly straight.
    """

    def __init__(
        self, layout: Layout, expansion: Expansion, bend: Bend | None = None, curvature: FloatArray = _STRAIGHT
    ) -> None:
        self.layout, self.expansion, self.scores = layout, expansion, Scores.of(layout)
        self.bend, self.curvature = bend, curvature

    def log_prior(self, theta: FloatArray, scales: FloatArray = REGULAR) -> FloatArray:
        """Return the log-prior of each test's scores, shape (n, n_tests), given the main parameters and `scales`.

        Constants, and terms that depend only on the scales, are left out. `scales` is as in `Linear`.
        """
        z = self.scores.take(theta) / scales
        found = -0.5 * np.einsum("ntp,ntp->nt", z, z)
        if self.layout.correlation is not None:
            found += self.layout.correlation.log_density(theta, z)[0]
        return found

    def linearise(self, theta: FloatArray, scales: FloatArray = REGULAR) -> Linear:
        """Linearise the parameter values in the scores, at the main parameters in theta (n, ndim).

        The values are linearised about the scores at which they are nearest to the values at the expansion point.
        These scores are limited to ±`_FAR`. `scales` is as in `Linear`.
        """
        numbers, scored, noise = (
            self.scores.parameters,
            self.scores.scored,
            theta[:, len(self.layout.parameters) :],
        )
        known = self.expansion.given_errors(noise)
        of = theta[:, : len(self.layout.parameters)]
        pairs = zip(self.scores.every, known.values.T[numbers], strict=True)
        nearest = [one.clip(of, values) for one, values in pairs]
        z = np.stack(self.layout.batch.scores(nearest, of), axis=2)
        z = np.where(scored, np.clip(z, -_FAR, _FAR), 0.0)
        at = self.scores.put(of, z)
        values = [value_of(at) for value_of in self.layout.values_of]
        by_score = [one.of_score(values[j][1]) for j, one in zip(numbers, self.scores.every, strict=True)]
        slopes = np.where(scored, np.stack(by_score, axis=2), 0.0)
        away = np.stack([value for value, _ in values], axis=2) - known.values
        weight = known.weigh(noise)
        turned = np.einsum("ntij,ntj->nti", known.information, away)
        value = weight[..., 0] * np.einsum("nti,nti->nt", away, known.slope - 0.5 * turned)
        gradient = weight * (known.slope - turned)
        precision = known.information[..., numbers[:, None], numbers] * slopes[..., :, None] * slopes[..., None, :]
        precision = weight[..., None] * precision
        of_prior = self._precision_of_prior(of, scales, precision.shape)
        pull = np.einsum("ntij,ntj->nti", of_prior, z)
        total = slopes * gradient[:, :, numbers] - pull
        value = value - 0.5 * np.einsum("nti,nti->nt", z, pull)
        precision = precision + of_prior
        factor, inverse = np.linalg.cholesky(precision), np.linalg.inv(precision)
        step = np.einsum("ntij,ntj->nti", inverse, total)
        value = value + 0.5 * np.einsum("nti,nti->nt", total, step)
        return Linear(
            at, z, slopes, step, value, gradient, known.information, weight, factor, inverse, of_prior, scales
        )

    def _precision_of_prior(self, of: FloatArray, scales: FloatArray, shape: tuple[int, ...]) -> FloatArray:
        """Return `Linear.of_prior`, with the given `shape`; `of` is theta without the error parameters."""
        found = np.broadcast_to(np.eye(shape[-1]), shape)
        if self.layout.correlation is not None:
            found = found + self.layout.correlation.precision(of)
        return found if scales is REGULAR else found / (scales[..., :, None] * scales[..., None, :])

    def approximate_here(
        self, theta: FloatArray, r: FloatArray, J: FloatArray, test: IntArray, scales: FloatArray = REGULAR
    ) -> Normal:
        """Return normal approximations of the score densities.

        At the scores in theta, an approximation has the same gradient as the score density. Its mean is the result
        of a Gauss–Newton step from these scores. In a test whose solve failed, the approximation is a standard
        normal distribution about the scores.

        Parameters
        ----------
        theta : ndarray, shape (n, ndim)
        r, J : ndarray, shapes (n, n_residuals) and (n, n_residuals, n_structural)
            Residuals at theta, divided by their standard deviations, and their derivatives with respect to the
            parameter values in their tests.
        test : ndarray of int, shape (n_residuals,)
            Index of each residual's test.
        scales : ndarray
            As in `Linear`.
        """
        of, z, own = self.scores, self.scores.take(theta), theta[:, : len(self.layout.parameters)]
        n_tests = z.shape[1]
        slopes = np.where(of.scored, np.stack([one.slope(own) for one in of.every], axis=2), 0.0)
        J = J[..., of.parameters] * slopes[:, test]
        precision = sum_by_test(J[..., :, None] * J[..., None, :], test, n_tests)
        of_prior = self._precision_of_prior(own, scales, precision.shape)
        gradient = -sum_by_test(J * r[..., None], test, n_tests) - np.einsum("ntij,ntj->nti", of_prior, z)
        precision = precision + of_prior
        finite = np.isfinite(gradient).all(axis=2) & np.isfinite(precision).all(axis=(2, 3))
        precision = np.where(finite[..., None, None], precision, np.eye(z.shape[2]))
        step = np.linalg.solve(precision, np.where(finite[..., None], gradient, 0.0)[..., None])[..., 0]
        return Normal(z + step, np.linalg.cholesky(precision), of.scored, None)

    def log_evidence(self, linear: Linear) -> FloatArray:
        """Return each test's log-evidence, shape (n, n_tests).

        The evidence is the test's likelihood averaged over the prior of its scores. Constants, and a term that
        depends only on the scales, are left out of its logarithm.
        """
        found, copula = linear.largest - linear.log_det_factor, self.layout.correlation
        return found if copula is None else found - 0.5 * copula.log_det(linear.at)

    def pull_of_values(self, linear: Linear) -> FloatArray:
        """Return the gradient of `log_evidence` with respect to the P parameter values, shape (n, n_tests, P).

        The derivatives of values with respect to scores are treated as constant.
        """
        of_scores = linear.information[..., self.scores.parameters]
        return linear.pull - linear.weight * np.einsum("ntij,ntj->nti", of_scores, linear.slopes * linear.step)

    def information_on_values(self, linear: Linear) -> FloatArray:
        """Return minus the second derivatives of `log_evidence` with respect to values, (n, n_tests, P, P).

        As in `pull_of_values`, the derivatives of values with respect to scores are treated as constant.
        """
        cross = linear.information[..., self.scores.parameters] * linear.slopes[..., None, :]
        cross = linear.weight[..., None] * cross
        explained = cross @ linear.inverse @ np.swapaxes(cross, 2, 3)
        return linear.weight[..., None] * linear.information - explained

    def approximate(self, theta: FloatArray, scales: FloatArray = REGULAR) -> Normal:
        """Return the normal approximation of the score density at the main parameters in theta (n, ndim).

        The likelihood is expanded to second order, and the parameter values are linearised in the scores. `scales`
        is as in `Linear`.
        """
        return self.normal_of(self.linearise(theta, scales))

    def normal_of(self, linear: Linear) -> Normal:
        """Return the normal approximation of the score density for linearised values."""
        curve, scored = None, self.scores.scored
        if self.bend is not None:
            curve = Curve(self.bend, linear.z, np.where(scored, linear.slopes / self.bend.slopes, 1.0))
        return Normal(linear.z + linear.step, linear.factor, scored, curve)


def _log_det(factor: FloatArray) -> FloatArray:
    """Return the log-determinants of triangular matrices (n, n_tests, p, p), shape (n, n_tests)."""
    return np.asarray(np.log(np.einsum("ntii->nti", factor)).sum(axis=2))
