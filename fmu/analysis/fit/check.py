"""A check of a model against data: what it found, beyond what it fails, and which errors it would have shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fmu.numbers import change, significant

LEVEL = 0.01
"""The probability that a right model fails any check, at most."""
PREDICTED, HELD_OUT, RESIDUALS, TEST, NOISE, SHAPE, QUANTITY, POPULATION = (
    "from the other modes", "not used in updating", "residuals", "one of the tests", "inferred noise", "shape",
    "mass or displacement", "population",
)  # fmt: skip


@dataclass(frozen=True)
class Check:
    """A check of the model.

    Attributes
    ----------
    kind : str
        `PREDICTED`, `HELD_OUT`, `RESIDUALS`, `TEST`, `NOISE`, `SHAPE`, `QUANTITY` or `POPULATION`.
    of : str
        What is checked.
    found, limit : str
        The statistic, and beyond what it fails.
    p : float
        Its probability under a right model; NaN for shapes.
    failed : bool
    shows : str
        The errors that it would have shown; empty if it could show none.
    sentence : str
        What it found against the model.
    why_not : str
        Why it could have shown no error; else empty.
    below, above : float
        Relative errors of a frequency, measured over predicted, less one, beyond which it fails; else NaN.
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

    @property
    def could_fail(self) -> bool:
        """Whether it would have shown an error: one that could not is no check."""
        return self.failed or not self.why_not


def beyond(below: float, above: float) -> str:
    """Return ``"below -8.2 % or above +9.6 %"``; no frequency is wrong by -100 %."""
    upper = f"above {change(above)}"
    return upper if below <= -1.0 else f"below {change(below)} or {upper}"


def probability(p: float) -> str:
    """Return ``"p = 0.003"``, ``"p = 2e-12"`` or ``"p < 1e-300"``."""
    return "p < 1e-300" if p < 1e-300 else f"p = {significant(p, 1)}"


def failed_checks(checks: Sequence[Check]) -> list[Check]:
    """Return the checks that failed, the least probable first."""
    return sorted((check for check in checks if check.failed), key=lambda check: np.nan_to_num(check.p, nan=1.0))
