"""``[model] type = "frame"``: straight members of beam elements between named points."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from fmu.config.mistakes import BrokenError, Mistake, got
from fmu.config.model.joints import MassTable, OffsetTable, SpringTable
from fmu.config.model.sections import MaterialTable, SectionTable
from fmu.config.model.table import Built
from fmu.config.model.targets import target_mistakes, things
from fmu.config.parameters import Direction, ParameterTable, Target
from fmu.config.tables import Name, TomlTable, Vector
from fmu.fem.frame.frame import DIRECTIONS, ElementGroup, Factor, Frame, JointSpring, Material, PointMass
from fmu.fem.frame.stability import require_stable
from fmu.fem.modes.separable import RigidArm
from fmu.formats.shown import names_shown

MOST_ELEMENTS = 10_000
"""60 000 degrees of freedom, a second a solve: a larger structure comes condensed, as matrices."""


class Member(TomlTable):
    """A straight row of `elements` elements between two points; `y_direction` as that of an `ElementGroup`."""

    start: Annotated[Name, Field(alias="from")]
    end: Annotated[Name, Field(alias="to")]
    group: Name
    section: Name
    material: Name
    elements: Annotated[int, Field(ge=1, le=MOST_ELEMENTS)] = 1
    y_direction: Vector | None = None


class FrameTable(TomlTable):
    """A structure of beam elements; ``free = true`` if nothing holds it, on purpose."""

    type: Literal["frame"]
    points: Annotated[dict[Name, Vector], Field(min_length=2)]
    materials: Annotated[dict[Name, MaterialTable], Field(min_length=1)]
    sections: Annotated[dict[Name, SectionTable], Field(min_length=1)]
    members: Annotated[list[Member], Field(min_length=1)]
    supports: dict[Name, list[Direction] | Literal["clamped"]] = {}
    masses: list[MassTable] = []
    springs: dict[Name, SpringTable] = {}
    offsets: dict[Name, OffsetTable] = {}
    free: bool = False

    def mistakes(self, parameters: Sequence[ParameterTable]) -> list[Mistake]:
        """Return what is wrong between the tables: names that do not exist, members of no length."""
        return self._between_tables() + self._of_points() + self._of_parameters(parameters)

    def build(self, folder: Path, parameters: Sequence[ParameterTable]) -> Built:
        """Return the model and the node of every point; BrokenError with what is wrong. It reads no files."""
        mesh = _Mesh(self)
        updates = {table.name: mesh.targets(table) for table in parameters}
        try:
            model = mesh.frame().separable(updates)
            require_stable(model, [table.start for table in parameters], self.free, mesh.label)
        except ValueError as error:
            name, _, rule = str(error).partition(": ")
            places = [f"parameters.{i}" for i, table in enumerate(parameters) if table.name == name]
            raise BrokenError([Mistake(places[0], rule) if places else Mistake("model", str(error))]) from error
        return Built(model, mesh.node_of)

    @property
    def groups(self) -> list[str]:
        """Names of the groups of members, sorted."""
        return sorted({member.group for member in self.members})

    def _of_parameters(self, parameters: Sequence[ParameterTable]) -> list[Mistake]:
        found = target_mistakes([p.name for p in parameters], parameters, self.groups, self.masses, self.springs)
        for i, table in enumerate(parameters):
            if not table.is_positive():
                rule = got("must be positive, as the property is", table.lower)
                found.append(Mistake(f"parameters.{i}.lower", rule))
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
                found.append(
                    Mistake(f"model.members.{i}.to", got("must not be the same point as from", member.end))
                )
            elif self.points.get(member.start, 0) == self.points.get(member.end, 1):
                rule = f"must not be at the place of from: the member would have no length (got {member.end!r})"
                found.append(Mistake(f"model.members.{i}.to", rule))
        if sum(member.elements for member in self.members) > MOST_ELEMENTS:
            found.append(Mistake("model.members", f"must have at most {MOST_ELEMENTS} elements in total"))
        names = [mass.name for mass in self.masses if mass.name is not None]
        if len(set(names)) < len(names):
            found.append(Mistake("model.masses", got("must have distinct names", names)))
        if not (self.free or self.supports or any(spring.points is None for spring in self.springs.values())):
            rule = (
                "must restrain the structure (a spring to the ground does too); set free = true if it is "
                "free on purpose"
            )
            found.append(Mistake("model.supports", rule))
        return found

    def _of_points(self) -> list[Mistake]:
        named = [("supports", name) for name in self.supports] + [("masses", mass.point) for mass in self.masses]
        named += [(f"springs.{key}", end) for key, spring in self.springs.items() for end in spring.ends]
        named += [(f"offsets.{key}.point", table.point) for key, table in self.offsets.items()]
        found = [
            Mistake(f"model.{where}", _unknown(name, self.points))
            for where, name in named
            if name not in self.points
        ]
        found += [
            Mistake(f"model.offsets.{name}", "must not have the name of a point")
            for name in self.offsets
            if name in self.points
        ]
        used = {point for member in self.members for point in (member.start, member.end)}
        used |= {end for spring in self.springs.values() for end in spring.ends}
        idle = sorted(set(self.points) - used)
        return found + [Mistake(f"model.points.{name}", "is not connected to a member or spring") for name in idle]


class _Mesh:
    """The nodes and elements of a table.

    Members of one group may differ in section, material and orientation; the frame has one group a member.
    """

    def __init__(self, table: FrameTable) -> None:
        self.table = table
        self.nodes: list[Any] = []
        self.node_of: dict[str, int] = {}
        self.parts: dict[str, list[str]] = {}
        self._between: dict[int, str] = {}
        self._groups = [self._group(i, member) for i, member in enumerate(table.members)]
        for spring in table.springs.values():
            for end in spring.ends:
                self._node_at(end)

    def frame(self) -> Frame:
        """Return the frame; ValueError with what is wrong with it."""
        table, at = self.table, self.node_of
        supports = {
            at[point]: DIRECTIONS if fixed == "clamped" else tuple(fixed)
            for point, fixed in table.supports.items()
        }
        names = [mass.known_as for mass in table.masses]
        masses = [
            PointMass(at[m.point], m.mass, tuple(m.inertia), m.known_as if names.count(m.known_as) == 1 else "")  # type: ignore[arg-type]
            for m in table.masses
        ]
        arms = {
            name: RigidArm(at[place.point], tuple(place.offset))  # type: ignore[arg-type]
            for name, place in table.offsets.items()
        }
        springs = [
            JointSpring(name, (*(at[end] for end in spring.ends), None)[:2], spring.stiffness, spring.tied)  # type: ignore[arg-type]
            for name, spring in table.springs.items()
        ]
        return Frame(np.array(self.nodes), self._groups, supports, masses, arms, springs)

    def targets(self, table: Target) -> list[tuple[str, ...]] | Factor:
        """Return what a parameter stands for, as `Frame.separable` has it."""
        named = things(table, self.table.groups)
        if table.property not in ("mass", "inertia", "stiffness"):
            named = [part for group in named for part in self.parts[group]]
        names = [(str(table.property), thing) for thing in named]
        targets = [(*name, direction) for name in names for direction in table.directions] or names
        return Factor(targets) if table.scaling == "factor" else list(targets)

    def label(self, node: int) -> str:
        """Return the name of a node's point, or between which points it is."""
        return next((name for name, number in self.node_of.items() if number == node), self._between.get(node, ""))

    def _node_at(self, point: str) -> int:
        if point not in self.node_of:
            self.node_of[point] = len(self.nodes)
            self.nodes.append(np.array(self.table.points[point]))
        return self.node_of[point]

    def _group(self, i: int, member: Member) -> ElementGroup:
        first = self._node_at(member.start)
        a, b = (np.array(self.table.points[point]) for point in (member.start, member.end))
        inner = range(len(self.nodes), len(self.nodes) + member.elements - 1)
        self.nodes += [a + (b - a) * k / member.elements for k in range(1, member.elements)]
        self._between |= dict.fromkeys(inner, f"between {member.start} and {member.end}")
        chain = np.array([first, *inner, self._node_at(member.end)])
        name = f"{member.group} {i}"
        self.parts.setdefault(member.group, []).append(name)
        return ElementGroup(
            name,
            np.stack([chain[:-1], chain[1:]], axis=1),
            self.table.sections[member.section].section(),
            Material(**self.table.materials[member.material].model_dump()),
            None if member.y_direction is None else tuple(member.y_direction),  # type: ignore[arg-type]
        )


def _unknown(name: str, known: Any) -> str:
    return got(f"must be one of {names_shown(known)}", name)
