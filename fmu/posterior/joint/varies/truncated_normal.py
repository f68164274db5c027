"""Normal and log-normal distributions truncated to bounds: values, scores and log-density, with derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import log_ndtr, ndtri_exp

from fmu.types import BoolArray, FloatArray

Normals = tuple[FloatArray, FloatArray]
"""Centre and standard deviation of normal distributions."""
Slopes = tuple[FloatArray, FloatArray, FloatArray]
"""Derivatives with respect to value or score, centre and standard deviation."""
Bound = FloatArray | float
"""Bound of one distribution, or bounds of several that can be broadcast against the values."""

_DISTANT, _CENTRAL = 12.0, 6.0
"""Bounds 12 standard deviations from the mean have no influence, beyond rounding, on scores up to 6."""
_HALF_LOG_2PI = 0.5 * float(np.log(2.0 * np.pi))


def truncated_normal_values(
    z: FloatArray, mean: FloatArray, sd: FloatArray, lower: Bound, upper: Bound
) -> tuple[FloatArray, Slopes]:
    """Return x = F⁻¹(Φ(z)) for the normal distribution F truncated to the bounds, and ∂x/∂z, ∂x/∂mean, ∂x/∂sd.

    The derivatives can be broadcast to the shape of x.

    x = mean + sd q, where Φ(q) = Φ(α) Φ(−z) + Φ(β) Φ(z), α = (lower − mean)/sd and β = (upper − mean)/sd.

    Parameters
    ----------
    z, mean, sd : ndarray, broadcastable
    lower, upper : float or ndarray, broadcastable
    """
    value = mean + sd * z
    near = _find_near(z, mean, sd, lower, upper)
    if near is None:
        return value, (sd, np.ones((1,) * value.ndim), z)
    z, mean, sd, near = np.broadcast_arrays(z, mean, sd, near)
    slopes = (sd.copy(), np.ones(z.shape), z.copy())
    lower, upper = _select(near, lower, upper)
    value[near], of_near = _values_near_bounds(z[near], mean[near], sd[near], lower, upper)
    for slope, one in zip(slopes, of_near, strict=True):
        slope[near] = one
    return value, slopes


def _find_near(
    z: FloatArray | float, mean: FloatArray, sd: FloatArray, lower: Bound, upper: Bound
) -> BoolArray | None:
    """Return a mask of the values that the bounds may influence, or None if there are no such values."""
    if np.all(np.isneginf(lower)) and np.all(np.isposinf(upper)):
        return None
    near = ~are_bounds_distant(z, mean, sd, lower, upper)
    return near if np.any(near) else None


def _select(mask: BoolArray, *ends: Bound) -> list[Bound]:
    """Return the bounds of the values in `mask`."""
    return [end if np.ndim(end) == 0 else np.broadcast_to(end, mask.shape)[mask] for end in ends]


def are_bounds_distant(
    z: FloatArray | float,
    mean: FloatArray,
    sd: FloatArray,
    lower: Bound,
    upper: Bound,
) -> BoolArray:
    """Return a mask of the values on which the bounds certainly have no influence beyond rounding.

    These values have scores z between −6 and 6, and bounds at least 12 standard deviations from the mean.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        is_distant = np.minimum(mean - lower, upper - mean) >= _DISTANT * sd
        return np.asarray(is_distant & (np.abs(z) <= _CENTRAL))


def _values_near_bounds(
    z: FloatArray, mean: FloatArray, sd: FloatArray, lower: Bound, upper: Bound
) -> tuple[FloatArray, Slopes]:
    """Return the values and derivatives of `truncated_normal_values` where the bounds have an influence."""
    with np.errstate(over="ignore", divide="ignore", invalid="ignore", under="ignore"):
        alpha, beta = (lower - mean) / sd, (upper - mean) / sd
        # computed in the nearer tail, where the probability is not rounded to 1
        turned = z > 0.0
        a, b, t = np.where(turned, -beta, alpha), np.where(turned, -alpha, beta), -np.abs(z)
        log_p = np.logaddexp(log_ndtr(a) + log_ndtr(-t), log_ndtr(b) + log_ndtr(t))
        q = ndtri_exp(np.minimum(log_p, 0.0))
        log_phi = -0.5 * q**2
        by_a = np.exp(log_ndtr(-t) - 0.5 * a**2 - log_phi)  # ∂q/∂a and ∂q/∂b
        by_b = np.exp(log_ndtr(t) - 0.5 * b**2 - log_phi)
        by_t = np.exp(_log_mass(a, b) - 0.5 * t**2 - log_phi)
        moved = np.where(np.isfinite(a), by_a * a, 0.0) + np.where(np.isfinite(b), by_b * b, 0.0)
        sign = np.where(turned, -1.0, 1.0)
        q = sign * q
        return mean + sd * q, (sd * by_t, 1.0 - by_a - by_b, q - sign * moved)


def truncated_normal_log_pdf(
    x: FloatArray, mean: FloatArray, sd: FloatArray, lower: Bound, upper: Bound
) -> tuple[FloatArray, Slopes]:
    """Return the truncated normal log-density, and its derivatives with respect to x, mean and sd.

    Parameters
    ----------
    x : ndarray
        Values within the bounds.
    mean, sd : ndarray, broadcastable
    lower, upper : float or ndarray, broadcastable
    """
    a = (x - mean) / sd
    value = -0.5 * a**2 - np.log(sd) - _HALF_LOG_2PI
    slopes = -a / sd, a / sd, (a**2 - 1.0) / sd
    near = _find_near(0.0, mean, sd, lower, upper)
    if near is not None:
        mean, sd, near = np.broadcast_arrays(mean, sd, np.broadcast_to(near, value.shape))
        log_mass, by_mean, by_sd = _mass_between(mean[near], sd[near], *_select(near, lower, upper))
        value[near] -= log_mass
        slopes[1][near] += by_mean
        slopes[2][near] += by_sd
    return value, slopes


def _mass_between(mean: FloatArray, sd: FloatArray, lower: Bound, upper: Bound) -> Slopes:
    """Return the log-probability between the bounds, and minus its derivatives with respect to mean and sd."""
    with np.errstate(over="ignore", invalid="ignore", under="ignore", divide="ignore"):
        alpha, beta = (lower - mean) / sd, (upper - mean) / sd
        log_mass = _log_mass(alpha, beta)
        at_lower = np.exp(-0.5 * alpha**2 - _HALF_LOG_2PI - log_mass)  # densities at the bounds, times sd
        at_upper = np.exp(-0.5 * beta**2 - _HALF_LOG_2PI - log_mass)
        moved = np.where(np.isfinite(beta), at_upper * beta, 0.0) - np.where(
            np.isfinite(alpha), at_lower * alpha, 0.0
        )
        return log_mass, (at_upper - at_lower) / sd, moved / sd


def truncated_normal_scores(
    x: FloatArray, mean: FloatArray, sd: FloatArray, lower: Bound, upper: Bound
) -> FloatArray:
    """Return z = Φ⁻¹(F(x)) for the truncated normal distribution F; the inverse of `truncated_normal_values`."""
    z = (x - mean) / sd
    near = _find_near(z, mean, sd, lower, upper)
    if near is not None:
        mean, sd = np.broadcast_to(mean, z.shape)[near], np.broadcast_to(sd, z.shape)[near]
        lower, upper = _select(near, lower, upper)
        z[near] = _scores_near_bounds(z[near], (lower - mean) / sd, (upper - mean) / sd)
    return z


def _scores_near_bounds(a: FloatArray, alpha: FloatArray, beta: FloatArray) -> FloatArray:
    """Return the scores of standardised values `a` between the standardised bounds alpha and beta."""
    with np.errstate(over="ignore", invalid="ignore", under="ignore", divide="ignore"):
        total = _log_mass(alpha, beta)
        below, above = _log_mass(alpha, a) - total, _log_mass(a, beta) - total
        return np.where(below < above, ndtri_exp(np.minimum(below, 0.0)), -ndtri_exp(np.minimum(above, 0.0)))


def _log_mass(alpha: FloatArray, beta: FloatArray) -> FloatArray:
    """Return the log-probability log(Φ(β) − Φ(α)) between standardised bounds. It is accurate in both tails."""
    turned = alpha > 0.0
    a, b = np.where(turned, -beta, alpha), np.where(turned, -alpha, beta)
    return np.asarray(log_ndtr(b) + np.log(-np.expm1(np.minimum(log_ndtr(a) - log_ndtr(b), 0.0))))


@dataclass(frozen=True)
class TruncatedFamily:
    """The family of normal, or of log-normal, distributions truncated to given bounds.

    Attributes
    ----------
    of_logarithm : bool
        Whether the logarithm of a value is normal. The centre is then the median of the values before truncation.
    lower, upper : float or ndarray
        Bounds of the values; arrays for several distributions, which are broadcast against the values.
    """

    of_logarithm: bool
    lower: Bound
    upper: Bound

    @cached_property
    def _ends(self) -> tuple[Bound, Bound]:
        """Logarithms of the lower and upper bound."""
        with np.errstate(divide="ignore"):
            return np.log(np.maximum(self.lower, 0.0)), np.log(self.upper)

    def values(self, z: FloatArray, centre: FloatArray, sd: FloatArray) -> tuple[FloatArray, Slopes]:
        """Return the values for standard normal scores z, and their derivatives.

        The derivatives are with respect to score, centre and sd.

        Parameters
        ----------
        z, centre, sd : ndarray, broadcastable
            The values and all derivatives have the broadcast shape.
        """
        if not self.of_logarithm:
            value, slopes = truncated_normal_values(z, centre, sd, self.lower, self.upper)
            return value, tuple(np.broadcast_to(slope, value.shape) for slope in slopes)  # type: ignore[return-value]
        x, (by_z, by_m, by_s) = truncated_normal_values(z, np.log(centre), sd, *self._ends)
        value = np.exp(x)
        return value, (value * by_z, value * by_m / centre, value * by_s)

    def log_ratio(self, value: FloatArray, one: Normals, other: Normals) -> tuple[FloatArray, Slopes, Slopes]:
        """Return the log-ratio of two populations' densities at some values, with derivatives.

        Parameters
        ----------
        value : ndarray
        one, other : tuple of (ndarray, ndarray)
            Centre and standard deviation of the numerator's population, and of the denominator's population.

        Returns
        -------
        ratio : ndarray
        by_one, by_other : tuple of three ndarray
            Derivatives of the two log-densities with respect to value, centre and standard deviation. Subtract
            ``by_other`` from ``by_one`` to differentiate the ratio.
        """
        (p, by_p), (q, by_q) = (self.log_pdf(value, *of) for of in (one, other))
        return p - q, by_p, by_q

    def log_pdf(self, value: FloatArray, centre: FloatArray, sd: FloatArray) -> tuple[FloatArray, Slopes]:
        """Return the log-density of the value (log-normal: of its logarithm), and its derivatives.

        The derivatives are with respect to value, centre and sd.
        """
        if not self.of_logarithm:
            return truncated_normal_log_pdf(value, centre, sd, self.lower, self.upper)
        p, (by_x, by_m, by_s) = truncated_normal_log_pdf(np.log(value), np.log(centre), sd, *self._ends)
        return p, (by_x / value, by_m / centre, by_s)

    def scores(self, value: FloatArray, centre: FloatArray, sd: FloatArray) -> FloatArray:
        """Return the standard normal scores of the values; the inverse of `values`."""
        if not self.of_logarithm:
            return truncated_normal_scores(value, centre, sd, self.lower, self.upper)
        return truncated_normal_scores(np.log(value), np.log(centre), sd, *self._ends)
