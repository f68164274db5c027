"""``[model] type = "frame"``: straight members made of beam elements between named points."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from fmu.arguments import ArgumentError, Place
from fmu.config.mistakes import BrokenError, Mistakes
from fmu.config.parameters import KEYS, ModelTable, ParameterTable, Target
from fmu.config.tables import Built, Name, Of, TomlTable, Vector, inside
from fmu.fem.frame.beam import local_axes
from fmu.fem.frame.components import DIRECTIONS, ElementGroup, JointSpring, Material, PointMass, Section
from fmu.fem.frame.frame import Frame
from fmu.fem.frame.stability import require_stable
from fmu.fem.frame.updates import ROTATIONS, Factor
from fmu.fem.modes.separable import RigidArm
from fmu.formats.shown import names_shown, quote
from fmu.types import Direction, FloatArray, Positive

MOST_ELEMENTS = 10_000
"""Largest number of elements: 60 000 degrees of freedom, one second per solve. Condense larger structures and use
their matrices."""
_SHAPES = [
    inside("rectangle", Section.rectangle),
    inside("tube", Section.tube),
    inside("i", Section.i_section),
]


def _spring(
    point: Name | None = None,
    points: Annotated[list[Name], Field(min_length=2, max_length=2)] | None = None,
    stiffness: dict[Direction, Positive] = {},  # noqa: B006
    tied: list[Direction] = [],  # noqa: B006
) -> JointSpring:
    """Return springs along global axes, from one ``point`` to the ground or between two ``points``.

    Parameters
    ----------
    point : str
        The spring is between this point and the ground.
    points : list of str
        The spring is between these two points.
    stiffness : table
        Stiffness by direction: in N/m for x, y and z, in N·m/rad for rx, ry and rz.
    tied : list of str
        Directions in which two points at the same place move together.

    Raises
    ------
    ValueError
        If `point` and `points` are both given or both missing, or if `JointSpring` rejects the values.
    """
    if (point is None) == (points is None):
        raise ValueError("must have either point (to the ground) or points (between two)")
    ends = (str(point), None) if points is None else (points[0], points[1])
    try:
        return JointSpring("", ends, stiffness, tied)  # type: ignore[arg-type]
    except ArgumentError as error:
        raise error.replace_key("spring ''", "") from None


class Member(TomlTable):
    """A straight member between two points, divided into equally long elements.

    `elements` is the number of elements. `y_direction` is explained in `fmu.ElementGroup`.
    """

    start: Annotated[Name, Field(alias="from")]
    end: Annotated[Name, Field(alias="to")]
    group: Name
    section: Name
    material: Name
    elements: Annotated[int, Field(ge=1, le=MOST_ELEMENTS)] = 1
    y_direction: Vector | None = None


class FrameTable(ModelTable):
    """A structure made of beam elements. Set ``free = true`` if the structure is intentionally unsupported."""

    type: Literal["frame"]
    points: Annotated[dict[Name, Vector], Field(min_length=2)]
    materials: Annotated[dict[Name, Annotated[Material, Of("material", Material)]], Field(min_length=1)]
    sections: Annotated[dict[Name, Annotated[Section, Of("section", *_SHAPES, Section)]], Field(min_length=1)]
    members: Annotated[list[Member], Field(min_length=1)]
    supports: dict[Name, list[Direction] | Literal["clamped"]] = {}
    masses: list[Annotated[PointMass, Of("mass", PointMass, point="node")]] = []
    springs: dict[Name, Annotated[JointSpring, Of("spring", _spring)]] = {}
    offsets: dict[Name, Annotated[RigidArm, Of("offset", RigidArm, point="node")]] = {}
    free: bool = False

    def mistakes(self, parameters: Sequence[ParameterTable]) -> list[ArgumentError]:
        """Return inconsistencies in the tables, such as unknown names or zero-length members."""
        return self._between_tables() + self._of_points() + self._of_parameters(parameters)

    def build(self, folder: Path, parameters: Sequence[ParameterTable]) -> Built:
        """Build the model, and return it with each point's node. No file is read.

        Raise BrokenError on failure.
        """
        mesh = _Mesh(self)
        updates = {table.name: mesh.targets(table) for table in parameters}
        try:
            model = mesh.frame().separable(updates)
            model.place_names = {node: name for name, node in mesh.node_of.items()}
            require_stable(model, [table.start for table in parameters], self.free, mesh.label)
        except ValueError as error:
            wrong, places = ArgumentError.of(error), {t.name: f"parameters.{i}" for i, t in enumerate(parameters)}
            at = places.get(wrong.key)
            raise BrokenError(wrong.at(at) if at else ArgumentError("model", str(error))) from error
        return Built(model, mesh.node_of, model.n_dof)

    @property
    def groups(self) -> list[str]:
        """Names of the member groups, sorted."""
        return sorted({member.group for member in self.members})

    def _of_parameters(self, parameters: Sequence[ParameterTable]) -> list[ArgumentError]:
        found = self._of_targets(parameters)
        for i, table in enumerate(parameters):
            if not table.is_positive():
                found.add(f"parameters.{i}.lower", "must be positive, as the property is", quote(table.lower))
        return found

    def _of_targets(self, parameters: Sequence[ParameterTable]) -> Mistakes:
        """Return errors in parameter targets.

        An error is reported if a parameter has no property, names no group, mass or spring, has a key that does
        not belong to its property, or has an unknown name or direction; and if two parameters update the same
        quantity.
        """
        known: dict[str, Collection[str]] = {
            "groups": self.groups,
            "masses": [_known_as(mass) for mass in self.masses],
            "springs": list(self.springs),
        }
        found = Mistakes()
        owner: dict[tuple[str, str, str], str] = {}
        for i, table in enumerate(parameters):
            if table.property is None:
                found.add(f"parameters.{i}.property", f"is missing: one of {', '.join(KEYS)}")
            key = KEYS.get(table.property or "E", "groups")
            where = f"parameters.{i}.{key}"
            found += _out_of_place(f"parameters.{i}", table, key)
            names = table.names_at(key, self.groups)
            if not names:
                found.add(where, f"must name a {_SINGULAR[key]}")
            for name in names if table.property else ():
                if name not in known[key]:
                    found.add(where, f"must be among {names_shown(known[key])}", quote(name))
                    continue
                directions: Sequence[str] = table.directions
                if key == "springs":
                    has: list[str] = list(self.springs[name].stiffness)
                    rule = f"must be among those of {name}: {', '.join(has) or 'none'}"
                    wrong = [d for d in directions if d not in has]
                    found += [ArgumentError(f"parameters.{i}.directions", rule, quote(d)) for d in wrong]
                    directions = directions or has
                elif table.property == "inertia":
                    directions = directions or ROTATIONS
                for direction in directions or [""]:
                    quantity = str(table.property), name, direction
                    if quantity in owner:
                        along = f" along {direction}" if direction else ""
                        rule = f"{table.property} of {name}{along} is already updated by {owner[quantity]}"
                        found.add(where, rule)
                    owner[quantity] = table.name
        return found

    def _between_tables(self) -> list[ArgumentError]:
        found = Mistakes()
        for i, member in enumerate(self.members):
            for key, name, known in (
                ("from", member.start, self.points),
                ("to", member.end, self.points),
                ("section", member.section, self.sections),
                ("material", member.material, self.materials),
            ):
                if name not in known:
                    found.append(_unknown(f"model.members.{i}.{key}", name, known))
            if member.start == member.end:
                found.add(f"model.members.{i}.to", "must not be the same point as from", quote(member.end))
            elif self.points.get(member.start, 0) == self.points.get(member.end, 1):
                rule = "must not be at the place of from: the member would have no length"
                found.add(f"model.members.{i}.to", rule, repr(member.end))
            elif member.y_direction is not None and {member.start, member.end} <= self.points.keys():
                axis = np.subtract(self.points[member.end], self.points[member.start])
                try:
                    local_axes(axis[None], member.y_direction)
                except ArgumentError:
                    rule = f"must not be zero or parallel to the member, from {member.start} to {member.end}"
                    found.add(f"model.members.{i}.y_direction", rule, list(member.y_direction))
        if sum(member.elements for member in self.members) > MOST_ELEMENTS:
            found.add("model.members", f"must have at most {MOST_ELEMENTS} elements in total")
        names = [mass.name for mass in self.masses if mass.name]
        if len(set(names)) < len(names):
            found.add("model.masses", "must have distinct names", quote(names))
        if not (self.free or self.supports or any(spring.nodes[1] is None for spring in self.springs.values())):
            rule = (
                "must restrain the structure (a spring to the ground does too); set free = true if it is "
                "free on purpose"
            )
            found.add("model.supports", rule)
        return found

    def _of_points(self) -> list[ArgumentError]:
        named: list[tuple[str, Place]] = [("supports", name) for name in self.supports]
        named += [("masses", mass.node) for mass in self.masses]
        named += [(f"springs.{key}", end) for key, spring in self.springs.items() for end in _ends(spring)]
        named += [(f"offsets.{key}.point", arm.node) for key, arm in self.offsets.items()]
        found = [_unknown(f"model.{where}", name, self.points) for where, name in named if name not in self.points]
        found += [
            ArgumentError(f"model.offsets.{name}", "must not have the name of a point")
            for name in self.offsets
            if name in self.points
        ]
        used = {point for member in self.members for point in (member.start, member.end)}
        used |= {end for spring in self.springs.values() for end in _ends(spring)}
        idle = sorted(set(self.points) - used)
        return found + [
            ArgumentError(f"model.points.{name}", "is not connected to a member or spring") for name in idle
        ]


class _Mesh:
    """Nodes and elements of the frame in a table.

    Members of a group may differ in section, material and orientation; the frame has one element group per member.
    """

    def __init__(self, table: FrameTable) -> None:
        self.table = table
        self.nodes: list[FloatArray] = []
        self.node_of: dict[str, int] = {}
        self.parts: dict[str, list[str]] = {}
        self._between: dict[int, str] = {}
        self._groups = [self._group(i, member) for i, member in enumerate(table.members)]
        for spring in table.springs.values():
            for end in _ends(spring):
                self._node_at(end)

    def frame(self) -> Frame:
        table, at = self.table, self.node_of
        supports = {
            at[point]: DIRECTIONS if fixed == "clamped" else tuple(fixed)
            for point, fixed in table.supports.items()
        }
        names = [_known_as(mass) for mass in table.masses]
        masses = [
            replace(mass, node=at[mass.node], name=name if names.count(name) == 1 else "")
            for mass, name in zip(table.masses, names, strict=True)
        ]
        arms = {name: replace(arm, node=at[arm.node]) for name, arm in table.offsets.items()}
        springs = [
            replace(spring, name=name, nodes=(*(at[end] for end in _ends(spring)), None)[:2])  # type: ignore[arg-type]
            for name, spring in table.springs.items()
        ]
        return Frame(np.array(self.nodes), self._groups, supports, masses, arms, springs)

    def targets(self, table: Target) -> list[tuple[str, ...]] | Factor:
        """Return a parameter's targets as arguments for `Frame.separable`: a list of name tuples, or a Factor."""
        named = table.names_at(KEYS[str(table.property)], self.table.groups)
        if table.property not in ("mass", "inertia", "stiffness"):
            named = [part for group in named for part in self.parts[group]]
        names = [(str(table.property), thing) for thing in named]
        targets = [(*name, direction) for name in names for direction in table.directions] or names
        return Factor(targets) if table.scaling == "factor" else list(targets)

    def label(self, node: int) -> str:
        """Return a node's label: the name of its point, or "between …" with the names of the member's ends.

        The label is empty for an unknown node.
        """
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
            self.table.sections[member.section],
            self.table.materials[member.material],
            None if member.y_direction is None else tuple(member.y_direction),  # type: ignore[arg-type]
        )


_SINGULAR = {"groups": "group", "masses": "mass", "springs": "spring"}


def _out_of_place(where: str, table: Target, key: str) -> list[ArgumentError]:
    """Return an error for each key that a parameter with this property must not have."""
    wrong = [other for other in _SINGULAR if other != key and table.names_at(other, ["all"])]
    if table.directions and table.property not in ("inertia", "stiffness"):
        wrong.append("directions")
    return [
        ArgumentError(f"{where}.{other}", f"must be left out: {table.property} belongs to {key}")
        for other in wrong
    ]


def _ends(spring: JointSpring) -> list[str]:
    """Return the names of the one or two points that a spring connects."""
    return [str(end) for end in spring.nodes if end is not None]


def _known_as(mass: PointMass) -> str:
    """Return the name that parameters use for a point mass: its own name, or its point's name if it has none."""
    return mass.name or str(mass.node)


def _unknown(where: str, name: Place, known: Collection[str]) -> ArgumentError:
    return ArgumentError(where, f"must be one of {names_shown(known)}", quote(name))
