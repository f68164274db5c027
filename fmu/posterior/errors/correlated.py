"""Frequency errors that depend on each other: a Gaussian with a full covariance."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fmu.numbers import significant
from fmu.types import FloatArray

_SYMMETRIC = 1e-9


def checked_covariance(covariance: ArrayLike, n: int, name: str = "covariance_hz2") -> FloatArray:
    """Return a covariance as a read-only array, symmetric to the last bit.

    Parameters
    ----------
    covariance : array_like, shape (n, n)
    n : int
    name : str
        What to call it in the error.

    Raises
    ------
    ValueError
        If its shape is another, or it is not finite, symmetric (to 1e-9 of the standard deviations) and positive
        definite: no correlation may be within 1e-12 or so of ±1.
    """
    matrix = np.array(covariance, dtype=float)
    if matrix.shape != (n, n):
        raise ValueError(f"{name}: must have shape {(n, n)}, modes x modes (got {matrix.shape})")
    if not np.all(np.isfinite(matrix)):
        raise ValueError(f"{name}: must be finite (got {matrix.tolist()})")
    variance = np.diag(matrix)
    if not np.all(variance > 0):
        at = int(np.argmin(variance > 0))
        raise ValueError(f"{name}.{at}.{at}: must be positive, a variance (got {variance[at]} Hz²)")
    sd = np.sqrt(variance)
    correlation = matrix / sd[:, None] / sd
    off = np.abs(correlation - correlation.T)
    if off.max() > _SYMMETRIC:
        i, j = map(int, np.unravel_index(np.argmax(off), off.shape))
        raise ValueError(
            f"{name}: must be symmetric (got {matrix[i, j]} at {i}.{j} and {matrix[j, i]} at {j}.{i})"
        )
    lowest = float(np.linalg.eigvalsh(0.5 * (correlation + correlation.T))[0])
    if lowest < 1e-12:
        raise ValueError(
            f"{name}: must be positive definite (got a lowest eigenvalue of the correlations of "
            f"{significant(lowest)})"
        )
    matrix = 0.5 * (matrix + matrix.T)
    matrix.flags.writeable = False
    return matrix


@dataclass(frozen=True, eq=False)
class CorrelatedFrequencyError:
    """Gaussian errors ε = f − f^m in Hz with covariance Σ: log P(D|θ) = log N(f^m; f, Σ).

    With Σ = LLᵀ (Cholesky) and z = L⁻¹ε the log-density is a sum over the modes,

    log P(D|θ) = Σ_i (−½ log 2π − log L_ii − ½ z_i²),

    whose term i is the log-density of f_i^m given f_1^m … f_{i−1}^m: what mode i adds to what the modes before it
    say already. Single terms depend on the order of the modes, their sum does not.

    Attributes
    ----------
    measured : ndarray, shape (n_modes,), Hz
    covariance_hz2 : ndarray, shape (n_modes, n_modes), Hz²

    Raises
    ------
    ValueError
        If the covariance is not symmetric and positive definite, or not of that shape.

    Notes
    -----
    Products with L and L⁻¹ are accumulated a column at a time and not by BLAS, whose order of summation depends on
    how many theta there are in a batch.
    """

    measured: FloatArray
    covariance_hz2: FloatArray
    _inverse_root: FloatArray = field(init=False, repr=False)
    _root: FloatArray = field(init=False, repr=False)
    _normaliser: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        from scipy.linalg import solve_triangular

        covariance = checked_covariance(self.covariance_hz2, len(self.measured))
        root = np.linalg.cholesky(covariance)
        object.__setattr__(self, "covariance_hz2", covariance)
        object.__setattr__(self, "_root", root)
        object.__setattr__(self, "_inverse_root", solve_triangular(root, np.eye(len(root)), lower=True))
        object.__setattr__(self, "_normaliser", (-0.5 * np.log(2.0 * np.pi) - np.log(np.diag(root)))[None])

    @property
    def sd(self) -> FloatArray:
        """Standard deviation σ_i of each mode's measurement error by itself, Hz."""
        return np.asarray(np.sqrt(np.diag(self.covariance_hz2)))

    @property
    def beta(self) -> FloatArray:
        """1/(2σ_i²) of each mode by itself, 1/Hz²; the correlations are not in it."""
        return np.asarray(0.5 / np.diag(self.covariance_hz2))

    def whitened(self, x: FloatArray) -> FloatArray:
        """Return L⁻¹x: `x` (n, n_modes, …) in Hz along the modes, in units of independent standard errors."""
        return _times(self._inverse_root, x, 1)

    def log_prob_terms(self, frequencies: FloatArray) -> FloatArray:
        """Return the conditional log-likelihood of each mode, shape (…, n_modes), for frequencies in Hz.

        Where a frequency is infinite, terms may be NaN.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(self._normaliser - 0.5 * self._standardised(frequencies) ** 2)

    def log_prob_given_others(self, frequencies: FloatArray) -> FloatArray:
        """Return the log-density of each measured frequency given all the other measured ones, (…, n_modes).

        With g = Σ⁻¹ε and c_i = (Σ⁻¹)_ii it is N(g_i/c_i; 0, 1/c_i) (Bürkner, Gabry & Vehtari 2021, Computational
        Statistics 36, 1243, eq. 12): what leaving a mode out asks for. These do not sum to the joint.
        """
        c = np.sum(self._inverse_root**2, axis=0)
        g = -self.gradient(frequencies)
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(0.5 * np.log(c / (2.0 * np.pi)) - 0.5 * g**2 / c)

    def gradient(self, frequencies: FloatArray) -> FloatArray:
        """Return the derivative −Σ⁻¹ε of the log-likelihood with respect to each frequency, shape (…, n_modes)."""
        with np.errstate(over="ignore", invalid="ignore"):
            return -_times(self._inverse_root.T, self._standardised(frequencies))

    def terms_gradient(self, frequencies: FloatArray, slopes: FloatArray) -> FloatArray:
        """Return the derivatives of the terms, given those of the frequencies: both (n, n_modes, ndim)."""
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(-self._standardised(frequencies)[..., None] * self.whitened(slopes))

    def simulate(self, rng: np.random.Generator, frequencies: FloatArray) -> FloatArray:
        """Return `frequencies` with measurement noise added."""
        return np.asarray(frequencies + _times(self._root, rng.standard_normal(np.shape(frequencies))))

    def as_dict(self) -> dict[str, Any]:
        """Return name and settings."""
        return {"error": "frequency", "covariance_hz2": self.covariance_hz2.tolist()}

    def _standardised(self, frequencies: FloatArray) -> FloatArray:
        """Return z = L⁻¹ε, shape (…, n_modes)."""
        return _times(self._inverse_root, frequencies - self.measured)


def _times(A: FloatArray, x: FloatArray, axis: int = -1) -> FloatArray:
    """Return A x along an axis of `x`, every sum in the same order whatever the batch, in C order."""
    total = np.zeros(x.shape)
    along = (slice(None),) * (axis % x.ndim)
    columns = A.T.reshape(len(A), -1, *(1,) * (x.ndim - 1 - axis % x.ndim))
    for j, column in enumerate(columns):
        total += column * x[*along, j : j + 1]
    return total
