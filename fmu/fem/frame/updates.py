"""Properties of element groups, point masses and springs that a frame's parameters change."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from fmu.arguments import ArgumentError, check_arguments
from fmu.fem.frame.components import DIRECTIONS, ElementGroup, JointSpring, PointMass
from fmu.numbers import names_in_words

Thing = ElementGroup | PointMass | JointSpring
Target = Sequence[str]
"""Target of a parameter: (property,), (property, name) or (property, name, direction)."""

PROPERTIES = ("E", "rho", "A", "Iy", "Iz", "J")
"""Properties of an element group that a parameter may change."""
_UNITS = dict(zip(PROPERTIES, ("Pa", "kg/m³", "m²", "m⁴", "m⁴", "m⁴"), strict=True))
_UNITS |= {"mass": "kg", "inertia": "kg·m²", "stiffness": "N/m"}
ROTATIONS = DIRECTIONS[3:]
_KIND = dict.fromkeys(PROPERTIES, "group") | {"mass": "mass", "inertia": "mass", "stiffness": "spring"}


@check_arguments
@dataclass(frozen=True)
class Factor:
    """A dimensionless parameter that multiplies its targets' values in the frame.

    Attributes
    ----------
    targets : sequence of tuple of str
        Targets as in `fmu.Frame.separable`. The targets may differ in value, and even in kind.

    Raises
    ------
    ValueError
        If a target is not a sequence of str.
    """

    targets: Sequence[Target]


class Quantity(NamedTuple):
    """One value in a frame: a property of a group, mass or spring (by index), with a direction if it has one."""

    property: str
    number: int
    direction: str = ""


class Owner(NamedTuple):
    """The index of the parameter that determines a quantity, and whether it sets or multiplies the quantity."""

    parameter: int
    factor: bool


@dataclass(frozen=True)
class Ownership:
    """Which parameter sets or multiplies each quantity in a frame.

    Attributes
    ----------
    owner : mapping of Quantity to Owner
    n_parameters : int
    """

    owner: Mapping[Quantity, Owner]
    n_parameters: int

    def of_spring(self, number: int) -> int | None:
        """Return the index of the first parameter that changes a spring's stiffness, or None if none does."""
        owners = [
            one.parameter for q, one in self.owner.items() if (q.property, q.number) == ("stiffness", number)
        ]
        return min(owners, default=None)

    def coefficient(self, quantities: Iterable[tuple[Quantity, float]]) -> tuple[float, tuple[float, ...]]:
        """Return a product of quantities as a constant and a power for each parameter.

        Each quantity is given with its value.
        """
        scale, powers = 1.0, [0.0] * self.n_parameters
        for quantity, value in quantities:
            owner = self.owner.get(quantity)
            if owner is not None:
                powers[owner.parameter] += 1.0
            if owner is None or owner.factor:
                scale *= value
        return scale, tuple(powers)


def ownership(
    updates: Mapping[str, Sequence[Target] | Factor],
    groups: Sequence[ElementGroup],
    masses: Sequence[PointMass],
    springs: Sequence[JointSpring],
) -> Ownership:
    """Return which parameter sets or multiplies each quantity; see `fmu.Frame.separable` for `updates`.

    Raises
    ------
    ValueError
        If names are not distinct, a target does not exist or is updated twice, an inertia of zero is updated
        without a direction, a factor multiplies a value of zero, or the targets of a parameter that is not a
        `Factor` have values in different units.
    """
    things: dict[str, Sequence[Thing]] = {"group": groups, "mass": masses, "spring": springs}
    for kind, plural in (("group", "groups"), ("mass", "masses"), ("spring", "springs")):
        names = [thing.name for thing in things[kind] if thing.name or kind == "group"]
        if len(set(names)) < len(names):
            raise ArgumentError(plural, "names must be distinct", names)
    owner: dict[Quantity, Owner] = {}
    for j, (parameter, targets) in enumerate(updates.items()):
        listed, factor = (targets.targets, True) if isinstance(targets, Factor) else (targets, False)
        units: dict[str, None] = {}
        for target in listed:
            for quantity in _quantities(parameter, target, things, factor):
                if quantity in owner:
                    raise ArgumentError(parameter, f"{_in_words(quantity, things)} is updated already")
                owner[quantity] = Owner(j, factor)
                units[_unit(quantity)] = None
        if len(units) > 1 and not factor:
            rule = f"values in {names_in_words(list(units))} cannot be equal"
            raise ArgumentError(parameter, f"{rule}: leave some out, name a direction, or use a factor")
    return Ownership(owner, len(updates))


def _quantities(
    parameter: str, target: Target, things: Mapping[str, Sequence[Thing]], factor: bool
) -> list[Quantity]:
    if not target:
        raise ArgumentError(parameter, f"each target must name a property, one of {tuple(_KIND)}", repr(target))
    name, of, direction = target[0], target[1] if len(target) > 1 else None, target[2:]
    if name not in _KIND:
        raise ArgumentError(parameter, f"property must be one of {tuple(_KIND)}", repr(name))
    kind = _KIND[name]
    picked = [(i, thing) for i, thing in enumerate(things[kind]) if of is None or thing.name == of]
    if not picked or of == "":
        known = sorted(thing.name for thing in things[kind] if thing.name)
        raise ArgumentError(parameter, f"{kind} must be one of {known}", repr(of))
    if name in PROPERTIES or name == "mass":
        if direction:
            raise ArgumentError(parameter, f"{name} has no direction", repr(direction[0]))
        found = [Quantity(name, i) for i, _ in picked]
    else:
        found = [q for i, thing in picked for q in _by_direction(parameter, name, i, thing, direction)]
    if factor:
        for quantity in found:
            if things[kind][quantity.number].value(quantity.direction or name) == 0.0:
                raise ArgumentError(parameter, f"{_in_words(quantity, things)} is 0, a factor changes nothing")
    return found


def _by_direction(parameter: str, name: str, i: int, thing: Thing, direction: Sequence[str]) -> list[Quantity]:
    known = thing.directions
    has = tuple(d for d in known if thing.value(d) > 0.0)
    if not direction and not has:
        raise ArgumentError(parameter, f"{name} of {thing.name!r} is 0: name a direction")
    for d in direction:
        if d not in known:
            raise ArgumentError(parameter, f"direction of {thing.name!r} must be one of {known}", repr(d))
    return [Quantity(name, i, d) for d in direction or has]


def _unit(quantity: Quantity) -> str:
    rotates = quantity.property == "stiffness" and quantity.direction in ROTATIONS
    return "N·m/rad" if rotates else _UNITS[quantity.property]


def _in_words(quantity: Quantity, things: Mapping[str, Sequence[Thing]]) -> str:
    kind = _KIND[quantity.property]
    along = f" along {quantity.direction}" if quantity.direction else ""
    return f"{quantity.property}{along} of {kind} {things[kind][quantity.number].name!r}"
