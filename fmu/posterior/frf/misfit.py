"""Data classes for FRF log-densities at the frequency lines, and for gain errors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmu.types import ComplexArray, FloatArray


class Misfit(NamedTuple):
    """Log-densities for a block of frequency lines, and their derivatives.

    These derivatives include the derivatives of `Gains.log_density`.

    Attributes
    ----------
    terms : ndarray, shape (n, n_frfs, n_lines)
        Log-densities, without constants; 0 for values that are not used.
    weights : ndarray of complex, shape (n, n_frfs, n_lines), or None
        w such that a change dH of the computed FRFs changes the log-density by Re(w dH); None if derivatives were
        not requested.
    by_sd : ndarray, shape (n, n_frfs, n_lines), or None
        Derivative with respect to the relative model error σ. None if derivatives were not requested, or if there
        is no relative model error.
    """

    terms: FloatArray
    weights: ComplexArray | None
    by_sd: FloatArray | None


class Gains(NamedTuple):
    """Gain errors that are integrated out, at n parameter vectors.

    As a function of a gain's relative error γ, the joint density of the data and γ is proportional to
    exp(−½ A (γ − γ̂)²).

    Attributes
    ----------
    best : ndarray, shape (n, n_channels)
        γ̂, the most probable value; 0 for a channel whose gain is known.
    precision : ndarray, shape (n, n_channels)
        A, which includes the prior's precision; infinite for a channel whose gain is known.
    log_density : ndarray, shape (n,)
        Contribution of the integrals to the log-density, in addition to the lines' terms.
    """

    best: FloatArray
    precision: FloatArray
    log_density: FloatArray


def densities(
    a: FloatArray, V: FloatArray, log_V: FloatArray, m: FloatArray, nu: float
) -> tuple[FloatArray, FloatArray]:
    """Return the log-densities of errors e with a = |e|², and k. A change de of e adds −k Re(e* de) to them.

    With m degrees of freedom the density is (1 − 2/m)/(2πV) (1 + a/(mV))^(−m/2), which is exp(−½ a/V)/(2πV) for
    m = ∞. Its integral over both parts of e is 1 for each m and V. The constants −log 2π and log(1 − 2/ν) are left
    out.

    Parameters
    ----------
    a, V, log_V : ndarray
    m : ndarray
        Of the shape of `V`, or of shape () if it does not depend on V: it is then ν.
    nu : float
        ν, the degrees of freedom of the data's standard deviations.
    """
    if np.isinf(nu):
        return -0.5 * a / V - log_V, 1.0 / V
    terms = -0.5 * m * np.log1p(a / (m * V)) - log_V
    if m.ndim:
        terms = terms + (np.log1p(-2.0 / m) - np.log1p(-2.0 / nu))
    return terms, m / (m * V + a)


def slope_by_freedom(a: FloatArray, V: FloatArray, m: FloatArray) -> FloatArray:
    """Return the derivatives of `densities` with respect to m at the same V."""
    return np.asarray(0.5 * (a / (m * V + a) - np.log1p(a / (m * V))) + 2.0 / (m * (m - 2.0)))


def square(z: ComplexArray) -> FloatArray:
    """Return |z|²."""
    return np.asarray(z.real**2 + z.imag**2)
