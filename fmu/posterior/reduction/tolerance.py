"""The errors that a reduced model may have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

FREQUENCY_TOLERANCE = 1e-6
LOG_PROB_TOLERANCE = 1e-3
LOOSEST_FREQUENCY, LOOSEST_LOG_PROB = 1e-2, 0.1


@dataclass(frozen=True)
class Tolerance:
    """Errors that a reduced model may have.

    Attributes
    ----------
    frequency : float
        Largest relative error of a frequency, over the whole box.
    log_prob : float
        Largest error of the log-probability, wherever that is within `PLAUSIBLE` of its maximum.
    """

    frequency: float = FREQUENCY_TOLERANCE
    log_prob: float = LOG_PROB_TOLERANCE

    @classmethod
    def of(cls, reduction: bool | float) -> Tolerance | None:
        """Return the tolerance for the argument `reduction` of a problem, None for no reduced model.

        Raises
        ------
        ValueError
            If it is neither true or false nor a number in (0, 0.01].

        Notes
        -----
        Errors δ_i f_i of the frequencies change the log-probability by Σ z_i δ_i f_i/σ_i to first order, where z_i
        are the standardised errors. The tolerance of the log-probability is therefore proportional to that of the
        frequencies: 1e-3 at 1e-6. An error ε(θ) of log P with |ε| ≤ t moves the posterior mean of g by Cov(g, ε) ≤
        t sd(g) to first order, at most t posterior standard deviations. So t never exceeds 0.1, which is the Monte
        Carlo error of 100 effective draws.
        """
        if isinstance(reduction, bool | np.bool_):
            return cls() if reduction else None
        if not (isinstance(reduction, int | float | np.number) and 0.0 < reduction <= LOOSEST_FREQUENCY):
            raise ValueError(
                "reduction: must be true, false or the largest relative error of a frequency, above 0 and at most "
                f"{LOOSEST_FREQUENCY} (got {reduction!r})"
            )
        frequency = float(reduction)
        return cls(frequency, min(LOG_PROB_TOLERANCE * (frequency / FREQUENCY_TOLERANCE), LOOSEST_LOG_PROB))
