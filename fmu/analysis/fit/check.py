"""A check of a model against data: its result, the limit at which it fails, and the errors it could reveal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from fmu.numbers import change, significant
from fmu.types import FloatArray

LEVEL, WITH_POPULATIONS, OF_POPULATIONS = 0.01, 0.02, 0.015
"""Largest probability that a correct model fails any check: `LEVEL` without a population, `WITH_POPULATIONS` with
one. Of the latter, `OF_POPULATIONS` is for the checks of `fmu.analysis.fit.populations`, which compare many tests
in many ways."""
PREDICTED, HELD_OUT, RESIDUALS, TEST, NOISE, SHAPE, QUANTITY, POPULATION, LAW, RESPONSES = (
    "from the other modes", "not used in updating", "residuals", "one of the tests", "inferred noise", "shape",
    "mass or displacement", "population", "law over the tests", "frequency response function",
)  # fmt: skip


_FEW, _LEAST_P = 500, 1e-300
"""Number of draws that suffices to find the factor on the residuals at which a check fails, and the smallest
p-value that is printed."""


@dataclass(frozen=True)
class Check:
    """A check of the model.

    Attributes
    ----------
    kind : str
        `PREDICTED`, `HELD_OUT`, `RESIDUALS`, `TEST`, `NOISE`, `SHAPE`, `QUANTITY`, `POPULATION`, `LAW` or
        `RESPONSES`.
    of : str
        The quantity that is checked.
    found, limit : str
        Value of the statistic, and the limit beyond which the check fails.
    p : float
        Probability of a value at least this extreme under a correct model; NaN for mode shapes.
    failed : bool
    shows : str
        The errors that would make the check fail, in words.
    sentence : str
        The evidence against the model if the check failed, in one sentence.
    why_not : str
        Why the check could not have revealed any error; empty if it could.
    below, above : float
        Relative frequency errors, measured over predicted minus one, beyond which the check of a predicted mode
        fails; NaN for other checks.
    dependence : str
        A dependence on order, covariate or group that contradicts the parameter's law; empty if there is none.
    """

    kind: str
    of: str
    found: str
    limit: str
    p: float
    failed: bool
    shows: str
    sentence: str
    why_not: str = ""
    below: float = np.nan
    above: float = np.nan
    dependence: str = ""

    @property
    def could_fail(self) -> bool:
        """Whether the check failed or could have failed; a check that could not have failed tests nothing."""
        return self.failed or not self.why_not


def level_of(checks: Sequence[Check]) -> float:
    """Return an upper bound on the probability that a correct model fails any of the checks.

    It does not cover checks of mode shapes, for which no error model is stated.
    """
    return WITH_POPULATIONS if any(check.kind == POPULATION for check in checks) else LEVEL


def beyond(below: float, above: float) -> str:
    """Format two limits, as in ``"below -8.2 % or above +9.6 %"``. A lower limit of -100 % or less is left out."""
    upper = f"above {change(above)}"
    return upper if below <= -1.0 else f"below {change(below)} or {upper}"


def probability(p: float, digits: int = 1) -> str:
    """Format a p-value with one significant digit or more: ``"p = 0.003"`` or ``"p < 1e-300"``."""
    return f"p{' ' if p < _LEAST_P else ' = '}{p_value(p, digits)}"


def p_value(p: float, digits: int) -> str:
    """Format a p-value without its name: ``"0.003"`` or ``"< 1e-300"``."""
    return "< 1e-300" if p < _LEAST_P else significant(p, digits)


def failed_checks(checks: Sequence[Check]) -> list[Check]:
    """Return the checks that failed.

    Checks that name a cause come first, then the others by increasing p-value; mode shapes come last.
    """
    failed = [check for check in checks if check.failed]
    return sorted(failed, key=lambda check: (not check.dependence, np.nan_to_num(check.p, nan=1.0)))


def factor_to_fail(squares: FloatArray, freedom: int, limit: float) -> float:
    """Return the factor on all residuals that would reduce the mean tail probability of Σ r² to `limit`."""
    few = squares[:: -(-len(squares) // _FEW)]
    low, high = -12.0, 12.0  # bounds of the natural logarithm of the factor
    for _ in range(40):
        middle = 0.5 * (low + high)
        enough = float(chdtrc(freedom, np.exp(2.0 * middle) * few).mean()) < limit
        low, high = (low, middle) if enough else (middle, high)
    return float(np.exp(high))
