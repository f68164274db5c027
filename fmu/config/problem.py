"""The whole file: model, measurement, parameters -> an updating problem."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from fmu.config.fields import Name, Positive, Table
from fmu.config.frame import FrameTable
from fmu.config.matrices import MatricesTable, SensorTable
from fmu.config.mistakes import ConfigurationError, Mistake, got
from fmu.fem.frame import PROPERTIES
from fmu.fem.separable import SeparableModel
from fmu.posterior.measurement import ModalData
from fmu.posterior.parameters import Normal, Parameter, Prior, Uniform
from fmu.posterior.problem import UpdatingProblem


class NormalTable(Table):
    """Gaussian, cut off at the bounds: eq. (6) of the paper with α = 1/sd²."""

    distribution: Literal["normal"]
    sd: Positive
    mean: float = 0.0


class UniformTable(Table):
    """Constant between the bounds."""

    distribution: Literal["uniform"]


class ParameterTable(Table):
    """A parameter; in a frame, what it is the value of, in which groups."""

    name: Name
    start: float
    lower: float | None = None
    upper: float | None = None
    unit: str = ""
    prior: Annotated[NormalTable | UniformTable, Field(discriminator="distribution")] = UniformTable(
        distribution="uniform"
    )
    property: Literal["E", "rho", "A", "Iy", "Iz", "J"] | None = None
    groups: list[Name] = []

    def build(self) -> Parameter:
        """Return the parameter.

        Raises
        ------
        ValueError
            If bounds, start and prior do not fit each other.
        """
        prior: Prior = Uniform()
        if isinstance(self.prior, NormalTable):
            prior = Normal(self.prior.sd, self.prior.mean)
        lower = -np.inf if self.lower is None else self.lower
        upper = np.inf if self.upper is None else self.upper
        return Parameter(self.name, self.start, lower, upper, prior, self.unit)


class MeasurementTable(Table):
    """The modes measured. Of the errors in frequency either ``sd`` in Hz, or ``beta`` = 1/(2 sd²)."""

    frequencies: Annotated[list[Positive], Field(min_length=1)]
    sd: Positive | list[Positive] | None = None
    beta: Positive | list[Positive] | None = None
    numbers: list[Annotated[int, Field(ge=1)]] = []
    labels: list[Name] = []
    sensors: list[SensorTable] = []
    shapes: list[list[float]] | None = None

    @model_validator(mode="after")
    def _trust(self) -> Self:
        if (self.sd is None) == (self.beta is None):
            raise ValueError("must have either sd or beta")
        n = len(self.frequencies)
        for key in ("sd", "beta", "numbers", "labels", "shapes"):
            value = getattr(self, key)
            if isinstance(value, list) and value and len(value) != n:
                raise ValueError(f"{key} must be {n}, one a mode (got {len(value)})")
        return self

    @property
    def weights(self) -> Any:
        """β of eq. (4), one or one a mode, 1/Hz²."""
        return self.beta if self.sd is None else (1.0 / (2.0 * np.asarray(self.sd) ** 2)).tolist()


class ProblemFile(Table):
    """A file."""

    name: Name
    description: str = ""
    pairing: Literal["shape", "index"] = "shape"
    error: Literal["frequency", "modal-residual"] = "frequency"
    reduction: bool = True
    model: Annotated[FrameTable | MatricesTable, Field(discriminator="type")]
    measurement: MeasurementTable
    parameters: Annotated[list[ParameterTable], Field(min_length=1)]

    def build(self, source: str, folder: Path, pairing: str | None = None, beta: Any = None) -> UpdatingProblem:
        """Return the problem; ConfigurationError with every mistake if there is one.

        Parameters
        ----------
        source : str
            What to call the file in the error.
        folder : Path
            Where files that it names are.
        pairing, beta : optional
            Instead of those of the file.
        """
        parameters, found = self._parameters()
        found += self._model_mistakes()
        if found:
            raise ConfigurationError(source, found)
        model, node_of, found = self._model(folder)
        if model is None:
            raise ConfigurationError(source, found)
        m = self.measurement
        sensors, found = self._sensors(model, node_of)
        if found:
            raise ConfigurationError(source, found)
        try:
            shapes = None if m.shapes is None else np.array(m.shapes, dtype=float).T
            data = ModalData(m.frequencies, tuple(m.numbers), sensors, tuple(m.labels), shapes)
            return UpdatingProblem(
                model,
                data,
                parameters,
                pairing=pairing or self.pairing,
                reduction=self.reduction,
                beta=m.weights if beta is None else beta,
                error=self.error,
                name=f"{self.name}, by {pairing or self.pairing}",
            )
        except ValueError as error:
            raise ConfigurationError(source, [Mistake("", str(error))]) from error

    def _parameters(self) -> tuple[list[Parameter], list[Mistake]]:
        built, found = [], []
        names = [table.name for table in self.parameters]
        for i, table in enumerate(self.parameters):
            if table.name in names[:i]:
                found.append(
                    Mistake(f"parameters.{i}.name", got("must not be that of another parameter", table.name))
                )
            try:
                built.append(table.build())
            except ValueError as error:
                found.append(Mistake(f"parameters.{i}", str(error).removeprefix(f"{table.name}.")))
        return built, found

    def _model_mistakes(self) -> list[Mistake]:
        if isinstance(self.model, MatricesTable):
            return self.model.mistakes([table.name for table in self.parameters])
        found = self.model.mistakes()
        known = sorted(self.model.groups())
        owner: dict[tuple[str | None, str], str] = {}
        for i, table in enumerate(self.parameters):
            if table.property is None:
                found.append(Mistake(f"parameters.{i}.property", f"is missing: one of {', '.join(PROPERTIES)}"))
            if table.lower is None or table.lower <= 0:
                rule = got("must be positive, as the property is", table.lower)
                found.append(Mistake(f"parameters.{i}.lower", rule))
            if not table.groups:
                found.append(Mistake(f"parameters.{i}.groups", "must name a group"))
            for group in table.groups:
                where = f"parameters.{i}.groups"
                if group not in known:
                    found.append(Mistake(where, got(f"must be among {', '.join(known)}", group)))
                elif (table.property, group) in owner:
                    other = owner[table.property, group]
                    found.append(Mistake(where, f"{table.property} of {group} is updated by {other} already"))
                owner[table.property, group] = table.name
        return found

    def _model(self, folder: Path) -> tuple[SeparableModel | None, dict[str, int], list[Mistake]]:
        if isinstance(self.model, MatricesTable):
            model, found = self.model.build(folder, [table.name for table in self.parameters])
            return model, {}, found
        try:
            frame, node_of, parts = self.model.build()
            updates = {
                table.name: [(str(table.property), part) for group in table.groups for part in parts[group]]
                for table in self.parameters
            }
            return frame.separable(updates), node_of, []
        except ValueError as error:
            return None, {}, [Mistake("model", str(error))]

    def _sensors(
        self, model: SeparableModel, node_of: dict[str, int]
    ) -> tuple[tuple[tuple[Any, str], ...], list[Mistake]]:
        sensors, found = [], []
        for i, (place, direction) in enumerate(self.measurement.sensors):
            node = node_of.get(str(place), place)
            if (node, direction) in model.dofs:
                sensors.append((node, str(direction)))
            else:
                rule = got("must be a point and a direction that are free to move", [place, direction])
                found.append(Mistake(f"measurement.sensors.{i}", rule))
        return tuple(sensors), found
