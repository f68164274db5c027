"""``[model.materials]`` and ``[model.sections]``: what members are made of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Self

from pydantic import Field, model_validator

from fmu.config.tables import Positive, TomlTable
from fmu.fem.frame.section import Section


class MaterialTable(TomlTable):
    """E in N/m², Poisson's ratio nu, density rho in kg/m³."""

    E: Positive
    nu: Annotated[float, Field(gt=-1, le=0.5)]
    rho: Positive


class Rectangle(TomlTable):
    """`width` along local y, `height` along local z, m."""

    width: Positive
    height: Positive


class Tube(TomlTable):
    """A circular tube: outer `diameter`, wall `thickness`, m."""

    diameter: Positive
    thickness: Positive

    @model_validator(mode="after")
    def _fits(self) -> Self:
        _made(Section.tube, self)
        return self


class ISection(TomlTable):
    """An I: `height` over all and the web along local z, flanges of `width` along local y; thicknesses, m."""

    height: Positive
    width: Positive
    web: Positive
    flange: Positive

    @model_validator(mode="after")
    def _fits(self) -> Self:
        _made(Section.i_section, self)
        return self


class SectionTable(TomlTable):
    """A cross-section: ``rectangle``, ``tube``, ``i``, or the constants A (m²), Iy, Iz, J (m⁴) themselves."""

    rectangle: Rectangle | None = None
    tube: Tube | None = None
    i: ISection | None = None
    A: Positive | None = None
    Iy: Positive | None = None
    Iz: Positive | None = None
    J: Positive | None = None

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        shapes = [self.rectangle, self.tube, self.i]
        constants = [self.A, self.Iy, self.Iz, self.J]
        given = [shape is not None for shape in shapes] + [any(c is not None for c in constants)]
        if sum(given) != 1:
            raise ValueError("must be either rectangle, or tube, or i, or A, Iy, Iz and J")
        if given[-1] and None in constants:
            raise ValueError("must have all of A, Iy, Iz and J")
        return self

    def section(self) -> Section:
        """Return the constants."""
        if self.rectangle is not None:
            return _made(Section.rectangle, self.rectangle)
        if self.tube is not None:
            return _made(Section.tube, self.tube)
        if self.i is not None:
            return _made(Section.i_section, self.i)
        return Section(A=self.A, Iy=self.Iy, Iz=self.Iz, J=self.J)  # type: ignore[arg-type]


def _made(make: Callable[..., Section], table: TomlTable) -> Section:
    """Return the section of a table's dimensions; ValueError in words that follow the table's place."""
    try:
        return make(**table.model_dump())
    except ValueError as error:
        raise ValueError(str(error).replace(": ", " ", 1)) from None
