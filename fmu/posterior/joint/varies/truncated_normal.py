"""Values, scores and log-density of a normal distribution truncated to bounds, with derivatives."""

from __future__ import annotations

import numpy as np
from scipy.special import log_ndtr, ndtri_exp

from fmu.types import FloatArray

Slopes = tuple[FloatArray, FloatArray, FloatArray]

_HALF_LOG_2PI = 0.5 * float(np.log(2.0 * np.pi))


def truncated_normal_values(
    z: FloatArray, mean: FloatArray, sd: FloatArray, lower: float, upper: float
) -> tuple[FloatArray, Slopes]:
    """Return x = F⁻¹(Φ(z)) for the normal distribution F truncated to the bounds, and ∂x/∂z, ∂x/∂mean, ∂x/∂sd.

    x = mean + sd q, where Φ(q) = Φ(α) Φ(−z) + Φ(β) Φ(z), α = (lower − mean)/sd and β = (upper − mean)/sd.

    Parameters
    ----------
    z, mean, sd : ndarray, broadcastable
    lower, upper : float
    """
    if np.isneginf(lower) and np.isposinf(upper):
        shape = np.broadcast_shapes(z.shape, mean.shape, sd.shape)
        return mean + sd * z, tuple(np.broadcast_to(x, shape) for x in (sd, np.ones(1), z))  # type: ignore[return-value]
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
    x: FloatArray, mean: FloatArray, sd: FloatArray, lower: float, upper: float
) -> tuple[FloatArray, Slopes]:
    """Return the log-density of the truncated normal distribution, and its derivatives by x, mean and sd.

    Parameters
    ----------
    x : ndarray
        Values within the bounds.
    mean, sd : ndarray, broadcastable
    lower, upper : float
    """
    a = (x - mean) / sd
    value = -0.5 * a**2 - np.log(sd) - _HALF_LOG_2PI
    by_x, by_mean, by_sd = -a / sd, a / sd, (a**2 - 1.0) / sd
    if np.isneginf(lower) and np.isposinf(upper):
        return value, (by_x, by_mean, by_sd)
    with np.errstate(over="ignore", invalid="ignore", under="ignore", divide="ignore"):
        alpha, beta = (lower - mean) / sd, (upper - mean) / sd
        log_mass = _log_mass(alpha, beta)
        at_lower = np.exp(-0.5 * alpha**2 - _HALF_LOG_2PI - log_mass)  # densities at the bounds, times sd
        at_upper = np.exp(-0.5 * beta**2 - _HALF_LOG_2PI - log_mass)
        moved = np.where(np.isfinite(beta), at_upper * beta, 0.0) - np.where(
            np.isfinite(alpha), at_lower * alpha, 0.0
        )
        return value - log_mass, (by_x, by_mean + (at_upper - at_lower) / sd, by_sd + moved / sd)


def truncated_normal_scores(
    x: FloatArray, mean: FloatArray, sd: FloatArray, lower: float, upper: float
) -> FloatArray:
    """Return z = Φ⁻¹(F(x)) for the truncated normal distribution F, the inverse of `truncated_normal_values`."""
    with np.errstate(over="ignore", invalid="ignore", under="ignore", divide="ignore"):
        a, alpha, beta = (x - mean) / sd, (lower - mean) / sd, (upper - mean) / sd
        total = _log_mass(alpha, beta)
        below, above = _log_mass(alpha, a) - total, _log_mass(a, beta) - total
        return np.where(below < above, ndtri_exp(np.minimum(below, 0.0)), -ndtri_exp(np.minimum(above, 0.0)))


def _log_mass(alpha: FloatArray, beta: FloatArray) -> FloatArray:
    """Return log(Φ(β) − Φ(α)), computed in the nearer tail."""
    turned = alpha > 0.0
    a, b = np.where(turned, -beta, alpha), np.where(turned, -alpha, beta)
    return np.asarray(log_ndtr(b) + np.log(-np.expm1(np.minimum(log_ndtr(a) - log_ndtr(b), 0.0))))
