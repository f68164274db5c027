"""What the tables of a configuration file have in common."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Discriminator, Field, StringConstraints, Tag

from fmu.posterior.parameters import require_name

Name = Annotated[str, StringConstraints(min_length=1, max_length=100, pattern=r"^[^/\x00-\x1f]+$")]
"""No slash: traces keep names as paths."""


def _of_parameter(name: str) -> str:
    try:
        require_name(name)
    except ValueError as error:  # which ends with what was received
        raise ValueError(str(error).removeprefix("name: ")) from None
    return name


ParameterName = Annotated[Name, AfterValidator(_of_parameter)]
"""Kept apart from what else a trace has names for."""
FileName = Annotated[str, StringConstraints(min_length=1, max_length=1000, pattern=r"^[^\x00-\x1f]+$")]
"""From the folder of the TOML file."""
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Vector = Annotated[list[float], Field(min_length=3, max_length=3)]


def kind_of(value: Any) -> str | None:
    """Return of which kind a value is, where a key takes several; kinds are in angle brackets, unlike keys."""
    if isinstance(value, list):
        return "<rows>" if value and isinstance(value[0], list) else "<list>"
    if isinstance(value, str):
        return "<text>"
    if isinstance(value, bool):
        return "<switch>"
    return "<number>" if isinstance(value, int | float) else None


def by_kind(words: str) -> Discriminator:
    """Return what picks the type of a value by its kind, and says in `words` which kinds there are."""
    return Discriminator(kind_of, custom_error_type="kind", custom_error_message=f"must be {words}")


Number = Annotated[Positive, Tag("<number>")]
Numbers = Annotated[list[Positive], Tag("<list>")]
NumberOrNumbers = Annotated[Number | Numbers, by_kind("a number or a list of numbers")]
SensorTable = Annotated[list[int | str], Field(min_length=2, max_length=2)]
"""A place and a direction."""


class TomlTable(BaseModel):
    """A table of the file: unknown keys and values of the wrong type are mistakes, nothing is converted.

    The string below a key describes it in the schema that editors show (`fmu.config.schema`).
    """

    model_config = ConfigDict(
        extra="forbid", strict=True, frozen=True, allow_inf_nan=False, use_attribute_docstrings=True
    )
