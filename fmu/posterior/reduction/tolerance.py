"""Tolerance for a reduced model: the errors allowed in its frequencies and log-probability."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fmu.fem.modes.solver import LARGE

FREQUENCY_TOLERANCE = 1e-6
LOG_PROB_TOLERANCE = 1e-3
LOOSEST_FREQUENCY, LOOSEST_LOG_PROB = 1e-2, 0.1
PLAUSIBLE = 50.0
"""Points whose log-probability is below the maximum by more than this are neglected."""


@dataclass(frozen=True)
class Tolerance:
    """Errors allowed in a reduced model.

    Attributes
    ----------
    frequency : float
        Largest relative frequency error, over the whole box.
    log_prob : float
        Largest log-probability error, wherever the log-probability is within `depth` of its maximum.
    depth : float
        Decrease of the log-probability from its maximum, in nats.
    """

    frequency: float = FREQUENCY_TOLERANCE
    log_prob: float = LOG_PROB_TOLERANCE
    depth: float = PLAUSIBLE

    @classmethod
    def of(cls, reduction: bool | float, n_dof: int = 0) -> Tolerance | None:
        """Return the tolerance for a problem's argument `reduction`, or None if it is False (no reduced model).

        `n_dof` is the number of degrees of freedom in the largest block.

        Raises
        ------
        ValueError
            If `reduction` is neither a bool nor a number in (0, 0.01].

        Notes
        -----
        Relative errors δ_i of the frequencies f_i change the log-probability by Σ z_i δ_i f_i/σ_i to first order.
        Here σ_i are the measurement standard deviations, and z_i are the measured errors divided by σ_i. The
        log-probability tolerance is therefore proportional to the frequency tolerance. It is 1e-3 for a frequency
        tolerance of 1e-6. In the log-probability, an error ε(θ) with |ε| ≤ t shifts the posterior mean of a
        quantity g by Cov(g, ε) ≤ t sd(g) to first order, at most t posterior standard deviations. For this reason
        t is at most 0.1, the Monte Carlo error at an effective sample size of 100.

        If the largest block has `LARGE` degrees of freedom or more, `reduction` = True allows an error of 0.01 in
        the log-probability wherever the log-probability is within 10 of its maximum. About 97 % of a Gaussian
        posterior with ten parameters lies in this region. The frequencies may have relative errors of 1e-3 in the
        box, and are more accurate where the log-probability requires it.
        """
        if isinstance(reduction, bool | np.bool_):
            return None if not reduction else MEASURED if n_dof >= LARGE else cls()
        if not (isinstance(reduction, int | float | np.number) and 0.0 < reduction <= LOOSEST_FREQUENCY):
            raise ValueError(
                "reduction: must be true, false or the largest relative error of a frequency, above 0 and at most "
                f"{LOOSEST_FREQUENCY} (got {reduction!r})"
            )
        frequency = float(reduction)
        return cls(frequency, min(LOG_PROB_TOLERANCE * (frequency / FREQUENCY_TOLERANCE), LOOSEST_LOG_PROB))


MEASURED = Tolerance(1e-3, 1e-2, 10.0)
"""The default tolerance of a large structure: small errors compared with the usual measurement errors."""


def next_power_of_ten(value: float) -> float:
    """Return the smallest power of ten that is not below a positive value, apart from rounding."""
    return float(f"1e{math.ceil(math.log10(value) - 1e-9)}")  # NumPy's powers are inexact
