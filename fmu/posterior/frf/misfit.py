"""Records of the log-density of frequency response functions at the lines, and of the gain errors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fmu.types import ComplexArray, FloatArray


class Misfit(NamedTuple):
    """Log-densities of a block of lines and their derivatives.

    Attributes
    ----------
    terms : ndarray, shape (n, n_frfs, n_lines)
        Log-densities, without the parts that depend on no parameter.
    weights : ndarray of complex, shape (n, n_frfs, n_lines), or None
        w such that d(terms) = Re(w dH).
    by_sd : ndarray, shape (n, n_frfs, n_lines), or None
        Derivative with respect to the relative error σ of the model.
    """

    terms: FloatArray
    weights: ComplexArray | None
    by_sd: FloatArray | None


class Gains(NamedTuple):
    """The gain errors that are integrated out, at n parameter vectors.

    The density of the data given the relative error γ of a gain is exp(−½ A (γ − γ̂)²) times its maximum.

    Attributes
    ----------
    best : ndarray, shape (n, n_channels)
        γ̂, the most probable value; 0 for a channel whose gain is known.
    precision : ndarray, shape (n, n_channels)
        A, which includes the precision of the prior; infinite for a channel whose gain is known.
    log_density : ndarray, shape (n,)
        Contribution of the integrals to the log-density, in addition to the terms of the lines.
    """

    best: FloatArray
    precision: FloatArray
    log_density: FloatArray


def square(z: ComplexArray) -> FloatArray:
    """Return |z|²."""
    return np.asarray(z.real**2 + z.imag**2)
