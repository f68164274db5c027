"""``[[error]]`` and ``[[noise]]``: error models, and standard deviations to be inferred with the parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, Tag

from fmu.config.fields import Name, Number, Numbers, ParameterName, Positive, TomlTable, by_kind
from fmu.config.mistakes import Mistake, got
from fmu.config.priors import PriorTable, UniformTable
from fmu.formats.shown import names_shown
from fmu.posterior.data.modal_data import ModalData
from fmu.posterior.errors.models import ErrorModel, FrequencyErrors, MACErrors, ShapeErrors
from fmu.posterior.parameters import Parameter

Weights = list[Positive] | None
Named = Annotated[Name, Tag("<text>")]
Rows = Annotated[list[list[Positive]], Tag("<rows>")]
Deviation = Annotated[Number | Numbers | Named, by_kind("a number, a list of numbers, or the name of a noise")]


class NoiseTable(TomlTable):
    """A standard deviation to be inferred, which error models refer to by its name."""

    name: ParameterName
    start: Positive
    lower: Annotated[float, Field(ge=0)] = 0.0
    upper: Positive | None = None
    unit: str = ""
    prior: PriorTable = UniformTable(distribution="uniform")

    def build(self) -> Parameter:
        """Return the parameter; ValueError if bounds, start and prior do not fit each other."""
        upper = np.inf if self.upper is None else self.upper
        return Parameter(self.name, self.start, self.lower, upper, self.prior.build(), self.unit)


class FrequencyErrorTable(TomlTable):
    """Errors of frequencies: ``kind``, and ``sd`` if not the measurement's: a number, one a mode, or a name."""

    of: Literal["frequencies"]
    kind: Literal["absolute", "relative", "eigenvalue"] = "relative"
    sd: Deviation | None = None
    weights: Weights = None
    discrepancy: Name | None = None

    def build(self, noise: Mapping[str, Parameter]) -> ErrorModel:
        """Return the error model."""
        return FrequencyErrors(self.kind, _sd(self.sd, noise), self.weights, noise.get(self.discrepancy or ""))


class ShapeErrorTable(TomlTable):
    """Errors of mode shapes of unit length; ``sd`` a number, one a mode, a row a sensor, or a name."""

    of: Literal["shapes"]
    sd: (
        Annotated[Number | Numbers | Rows | Named, by_kind("a number, lists of numbers, or the name of a noise")]
        | None
    ) = None
    weights: Weights = None
    discrepancy: Name | None = None

    def build(self, noise: Mapping[str, Parameter]) -> ErrorModel:
        """Return the error model."""
        return ShapeErrors(_sd(self.sd, noise), self.weights, noise.get(self.discrepancy or ""))


class MACErrorTable(TomlTable):
    """Errors 1 − MAC; ``sd`` a number, one a mode, or a name."""

    of: Literal["mac"]
    sd: Deviation
    weights: Weights = None
    together: list[list[Name]] = []
    """Groups of modes, by name, too close to have shapes of their own: compared with the space that each spans."""

    def build(self, noise: Mapping[str, Parameter]) -> ErrorModel:
        """Return the error model."""
        return MACErrors(_sd(self.sd, noise), self.weights, self.together)


ErrorTable = Annotated[FrequencyErrorTable | ShapeErrorTable | MACErrorTable, Field(discriminator="of")]


def built_noise(
    tables: Sequence[NoiseTable], errors: Sequence[Any], parameters: Sequence[str]
) -> tuple[dict[str, Parameter], list[Mistake]]:
    """Return the standard deviations to be inferred by name, and what is wrong with them or refers to none.

    Parameters
    ----------
    tables : sequence of NoiseTable
    errors : sequence of ErrorTable
    parameters : sequence of str
        Names that are taken.
    """
    noise: dict[str, Parameter] = {}
    found, used = [], set()
    for i, table in enumerate(tables):
        if table.name in noise or table.name in parameters:
            found.append(Mistake(f"noise.{i}.name", got("must not be the name of another parameter", table.name)))
        try:
            noise[table.name] = table.build()
        except ValueError as error:
            found.append(Mistake(f"noise.{i}", str(error).removeprefix(f"{table.name}.")))
    known = names_shown([table.name for table in tables]) or "there is none"
    for i, model in enumerate(errors):
        for key in ("sd", "discrepancy"):
            name = getattr(model, key, None)
            if isinstance(name, str):
                used.add(name)
                if name not in {table.name for table in tables}:
                    found.append(
                        Mistake(f"error.{i}.{key}", got(f"must be the name of a [[noise]] table: {known}", name))
                    )
    for i, table in enumerate(tables):
        if table.name not in used:
            found.append(
                Mistake(f"noise.{i}.name", got("must be used as sd or discrepancy of an [[error]]", table.name))
            )
    return noise, found


def beside_tests(errors: Sequence[Any], data: ModalData) -> list[Mistake]:
    """Refuse an ``sd`` of errors whose size the scatter of repeated tests tells: one of the two would be ignored.

    Parameters
    ----------
    errors : sequence of ErrorTable
    data : ModalData
    """
    told = {"frequencies": data.tests is not None, "shapes": data.tests is not None and data.shapes_sd is not None}
    rule = (
        "must not be given together with tests, whose scatter gives the error of their mean. Leave it out and "
        "use discrepancy for the model error, or replace tests by frequencies (the means) with an sd"
    )
    return [
        Mistake(f"error.{i}.sd", got(rule, table.sd))
        for i, table in enumerate(errors)
        if told.get(table.of) and table.sd is not None
    ]


def vanishing(
    noise: Mapping[str, Parameter], errors: Sequence[Any], data: ModalData, n_parameters: int
) -> list[Mistake]:
    """Say which standard deviations an exact fit would let shrink to zero, where the density has no limit.

    The density grows as sd^(−n) where all of the n errors that it is the size of can be zero: with no more of them
    than parameters, and no other deviation that is known. A prior may fall faster.

    Parameters
    ----------
    noise : mapping of str to Parameter
        In the order of the file.
    errors : sequence of ErrorTable
    data : ModalData
    n_parameters : int
        Of the model.
    """
    n_values = 0 if data.shapes is None else np.size(data.shapes)
    sizes = {"frequencies": data.n_modes, "mac": data.n_modes, "shapes": n_values}
    has_own = data.sd_hz is not None or data.covariance_hz2 is not None
    counts = dict.fromkeys(noise, 0)
    grounded = set()
    for table in errors:
        named = {name for key in ("sd", "discrepancy") if isinstance(name := getattr(table, key, None), str)}
        counts |= {name: counts[name] + sizes[table.of] for name in named}
        if not isinstance(table.sd, str) and (table.sd is not None or (table.of == "frequencies" and has_own)):
            grounded |= named
    found = []
    for i, (name, parameter) in enumerate(noise.items()):
        n, nearly_none = counts[name], parameter.start * np.array([1e-6, 1e-9])
        density = parameter.prior.log_pdf(nearly_none) - n * np.log(nearly_none)
        if name not in grounded and parameter.lower == 0.0 and n <= n_parameters and density[1] > density[0]:
            rule = (
                f"must be positive (or use a log-normal prior): {n_parameters} parameters can fit these {n} "
                f"errors exactly, and the probability density is unbounded as the deviation tends to zero"
            )
            found.append(Mistake(f"noise.{i}.lower", got(rule, parameter.lower)))
    return found


def _sd(value: Any, noise: Mapping[str, Parameter]) -> Any:
    return noise[value] if isinstance(value, str) else value
