"""``[[model.masses]]``, ``[model.springs]`` and ``[model.offsets]``: what a frame has at its points."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from fmu.config.mistakes import got
from fmu.config.parameters import Direction
from fmu.config.tables import Name, NotNegative, Positive, TomlTable, Vector


class MassTable(TomlTable):
    """A point mass, kg, with rotary inertias about global axes, kg·m²; its name is the point's by default."""

    point: Name
    mass: NotNegative
    inertia: Annotated[list[NotNegative], Field(min_length=3, max_length=3)] = [0.0, 0.0, 0.0]
    name: Name | None = None

    @property
    def known_as(self) -> str:
        """What a parameter calls it."""
        return self.name or self.point


class SpringTable(TomlTable):
    """Springs along global axes, in N/m and N·m/rad: of one ``point`` to the ground, or between two ``points``.

    In the directions of ``tied`` two points at the same place move as one.
    """

    point: Name | None = None
    points: Annotated[list[Name], Field(min_length=2, max_length=2)] | None = None
    stiffness: dict[Direction, Positive] = {}
    tied: list[Direction] = []

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        if (self.point is None) == (self.points is None):
            raise ValueError("must have either point (to the ground) or points (between two)")
        if not self.stiffness and not self.tied:
            raise ValueError("must have a stiffness or a tied direction")
        if self.tied and self.points is None:
            raise ValueError("tied is for two points; hold a point in [model.supports]")
        if self.points is not None and self.points[0] == self.points[1]:
            raise ValueError(got("points must differ", self.points))
        both = [direction for direction in self.stiffness if direction in self.tied]
        if both:
            raise ValueError(f"must be either elastic or tied in a direction (got both in {', '.join(both)})")
        return self

    @property
    def ends(self) -> list[str]:
        """The points that it is at."""
        return self.points if self.points is not None else [str(self.point)]


class OffsetTable(TomlTable):
    """A place for sensors, rigidly joined to a point, `offset` from it along global axes, m."""

    point: Name
    offset: Vector
