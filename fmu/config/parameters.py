"""``[[parameters]]``: what is uncertain, and what was known of it."""

from __future__ import annotations

import numpy as np

from fmu.config.fields import ParameterName
from fmu.config.mistakes import Mistake, got
from fmu.config.model.targets import Target
from fmu.config.priors import PriorTable, UniformTable
from fmu.posterior.parameters import Parameter

LEAST_LOG_MASS = -200.0
"""Of a prior between the bounds: a Gaussian that ends twenty standard deviations off is a slip of the pen."""


class ParameterTable(Target):
    """A parameter; in a frame, what it is the value of, in which groups."""

    name: ParameterName
    """For tables and figures."""
    start: float
    """The model before updating."""
    lower: float | None = None
    """Bounds cut the prior off; a uniform prior needs both."""
    upper: float | None = None
    """Bounds cut the prior off; a uniform prior needs both."""
    unit: str = ""
    """For labels; values are in SI units."""
    prior: PriorTable = UniformTable(distribution="uniform")
    """What was known before the measurement."""

    def build(self) -> Parameter:
        """Return the parameter.

        Raises
        ------
        ValueError
            If bounds, start and prior do not fit each other.
        """
        if self.prior.distribution == "truncated-normal" and self.lower is None and self.upper is None:
            raise ValueError("prior: a truncated normal needs lower or upper")
        lower = -np.inf if self.lower is None else self.lower
        upper = np.inf if self.upper is None else self.upper
        parameter = Parameter(self.name, self.start, lower, upper, self.prior.build(), self.unit)
        log_mass = parameter.prior.log_mass(lower, upper)
        if log_mass < LEAST_LOG_MASS:
            raise ValueError(f"prior: must have probability between the bounds (got {_power_of_ten(log_mass)})")
        return parameter

    def is_positive(self) -> bool:
        """Say whether all values that the parameter can have are positive, by its bounds or by its prior."""
        try:
            return self.build().lowest > 0.0
        except ValueError:  # which is a mistake of its own
            return self.lower is not None and self.lower > 0.0


def built(tables: list[ParameterTable]) -> tuple[list[Parameter], list[Mistake]]:
    """Return the parameters in the order of the file, and what is wrong with them."""
    parameters, found = [], []
    names = [table.name for table in tables]
    for i, table in enumerate(tables):
        if table.name in names[:i]:
            found.append(
                Mistake(f"parameters.{i}.name", got("must not be the name of another parameter", table.name))
            )
        try:
            parameters.append(table.build())
        except ValueError as error:
            found.append(Mistake(f"parameters.{i}", str(error).removeprefix(f"{table.name}.")))
    return parameters, found


def _power_of_ten(log_value: float) -> str:
    return f"1e{log_value / np.log(10.0):.0f}"
