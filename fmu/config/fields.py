"""What the tables of a configuration file have in common."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

Name = Annotated[str, StringConstraints(min_length=1, max_length=100, pattern=r"^[^/\x00-\x1f]+$")]
"""No slash: traces keep names as paths."""
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]

SensorTable = Annotated[list[int | str], Field(min_length=2, max_length=2)]
"""A place and a direction."""


class Table(BaseModel):
    """A table of the file: unknown keys and values of the wrong type are mistakes, nothing is converted."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)
