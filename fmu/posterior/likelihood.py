"""How probable the measured modes are, given the computed ones: eq. (4) with its normaliser (5)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fmu.fem.model import ModalModel

FloatArray = NDArray[np.float64]


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

    def log_prob_terms(self, frequencies: FloatArray) -> FloatArray:
        """Return the log-likelihood of each mode, shape (n, n_modes), for frequencies of that shape in Hz."""
        normaliser, beta, measured = self._rows
        # in C order, in which the terms of a row are summed in the same order whatever the batch
        error = np.ascontiguousarray(frequencies) - measured
        with np.errstate(over="ignore"):
            return normaliser - beta * error**2

    def gradient(self, frequencies: FloatArray) -> FloatArray:
        """Return the derivative of each mode's term with respect to its frequency, shape (n, n_modes)."""
        return -2.0 * np.asarray(self.beta) * (frequencies - self.measured)

    def simulate(self, rng: np.random.Generator, frequencies: FloatArray) -> FloatArray:
        """Return `frequencies` with measurement noise added."""
        return frequencies + self.sd * rng.standard_normal(np.shape(frequencies))

    def as_dict(self) -> dict[str, Any]:
        """Return name and settings."""
        return {"error": "frequency", "beta": np.asarray(self.beta).tolist()}


@dataclass(frozen=True, eq=False)
class FrequencyLikelihood:
    """A model's frequencies under an error model: the likelihood as a function of theta.

    Attributes
    ----------
    model : ModalModel
    error : FrequencyError
    """

    model: ModalModel
    error: FrequencyError

    @property
    def beta(self) -> FloatArray:
        """Coefficient β_i of each mode, 1/Hz²."""
        return np.asarray(self.error.beta)

    def terms(self, theta: FloatArray) -> FloatArray:
        """Return the log-likelihood of each mode, shape (n, n_modes), at theta (n, ndim)."""
        return self.error.log_prob_terms(self.model.frequencies(theta))

    def terms_and_gradient(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the terms and their gradients, shape (n, n_modes, ndim)."""
        frequencies, slopes = self.model.frequencies_and_gradient(theta)
        return self.error.log_prob_terms(frequencies), self.error.gradient(frequencies)[..., None] * slopes

    def as_dict(self) -> dict[str, Any]:
        """Return name and settings."""
        return self.error.as_dict()
