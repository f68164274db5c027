"""Complex errors with Student's distribution, whose standard deviation was estimated from few hits or averages."""

from __future__ import annotations

import numpy as np

from fmu.types import FloatArray


def squared_scores(squares: FloatArray, freedom: FloatArray | float) -> FloatArray:
    """Return the sum r² of the squared normal scores of an error's real and imaginary part.

    A larger error has the probability exp(−½ r²). With the scale V and m degrees of freedom this probability is
    (1 + |e|²/(m V))^(−m/2), so that r² = m log(1 + |e|²/(m V)), which is |e|²/V for m = ∞. r² has the chi-square
    distribution with two degrees of freedom.

    Parameters
    ----------
    squares : ndarray
        |e|²/V.
    freedom : float or ndarray
        m; all finite or all infinite.
    """
    if np.all(np.isinf(freedom)):
        return squares
    return np.asarray(freedom * np.log1p(squares / freedom))
