"""How probable the measured modes are, given the computed ones: eq. (4) with its normaliser (5)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from fmu.fem.modes.modal import frequency_hz
from fmu.fem.pairing.paired_model import ModalModel
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.correlated import CorrelatedFrequencyError
from fmu.types import FloatArray


@dataclass(frozen=True, eq=False)
class FrequencyError:
    """Independent Gaussian errors ε_i = f_i − f_i^m in Hz, the paper's error model.

    log P(D|θ) = Σ_i (½ log(β_i/π) − β_i ε_i²), with β_i = 1/(2σ_i²). The normaliser makes it a density of the
    measured frequencies in Hz (eq. 5 with F = 1).

    Attributes
    ----------
    measured : ndarray, shape (n_modes,), Hz
    beta : ndarray, shape (n_modes,), 1/Hz²
        A scalar stands for the same value on every mode.

    Raises
    ------
    ValueError
        If a β is not positive and finite, or there are not as many as modes.
    """

    measured: FloatArray
    beta: ArrayLike = 1.0
    _rows: tuple[FloatArray, FloatArray, FloatArray] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        beta = np.array(self.beta, dtype=float)
        if beta.ndim > 1 or (beta.ndim == 1 and beta.shape != np.shape(self.measured)):
            raise ValueError(f"beta: must be a number or {len(self.measured)} numbers (got shape {beta.shape})")
        if not np.all(np.isfinite(beta) & (beta > 0)):
            raise ValueError(f"beta: must be positive and finite (got {beta.tolist()})")
        beta = np.broadcast_to(beta, np.shape(self.measured)).copy()
        object.__setattr__(self, "beta", beta)
        # as rows (1, n_modes), like the frequencies of one theta, which spares it NumPy's broadcasting
        rows = (0.5 * np.log(beta / np.pi)[None], beta[None], np.array(self.measured)[None])
        object.__setattr__(self, "_rows", rows)

    @property
    def sd(self) -> FloatArray:
        """Standard deviation σ_i of the measurement error, Hz."""
        return 1.0 / np.sqrt(2.0 * np.asarray(self.beta))

    def whitened(self, x: FloatArray) -> FloatArray:
        """Return `x` (n, n_modes, …) in Hz along the modes, in units of the standard errors: √(2β_i) x_i."""
        root = np.sqrt(2.0 * np.asarray(self.beta))
        return np.asarray(root.reshape(-1, *(1,) * (x.ndim - 2)) * x)

    def log_prob_terms(self, frequencies: FloatArray) -> FloatArray:
        """Return the log-likelihood of each mode, shape (…, n_modes), for frequencies of that shape in Hz."""
        normaliser, beta, measured = self._rows
        # in C order, in which the terms of a row are summed in the same order whatever the batch
        error = np.ascontiguousarray(frequencies) - measured
        with np.errstate(over="ignore"):
            return normaliser - beta * error**2

    def gradient(self, frequencies: FloatArray) -> FloatArray:
        """Return the derivative of the log-likelihood with respect to each frequency, shape (n, n_modes)."""
        return -2.0 * np.asarray(self.beta) * (frequencies - self.measured)

    def terms_gradient(self, frequencies: FloatArray, slopes: FloatArray) -> FloatArray:
        """Return the derivatives of the terms, given those of the frequencies: both (n, n_modes, ndim)."""
        return self.gradient(frequencies)[..., None] * slopes

    def simulate(self, rng: np.random.Generator, frequencies: FloatArray) -> FloatArray:
        """Return `frequencies` with measurement noise added."""
        return frequencies + self.sd * rng.standard_normal(np.shape(frequencies))

    def as_dict(self) -> dict[str, Any]:
        """Return name and settings."""
        return {"error": "frequency", "beta": np.asarray(self.beta).tolist()}


def frequency_error(data: ModalData, beta: ArrayLike | None = None) -> FrequencyError | CorrelatedFrequencyError:
    """Return the error model of measured frequencies.

    Parameters
    ----------
    data : ModalData
    beta : float or array_like, shape (n_modes,), optional
        1/Hz². If not given, the data's own uncertainty holds, and where they have none β = 1, the paper's.

    Raises
    ------
    ValueError
        If `beta` is given and the data have an uncertainty of their own, or it is not positive and finite.
    """
    measured = np.asarray(data.frequencies_hz)
    if beta is None:
        if data.covariance_hz2 is not None:
            return CorrelatedFrequencyError(measured, np.asarray(data.covariance_hz2))
        return FrequencyError(measured, 1.0 if data.sd_hz is None else 0.5 / np.asarray(data.sd_hz) ** 2)
    if data.sd_hz is not None or data.covariance_hz2 is not None:
        own = "sd_hz" if data.covariance_hz2 is None else "covariance_hz2"
        raise ValueError(f"beta: must not be given, as the data have {own} (got {beta})")
    return FrequencyError(measured, beta)


@dataclass(frozen=True, eq=False)
class FrequencyLikelihood:
    """A model's frequencies under an error model: the likelihood as a function of theta.

    Attributes
    ----------
    model : ModalModel
    error : FrequencyError or CorrelatedFrequencyError
    """

    model: ModalModel
    error: FrequencyError | CorrelatedFrequencyError

    of_modes: ClassVar[bool] = True
    needs_shapes: ClassVar[bool] = False
    simulates: ClassVar[bool] = True
    terms_name: ClassVar[str] = "frequency"

    @property
    def beta(self) -> FloatArray:
        """Coefficient β_i = 1/(2σ_i²) of each mode by itself, 1/Hz²."""
        return np.asarray(self.error.beta)

    def terms(self, theta: FloatArray) -> FloatArray:
        """Return the log-likelihood of each mode, shape (n, n_modes), at theta (n, ndim)."""
        return self.error.log_prob_terms(self.model.frequencies(theta))

    def terms_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the terms and their gradients, shape (n, n_modes, ndim)."""
        frequencies, slopes = self.model.frequencies_and_gradient(theta)
        return self.error.log_prob_terms(frequencies), self.error.terms_gradient(frequencies, slopes)

    def full_terms(self, theta: FloatArray) -> FloatArray:
        """Return `terms` by the full model, where a reduced one answers otherwise."""
        modes = self.model.full_modes(theta)  # type: ignore[attr-defined]
        return self.error.log_prob_terms(frequency_hz(modes.eigenvalues))

    def quadratic(self, theta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the log-likelihood (n,), its gradient (n, ndim) and the information JᵀJ (n, ndim, ndim)."""
        frequencies, slopes = self.model.frequencies_and_gradient(theta)
        J = self.error.whitened(slopes)
        value = self.error.log_prob_terms(frequencies).sum(axis=1)
        r = self.error.whitened(frequencies - self.error.measured)
        return value, -np.einsum("nm,nmk->nk", r, J), np.einsum("nmk,nml->nkl", J, J)

    def sensitivity(self, theta: FloatArray) -> FloatArray:
        """Return the slopes of the errors over their standard deviations, shape (n, n_modes, ndim)."""
        return self.error.whitened(self.model.frequencies_and_gradient(theta)[1])

    def labels(self, modes: tuple[str, ...]) -> tuple[str, ...]:
        """Name the rows of `sensitivity`: the modes."""
        return modes

    def as_dict(self) -> dict[str, Any]:
        """Return name and settings."""
        return self.error.as_dict()
