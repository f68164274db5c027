"""Distributions of errors whose standard deviation is itself an estimate: Student's t and F."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fmu.types import FloatArray

_SHARE = 0.95
_TINY = 1e-300


def gaussian_sd(nu: ArrayLike) -> FloatArray:
    """Return the sd of the Gaussian with the central 95 % interval of Student's t with ν degrees of freedom."""
    from scipy.special import ndtri, stdtrit

    tail = 0.5 * (1.0 + _SHARE)
    return np.asarray(stdtrit(nu, tail) / ndtri(tail))


def student_scores(z: FloatArray, nu: ArrayLike) -> FloatArray:
    """Convert errors z that have Student's t distribution, divided by `gaussian_sd(nu)`, to normal scores.

    The score is Φ⁻¹(F(t)), where t is the error before this division and F is its distribution function.
    """
    from scipy.special import ndtri, stdtr

    # in the lower tail, where the probability is not rounded to 1
    return np.asarray(-np.sign(z) * ndtri(stdtr(nu, -np.abs(z) * gaussian_sd(nu))))


def to_chi_square(q: FloatArray, k: int, nu: FloatArray | float, c: FloatArray | float) -> FloatArray:
    """Return factors on errors z with Σz² = q that give Σz² the chi-square distribution with k degrees of freedom.

    Without the factor, c q/k has the distribution F(k, ν). The square of the factor times q is the chi-square
    quantile with the same upper tail probability, or with 1e-300 if this is larger.
    """
    from scipy.special import chdtri, fdtrc

    wanted = chdtri(k, np.maximum(fdtrc(k, nu, c * q / k), _TINY))
    return np.asarray(np.sqrt(np.divide(wanted, q, out=np.zeros_like(q), where=q != 0.0)))
