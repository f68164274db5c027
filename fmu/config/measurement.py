"""``[measurement]``: the modes of a test."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, model_validator

from fmu.config.fields import Name, Positive, SensorTable, Table
from fmu.config.mistakes import BrokenError, Mistake, got
from fmu.config.model import Built
from fmu.posterior.measurement import ModalData


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

    def build(self, folder: Path, built: Built) -> ModalData:
        """Return the data, at sensors of the model; BrokenError with what is wrong. Files are in `folder`."""
        sensors, found = [], []
        for i, (place, direction) in enumerate(self.sensors):
            sensor = (built.places.get(str(place), place), str(direction))
            if built.model.sees(sensor):
                sensors.append(sensor)
            else:
                rule = got("must be a point and a direction that are free to move", [place, direction])
                found.append(Mistake(f"measurement.sensors.{i}", rule))
        if found:
            raise BrokenError(found)
        shapes = None if self.shapes is None else np.array(self.shapes, dtype=float).T
        return ModalData(self.frequencies, tuple(self.numbers), tuple(sensors), tuple(self.labels), shapes)
