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

    The score is Φ⁻¹(F(t)), where t is the error before this division and F is its distribution function. A tail
    probability below 1e-300 counts as 1e-300.
    """
    from scipy.special import ndtri, stdtr

    # in the lower tail, where the probability is not rounded to 1
    return np.asarray(-np.sign(z) * ndtri(np.maximum(stdtr(nu, -np.abs(z) * gaussian_sd(nu)), _TINY)))


def joint_scores(z: FloatArray, n: int, n_modes: int) -> FloatArray:
    """Convert errors of the mean of n tests with a joint scatter of n_modes modes to independent normal scores.

    The errors z (…, k) of k modes are whitened, z = L⁻¹ε, by the root of the covariance A/(n (n − n_modes − 2)),
    where A is the sum of squares and products of the tests about their mean. Then z_i is proportional to the error
    of mode i in a prediction by regression on the i − 1 modes before it. With ν_i = n − i degrees of freedom,
    z_i √(ν_i/(n − n_modes − 2 + Σ_{j<i} z_j²)) has Student's t distribution, independent of the errors of these
    modes. Σ z² has Hotelling's distribution (Anderson 2003, *An Introduction to Multivariate Statistical
    Analysis*, 3rd ed., section 5.2).
    """
    nu = n - 1.0 - np.arange(z.shape[-1])
    before = np.cumsum(z**2, axis=-1)
    before = np.concatenate([np.zeros_like(z[..., :1]), before[..., :-1]], axis=-1)
    return student_scores(z * np.sqrt(nu / (n - n_modes - 2.0 + before)) / gaussian_sd(nu), nu)


def to_chi_square(q: FloatArray, k: int, nu: FloatArray | float, c: FloatArray | float) -> FloatArray:
    """Return factors on errors z with Σz² = q that give Σz² the chi-square distribution with k degrees of freedom.

    Without the factor, c q/k has the distribution F(k, ν). The square of the factor times q is the chi-square
    quantile with the same upper tail probability, or with 1e-300 if this is larger.
    """
    from scipy.special import chdtri, fdtrc

    wanted = chdtri(k, np.maximum(fdtrc(k, nu, c * q / k), _TINY))
    return np.asarray(np.sqrt(np.divide(wanted, q, out=np.zeros_like(q), where=q != 0.0)))
