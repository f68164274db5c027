"""Correlation between the errors of frequency response functions of one force, from hits or segments of records.

Noise on the force causes the same relative error in all FRFs of the force; this error is independent from line to
line. A gain that differs from hit to hit, because the hits differ in point or direction, causes the same relative
error at all lines.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from fmu.types import BoolArray, ComplexArray

_CERTAIN = 5.0
"""Number of standard deviations from which a mean correlation between FRFs is certainly not 0."""
_FALSE_ALARMS = 0.001
"""Largest share of data sets without correlation over lines for which one is found."""
_NEAR = 3
"""Largest distance, in lines, at which a window correlates errors."""


class ErrorCorrelation(NamedTuple):
    """Mean correlations between relative errors, 0 where they are not significant.

    Attributes
    ----------
    of_frfs : float
        Between FRFs with the same force, at the same line.
    of_lines : float
        Between lines of the same FRF that are further apart than a window correlates.
    """

    of_frfs: float
    of_lines: float


def correlation_of_errors(
    residuals: Iterable[ComplexArray], clear: BoolArray, drives: Sequence[Any], n: float
) -> ErrorCorrelation:
    """Return the mean correlations between relative errors of FRFs with the same force, and of lines of an FRF.

    At a line, the residuals r_fj = H_fj/H̄_f − 1 of FRFs f and g over the hits j have the correlation
    Re Σ_j r_fj* r_gj/√(Σ_j |r_fj|² Σ_j |r_gj|²). If the errors are independent, its variance is 1/(2 (n − 1)). The
    mean is over the lines and over all pairs of FRFs with one force.

    The correlation of lines k and l of an FRF is c_kl = Re Σ_j q_jk* q_jl, with q_jl = r_jl/√(Σ_j |r_jl|²). A
    window may correlate lines up to three lines apart. Let S be the sum of c_kl over these pairs (k = l included),
    or the number of lines if this is larger. If more distant lines are not correlated, Σ_j |Σ_l q_jl|²/S is about
    χ² divided by its degrees of freedom, 2 (n − 1)/(h Σ_j w_j²). Here w_j is the share of hit j, one of h hits, in
    Σ_jl |q_jl|² (Satterthwaite 1946, *Biometrics Bull.* 2, 110–114). The mean of c_kl over the more distant lines
    is significant if, in one of the F FRFs, a quotient of this size or larger has a probability below
    `_FALSE_ALARMS`/F.

    Parameters
    ----------
    residuals : iterable of ndarray of complex, shape (n_hits, n_lines or more)
        Relative residuals of each FRF; 0 where a hit failed. Only the last n_lines lines are used.
    clear : ndarray of bool, shape (n_frfs, n_lines)
        The lines to average over.
    drives : sequence of (place, direction)
        Force of each FRF.
    n : float
        Number of independent hits or segments.
    """
    from scipy.stats import chi2

    sums: dict[Any, Any] = {}
    counts: dict[Any, Any] = {}
    over_lines, far, is_certain = 0.0, 0, False
    for of_frf, lines, drive in zip(residuals, clear, drives, strict=True):
        own = np.where(lines, of_frf[:, of_frf.shape[1] - len(lines) :], 0.0)
        size = np.sqrt(np.sum(np.abs(own) ** 2, axis=0))
        q = own / np.where(size > 0.0, size, 1.0)
        sums[drive] = sums.get(drive, 0.0) + q
        counts[drive] = counts.get(drive, 0) + (size > 0.0)
        q, m = q[:, size > 0.0], int(np.sum(size > 0.0))
        if m > _NEAR + 1:
            near = m + 2.0 * sum(float(np.vdot(q[:, d:], q[:, :-d]).real) for d in range(1, _NEAR + 1))
            square = float(np.sum(np.abs(q.sum(axis=1)) ** 2))
            part = np.mean(np.abs(q) ** 2, axis=1)  # of each hit
            freedom = 2.0 * (n - 1.0) / (len(q) * float(np.sum(part**2)))
            limit = float(chi2.isf(_FALSE_ALARMS / len(drives), freedom)) / freedom
            is_certain |= square > limit * max(near, m)
            over_lines, far = over_lines + square - near, far + (m - _NEAR) * (m - _NEAR - 1)
    pairs = sum(int(np.sum(count * (count - 1))) for count in counts.values())  # each in both orders
    total = sum(float(np.sum(np.abs(sums[drive]) ** 2) - np.sum(counts[drive])) for drive in sums)
    of_frfs = total / pairs if pairs and total > _CERTAIN * np.sqrt(pairs / (n - 1.0)) else 0.0
    return ErrorCorrelation(min(of_frfs, 1.0), min(max(over_lines / far, 0.0), 1.0) if is_certain else 0.0)
