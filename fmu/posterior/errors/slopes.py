"""Chain rule for error models: differentiate their log-densities and residuals with respect to the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fmu.fem.pairing.prediction import ModalPrediction
from fmu.posterior.errors.base import ErrorTerm, Evaluated
from fmu.posterior.errors.surrogate_variance import residuals_with_variance
from fmu.types import Chain, FloatArray, IntArray


def split_by_term(terms: Sequence[ErrorTerm], of_residuals: FloatArray) -> list[FloatArray]:
    """Split an array (n, n_modes, k, …), where k counts all residuals of a mode, into one part per error model."""
    return np.split(of_residuals, np.cumsum([len(term.labels([""])) for term in terms])[:-1], axis=2)


def chain_prediction(seen: ModalPrediction, chain: Chain, test: IntArray) -> ModalPrediction:
    """Return a prediction whose derivatives are with respect to the parameters of all tests.

    The array `test` has the index of each mode's test. The prediction must have no variances, as is
    always the case for a model with several tests.
    """
    by_shape = seen.shape_slopes
    if by_shape is not None:
        by_shape = np.stack([chain(by_shape[:, s], test) for s in range(by_shape.shape[1])], axis=1)
    return replace(seen, frequency_slopes=chain(np.asarray(seen.frequency_slopes), test), shape_slopes=by_shape)


def nan_unless_finite(slopes: FloatArray) -> FloatArray:
    """Replace infinite derivatives by NaN, in place: samplers reject both, but sums of infinities may warn."""
    finite = np.isfinite(slopes)
    if np.count_nonzero(finite) < finite.size:
        slopes[~finite] = np.nan
    return slopes


def gradient_of_terms(part: Evaluated, seen: ModalPrediction, n_structural: int, n_noise: int) -> FloatArray:
    """Return the gradient of an error model's log-densities, (n, n_modes, n_structural + n_noise).

    If the prediction has derivatives, the length of their last axis is used in place of `n_structural`.
    """
    n = n_structural if seen.frequency_slopes is None else seen.frequency_slopes.shape[-1]
    gradient = np.zeros((*part.terms.shape, n + n_noise))
    leading = gradient[..., :n]
    if part.by_frequency is not None and seen.frequency_slopes is not None:
        leading += part.by_frequency[..., None] * seen.frequency_slopes
    if part.by_shape is not None and seen.shape_slopes is not None:
        # summed in the same order whatever the batch size
        leading += np.einsum("nsm,nsmk->nmk", part.by_shape, seen.shape_slopes)
    if part.by_frequency_variance is not None and seen.frequency_variance_slopes is not None:
        leading += part.by_frequency_variance[..., None] * seen.frequency_variance_slopes
    if part.by_shape_variance is not None and seen.shape_variance_slopes is not None:
        leading += np.einsum("nsm,nsmk->nmk", part.by_shape_variance, seen.shape_variance_slopes)
    for k, slope in (part.by_noise or {}).items():
        gradient[..., n + k] += slope
    return gradient


def residuals_of_term(
    term: ErrorTerm, seen: ModalPrediction, noise: FloatArray, within: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Return an error model's residuals, (n, n_modes, q), and their derivatives.

    The derivatives are with respect to the model's parameters, (n, n_modes, q, n_structural), or the number 0 if
    the prediction has no derivatives. If `within` is True, they are the derivatives of
    `ErrorTerm.residuals_within`. The inferred standard deviations `noise`, (n, n_noise), stay fixed. If the model
    is uncertain, its variances increase the errors' standard deviations.
    """
    view = term.project(seen)
    r = term.residuals_within(view, noise) if within else term.residuals(view, noise)
    if view.frequency_variance is not None:
        r = residuals_with_variance(r, view)
    parts = []
    if r.by_frequency is not None and view.frequency_slopes is not None:
        parts.append(r.by_frequency[..., None] * view.frequency_slopes[:, :, None])
    if r.by_shape is not None and view.shape_slopes is not None:
        parts.append(np.einsum("nmqs,nsmk->nmqk", r.by_shape, view.shape_slopes))
    return r.values, parts[0] if len(parts) == 1 else np.asarray(sum(parts))


def without_shapes(frequencies: FloatArray, slopes: FloatArray | None = None) -> ModalPrediction:
    """Return a prediction with frequencies only, (n, n_modes), and their derivatives if `slopes` is given."""
    return ModalPrediction(frequencies, np.empty((len(frequencies), 0, frequencies.shape[1])), slopes)
