"""Account for surrogate errors in the likelihood by averaging the density over the surrogate's distribution.

Let t(x) be an error model's log-density as a function of a mode's frequency and shape components x. The surrogate
predicts the expectation and the variance v_j of each x_j. With g = ∂t/∂x and h_j = Σ_r (∂r/∂x_j)² for the
residuals r, both at the expectation,

log E[exp t] ≈ t + Σ_j [½ g_j² v_j/(1 + h_j v_j) − ½ log(1 + h_j v_j)].

For independent Gaussian errors that are linear in the frequencies, the right-hand side is their log-density with
the variance σ² + v in place of σ². For other errors it is an approximation: h is not the curvature −∂²t/∂x² then.

The formula takes the errors of the x_j as independent in the density, as if each x_j had a residual of its own. If
one residual r depends on all x_j, such as 1 − MAC, its variance grows by S = Σ_j h_j v_j:

log E[exp t] ≈ t + ½ Σ_j g_j² v_j/(1 + S) − ½ log(1 + S).

This is exact for t = −½ r² and an r that is linear in x.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.errors.base import ErrorTerm, Evaluated, Residuals
from fmu.types import FloatArray

_STEP = 1e-5  # of the differences in an inferred error parameter, relative to its value


def evaluated_with_variance(
    term: ErrorTerm, seen: ModalPrediction, noise: FloatArray, gradient: bool
) -> Evaluated:
    """Return an error model's log-density terms for a prediction with variances; see `ErrorTerm.evaluate`.

    The derivatives with respect to the predicted frequencies and shapes use ∂g/∂x = −(∂r/∂x)ᵀ(∂r/∂x) and a
    constant h (Gauss–Newton). For inferred error parameters, the derivatives of the correction are central
    differences.
    """
    part, residuals = term.evaluate(seen, noise, True), term.residuals(seen, noise)
    terms = part.terms + _correction(part, residuals, seen)
    if not gradient:
        return Evaluated(terms)
    by_frequency, by_shape = part.by_frequency, part.by_shape
    by_frequency_variance = by_shape_variance = None
    pulled = np.zeros_like(residuals.values)  # Σ_j ∂r/∂x_j g_j v_j/(1 + h_j v_j), (n, n_modes, q)
    if by_frequency is not None and residuals.by_frequency is not None:
        h, v = np.sum(residuals.by_frequency**2, axis=2), np.asarray(seen.frequency_variance)
        by_frequency_variance = _by_variance(by_frequency, h, h * v)
        pulled += residuals.by_frequency * _gain(by_frequency, v, h * v)[..., None]
    if by_shape is not None and residuals.by_shape is not None:
        h, v = np.moveaxis(np.sum(residuals.by_shape**2, axis=2), 1, 2), np.asarray(seen.shape_variance)
        hv = _growth(h * v, residuals)
        by_shape_variance = _by_variance(by_shape, h, hv)
        pulled += np.einsum("nmqs,nsm->nmq", residuals.by_shape, _gain(by_shape, v, hv))
    if by_frequency is not None and residuals.by_frequency is not None:
        by_frequency = by_frequency - np.sum(residuals.by_frequency * pulled, axis=2)
    if by_shape is not None and residuals.by_shape is not None:
        by_shape = by_shape - np.einsum("nmqs,nmq->nsm", residuals.by_shape, pulled)
    by_noise = {k: slope + _by_noise(term, seen, noise, k) for k, slope in (part.by_noise or {}).items()}
    return Evaluated(terms, by_frequency, by_shape, by_noise, by_frequency_variance, by_shape_variance)


def residuals_with_variance(residuals: Residuals, seen: ModalPrediction) -> Residuals:
    """Return the residuals and their derivatives divided by √(1 + Σ_j (∂r/∂x_j)² v_j).

    This factor adds the surrogate's errors to the standard deviations; its own derivatives are neglected.
    """
    variance = np.ones_like(residuals.values)
    if residuals.by_frequency is not None and seen.frequency_variance is not None:
        variance += residuals.by_frequency**2 * seen.frequency_variance[..., None]
    if residuals.by_shape is not None and seen.shape_variance is not None:
        variance += np.einsum("nmqs,nsm->nmq", residuals.by_shape**2, seen.shape_variance)
    root = np.sqrt(variance)
    return Residuals(
        residuals.values / root,
        None if residuals.by_frequency is None else residuals.by_frequency / root,
        None if residuals.by_shape is None else residuals.by_shape / root[..., None],
    )


def sensitivity_to_model(term: ErrorTerm, seen: Any, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the sensitivity of the log-density to the model's error variances.

    For each frequency and shape component x_j, the sensitivity is g_j² + ½ h_j² v_j (see the module docstring) or,
    for a single residual, g_j² + ½ h_j S. This value times v_j is the variance of the log-density due to v_j, to
    second order.

    Parameters
    ----------
    term : ErrorTerm
    seen : ModalPrediction
        A prediction with variances, not projected.
    noise : ndarray, shape (n, n_noise)

    Returns
    -------
    of_frequency : ndarray, shape (n, n_modes), 1/Hz²
        Sensitivities to the variances of the frequencies; 0 if the error model does not use frequencies.
    of_shape : ndarray, shape (n, n_sensors, n_modes)
        Sensitivities to the variances of the shapes; 0 if the error model does not use shapes.
    """
    n, m = seen.frequencies.shape
    # the term of a mode may depend on the frequencies and shapes of other modes
    by_each, by_shape = (np.broadcast_to(np.eye(m), (*x.shape, m)) for x in (seen.frequencies, seen.shapes))
    slopes = {"frequency_slopes": by_each, "shape_slopes": np.zeros_like(by_shape)}
    view: Any = term.project(replace(seen, **slopes, shape_variance_slopes=by_shape))
    part, residuals = term.evaluate(view, noise, True), term.residuals(view, noise)
    of_frequency, of_shape = np.zeros((n, m)), np.zeros(seen.shapes.shape)
    if part.by_frequency is not None and residuals.by_frequency is not None:
        g = np.einsum("nm,nmj->nj", part.by_frequency, view.frequency_slopes)
        h = np.einsum("nm,nmj->nj", np.sum(residuals.by_frequency**2, axis=2), np.square(view.frequency_slopes))
        of_frequency = g**2 + 0.5 * h**2 * seen.frequency_variance
    if part.by_shape is not None and residuals.by_shape is not None:
        h = np.moveaxis(np.sum(residuals.by_shape**2, axis=2), 1, 2)
        of_each = part.by_shape**2 + 0.5 * h * _growth(h * view.shape_variance, residuals)
        of_shape = np.einsum("nsm,nsmj->nsj", of_each, view.shape_variance_slopes)
    return of_frequency, of_shape


def _correction(part: Evaluated, residuals: Residuals, seen: Any) -> FloatArray:
    """Return the correction log E[exp t] − t of each mode's log-density t, shape (n, n_modes)."""
    total = np.zeros_like(part.terms)
    if part.by_frequency is not None and residuals.by_frequency is not None:
        h = np.sum(residuals.by_frequency**2, axis=2)
        v = seen.frequency_variance
        total += _of_one(part.by_frequency**2 * v, h * v)
    if part.by_shape is not None and residuals.by_shape is not None:
        h = np.moveaxis(np.sum(residuals.by_shape**2, axis=2), 1, 2)
        v = seen.shape_variance
        squares = part.by_shape**2 * v
        total += np.sum(_of_one(_growth(squares, residuals), _growth(h * v, residuals)), axis=1)
    return total


def _growth(each: FloatArray, residuals: Residuals) -> FloatArray:
    """Return values of a mode's shape components, (n, n_sensors, n_modes), summed if it has a single residual.

    The sums have shape (n, 1, n_modes).
    """
    return np.sum(each, axis=1, keepdims=True) if residuals.values.shape[2] == 1 else each


def _of_one(squares: FloatArray, hv: FloatArray) -> FloatArray:
    return np.asarray(0.5 * squares / (1.0 + hv) - 0.5 * np.log1p(hv))


def _gain(g: FloatArray, v: FloatArray, hv: FloatArray) -> FloatArray:
    return np.asarray(g * v / (1.0 + hv))


def _by_variance(g: FloatArray, h: FloatArray, hv: FloatArray) -> FloatArray:
    scaled = 1.0 + hv
    return np.asarray(0.5 * (g / scaled) ** 2 - 0.5 * h / scaled)


def _by_noise(term: ErrorTerm, seen: ModalPrediction, noise: FloatArray, k: int) -> FloatArray:
    """Return the correction's derivative, (n, n_modes), with respect to the inferred error parameter `k`."""
    step = _STEP * noise[:, k]
    values = []
    for sign in (1.0, -1.0):
        moved = noise.copy()
        moved[:, k] += sign * step
        values.append(_correction(term.evaluate(seen, moved, True), term.residuals(seen, moved), seen))
    return (values[0] - values[1]) / (2.0 * step)[:, None]
