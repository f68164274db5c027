"""Tolerance for a reduced model: the errors allowed in its frequencies and log-probability."""

from __future__ import annotations

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
        Relative frequency errors δ_i change the log-probability by Σ z_i δ_i f_i/σ_i to first order, where z_i are
        the standardised errors. The log-probability tolerance is therefore proportional to the frequency
        tolerance: 1e-3 for 1e-6. An error ε(θ) in log P with |ε| ≤ t shifts the posterior mean of a quantity g by
        Cov(g, ε) ≤ t sd(g) to first order, at most t posterior standard deviations. For this reason t is at most
        0.1, the Monte Carlo error at an effective sample size of 100.

        If the largest block has `LARGE` degrees of freedom or more, True allows an error of 0.01 in the
        log-probability wherever it is within 10 of its maximum. A posterior with some ten parameters hardly leaves
        this region. The frequencies may have errors of 1e-3 in the box, and are more accurate where the
        log-probability requires it.
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
