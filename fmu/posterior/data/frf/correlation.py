"""Correlation between the errors of frequency response functions of one force, from hits or segments of records.

Noise on the force, and hits that differ in point or direction, change all responses to a force alike.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from fmu.types import BoolArray, ComplexArray

_CERTAIN = 5.0
"""Number of standard deviations from which a mean correlation is certainly not 0."""


def correlation_of_errors(
    residuals: Iterable[ComplexArray], clear: BoolArray, drives: Sequence[Any], n: float
) -> float:
    """Return the mean correlation between relative errors of FRFs with the same force; 0 if it is not significant.

    At a line, the residuals r_fj = H_fj/H̄_f − 1 of FRFs f and g over the hits j have the correlation
    Re Σ_j r_fj* r_gj/√(Σ_j |r_fj|² Σ_j |r_gj|²). If the errors are independent, its variance is 1/(2 (n − 1)). The
    mean is over the lines and over all pairs of FRFs with one force.

    Parameters
    ----------
    residuals : iterable of ndarray of complex, shape (n_hits, n_lines) or more lines, of which the last ones count
        Relative residuals of each FRF; 0 where a hit failed.
    clear : ndarray of bool, shape (n_frfs, n_lines)
        The lines to average over.
    drives : sequence of (place, direction)
        Force of each FRF.
    n : float
        Number of independent hits or segments.
    """
    sums: dict[Any, Any] = {}
    counts: dict[Any, Any] = {}
    for of_frf, lines, drive in zip(residuals, clear, drives, strict=True):
        own = np.where(lines, of_frf[:, of_frf.shape[1] - len(lines) :], 0.0)
        size = np.sqrt(np.sum(np.abs(own) ** 2, axis=0))
        sums[drive] = sums.get(drive, 0.0) + own / np.where(size > 0.0, size, 1.0)
        counts[drive] = counts.get(drive, 0) + (size > 0.0)
    pairs = sum(int(np.sum(count * (count - 1))) for count in counts.values())  # each in both orders
    total = sum(float(np.sum(np.abs(sums[drive]) ** 2) - np.sum(counts[drive])) for drive in sums)
    return min(total / pairs, 1.0) if pairs and total > _CERTAIN * np.sqrt(pairs / (n - 1.0)) else 0.0
