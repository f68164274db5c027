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


def square(z: ComplexArray) -> FloatArray:
    """Return |z|²."""
    return np.asarray(z.real**2 + z.imag**2)
