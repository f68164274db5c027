"""``[[parameters]]``: what is uncertain, and what was known of it."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from fmu.config.fields import Name, Positive, Table
from fmu.config.frame import Target
from fmu.config.mistakes import Mistake, got
from fmu.posterior.parameters import Parameter
from fmu.posterior.priors import Normal, Prior, Uniform


class NormalTable(Table):
    """Gaussian, cut off at the bounds: eq. (6) of the paper with α = 1/sd²."""

    distribution: Literal["normal"]
    sd: Positive
    mean: float = 0.0

    def build(self) -> Prior:
        """Return the prior."""
        return Normal(self.sd, self.mean)


class UniformTable(Table):
    """Constant between the bounds."""

    distribution: Literal["uniform"]

    def build(self) -> Prior:
        """Return the prior."""
        return Uniform()


PriorTable = Annotated[NormalTable | UniformTable, Field(discriminator="distribution")]


class ParameterTable(Target):
    """A parameter; in a frame, what it is the value of, in which groups."""

    name: Name
    start: float
    lower: float | None = None
    upper: float | None = None
    unit: str = ""
    prior: PriorTable = UniformTable(distribution="uniform")

    def build(self) -> Parameter:
        """Return the parameter.

        Raises
        ------
        ValueError
            If bounds, start and prior do not fit each other.
        """
        lower = -np.inf if self.lower is None else self.lower
        upper = np.inf if self.upper is None else self.upper
        return Parameter(self.name, self.start, lower, upper, self.prior.build(), self.unit)


def built(tables: list[ParameterTable]) -> tuple[list[Parameter], list[Mistake]]:
    """Return the parameters in the order of the file, and what is wrong with them."""
    parameters, found = [], []
    names = [table.name for table in tables]
    for i, table in enumerate(tables):
        if table.name in names[:i]:
            found.append(Mistake(f"parameters.{i}.name", got("must not be that of another parameter", table.name)))
        try:
            parameters.append(table.build())
        except ValueError as error:
            found.append(Mistake(f"parameters.{i}", str(error).removeprefix(f"{table.name}.")))
    return parameters, found
