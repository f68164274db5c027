"""``[model] type = "frame"``: straight members of beam elements between named points."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from fmu.config.fields import Name, NotNegative, Positive, Table, Vector
from fmu.config.mistakes import BrokenError, Mistake, got
from fmu.config.model import Built
from fmu.fem.frame import PROPERTIES, ElementGroup, Frame, Material, PointMass, Section

if TYPE_CHECKING:
    from fmu.config.parameters import ParameterTable

MOST_ELEMENTS = 100_000

Direction = Literal["x", "y", "z", "rx", "ry", "rz"]


class MaterialTable(Table):
    """E in N/m², Poisson's ratio nu, density rho in kg/m³."""

    E: Positive
    nu: Annotated[float, Field(gt=-1, le=0.5)]
    rho: Positive


class Rectangle(Table):
    """`width` along local y, `height` along local z, m."""

    width: Positive
    height: Positive


class Tube(Table):
    """A circular tube: outer `diameter`, wall `thickness`, m."""

    diameter: Positive
    thickness: Positive

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.thickness > self.diameter / 2:
            raise ValueError(got(f"thickness must not exceed half the diameter {self.diameter:g}", self.thickness))
        return self


class SectionTable(Table):
    """A cross-section: ``rectangle``, ``tube``, or the constants A (m²), Iy, Iz, J (m⁴) themselves."""

    rectangle: Rectangle | None = None
    tube: Tube | None = None
    A: Positive | None = None
    Iy: Positive | None = None
    Iz: Positive | None = None
    J: Positive | None = None

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        constants = [self.A, self.Iy, self.Iz, self.J]
        ways = [self.rectangle is not None, self.tube is not None, any(c is not None for c in constants)]
        if sum(ways) != 1:
            raise ValueError("must be either rectangle, or tube, or A, Iy, Iz and J")
        if ways[2] and None in constants:
            raise ValueError("must have all of A, Iy, Iz and J")
        return self

    def section(self) -> Section:
        """Return the constants."""
        if self.rectangle is not None:
            return Section.rectangle(self.rectangle.width, self.rectangle.height)
        if self.tube is not None:
            outer, inner = self.tube.diameter / 2, self.tube.diameter / 2 - self.tube.thickness
            second = np.pi / 4 * (outer**4 - inner**4)
            return Section(A=np.pi * (outer**2 - inner**2), Iy=second, Iz=second, J=2 * second)
        return Section(A=self.A, Iy=self.Iy, Iz=self.Iz, J=self.J)  # type: ignore[arg-type]


class Member(Table):
    """A straight row of `elements` elements between two points."""

    start: Annotated[Name, Field(alias="from")]
    end: Annotated[Name, Field(alias="to")]
    group: Name
    section: Name
    material: Name
    elements: Annotated[int, Field(ge=1, le=MOST_ELEMENTS)] = 1
    y_direction: Vector = [0.0, 1.0, 0.0]


class MassTable(Table):
    """A point mass in kg, with rotary inertias about the global axes in kg·m²."""

    point: Name
    mass: NotNegative
    inertia: Annotated[list[NotNegative], Field(min_length=3, max_length=3)] = [0.0, 0.0, 0.0]


class Target(Table):
    """What of a frame a parameter is the value of: a property, in groups of elements."""

    property: Literal["E", "rho", "A", "Iy", "Iz", "J"] | None = None
    groups: list[Name] = []


class FrameTable(Table):
    """A structure of beam elements."""

    type: Literal["frame"]
    points: Annotated[dict[Name, Vector], Field(min_length=2)]
    materials: Annotated[dict[Name, MaterialTable], Field(min_length=1)]
    sections: Annotated[dict[Name, SectionTable], Field(min_length=1)]
    members: Annotated[list[Member], Field(min_length=1)]
    supports: dict[Name, list[Direction] | Literal["clamped"]] = {}
    masses: list[MassTable] = []

    def mistakes(self, parameters: Sequence[ParameterTable]) -> list[Mistake]:
        """Return what is wrong between the tables: names that do not exist, members of no length."""
        return self._between_tables() + self._of_parameters(parameters)

    def build(self, folder: Path, parameters: Sequence[ParameterTable]) -> Built:
        """Return the model and the node of every point; BrokenError with what is wrong. It reads no files."""
        try:
            frame, node_of, parts = self._frame()
            updates = {
                table.name: [(str(table.property), part) for group in table.groups for part in parts[group]]
                for table in parameters
            }
            return Built(frame.separable(updates), node_of)
        except ValueError as error:
            raise BrokenError([Mistake("model", str(error))]) from error

    def _of_parameters(self, parameters: Sequence[ParameterTable]) -> list[Mistake]:
        found = []
        known = sorted({member.group for member in self.members})
        owner: dict[tuple[str | None, str], str] = {}
        for i, table in enumerate(parameters):
            if table.property is None:
                found.append(Mistake(f"parameters.{i}.property", f"is missing: one of {', '.join(PROPERTIES)}"))
            if not table.is_positive():
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

    def _between_tables(self) -> list[Mistake]:
        found = []
        for i, member in enumerate(self.members):
            for key, name, known in (
                ("from", member.start, self.points),
                ("to", member.end, self.points),
                ("section", member.section, self.sections),
                ("material", member.material, self.materials),
            ):
                if name not in known:
                    found.append(Mistake(f"model.members.{i}.{key}", _unknown(name, known)))
            if member.start == member.end:
                found.append(Mistake(f"model.members.{i}.to", got("must differ from from", member.end)))
        for where, names in (("supports", list(self.supports)), ("masses", [mass.point for mass in self.masses])):
            found += [Mistake(f"model.{where}", _unknown(n, self.points)) for n in names if n not in self.points]
        used = {point for member in self.members for point in (member.start, member.end)}
        idle = sorted(set(self.points) - used)
        found += [Mistake(f"model.points.{name}", "is the end of no member") for name in idle]
        if sum(member.elements for member in self.members) > MOST_ELEMENTS:
            found.append(Mistake("model.members", f"must have at most {MOST_ELEMENTS} elements together"))
        return found

    def _frame(self) -> tuple[Frame, dict[str, int], dict[str, list[str]]]:
        """Return the frame, the node of every point, and the frame's own groups by the name of each group here.

        Members of one group may differ in section, material and orientation; the frame has one group a member.
        """
        nodes: list[Any] = []
        node_of: dict[str, int] = {}

        def node_at(point: str) -> int:
            if point not in node_of:
                node_of[point] = len(nodes)
                nodes.append(np.array(self.points[point]))
            return node_of[point]

        groups: list[ElementGroup] = []
        parts: dict[str, list[str]] = {}
        for i, member in enumerate(self.members):
            first = node_at(member.start)
            a, b = (np.array(self.points[point]) for point in (member.start, member.end))
            inner = range(len(nodes), len(nodes) + member.elements - 1)
            nodes += [a + (b - a) * k / member.elements for k in range(1, member.elements)]
            chain = np.array([first, *inner, node_at(member.end)])
            name = f"{member.group} {i}"
            parts.setdefault(member.group, []).append(name)
            groups.append(
                ElementGroup(
                    name,
                    np.stack([chain[:-1], chain[1:]], axis=1),
                    self.sections[member.section].section(),
                    Material(**self.materials[member.material].model_dump()),
                    tuple(member.y_direction),  # type: ignore[arg-type]
                )
            )
        supports = {
            node_of[point]: ("x", "y", "z", "rx", "ry", "rz") if fixed == "clamped" else tuple(fixed)
            for point, fixed in self.supports.items()
        }
        masses = [PointMass(node_of[m.point], m.mass, tuple(m.inertia)) for m in self.masses]  # type: ignore[arg-type]
        return Frame(np.array(nodes), groups, supports, masses), node_of, parts


def _unknown(name: str, known: Any) -> str:
    return got(f"must be one of {', '.join(known)}", name)
