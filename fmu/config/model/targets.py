"""What of a frame a parameter stands for: keys of ``[[parameters]]``, and what can be wrong with them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from fmu.config.mistakes import Mistake, got
from fmu.config.model.joints import MassTable, SpringTable
from fmu.config.parameters import Target
from fmu.fem.frame.updates import PROPERTIES
from fmu.formats.shown import names_shown

KEYS = dict.fromkeys(PROPERTIES, "groups") | {"mass": "masses", "inertia": "masses", "stiffness": "springs"}
"""Which key names the things that have a property."""


def things(table: Target, groups: Sequence[str]) -> list[str]:
    """Return the names of the groups, masses or springs that a parameter is about."""
    if table.property is None:
        return []
    named = getattr(table, KEYS[table.property])
    return list(groups) if named == "all" else list(named)


def target_mistakes(
    names: Sequence[str],
    targets: Sequence[Target],
    groups: Sequence[str],
    masses: Sequence[MassTable],
    springs: Mapping[str, SpringTable],
) -> list[Mistake]:
    """Return what is wrong with what these parameters stand for: things, directions, what two of them have."""
    known: dict[str, Collection[str]] = {
        "groups": groups,
        "masses": [mass.known_as for mass in masses],
        "springs": list(springs),
    }
    found: list[Mistake] = []
    owner: dict[tuple[str, str, str], str] = {}
    for i, table in enumerate(targets):
        if table.property is None:
            found.append(Mistake(f"parameters.{i}.property", f"is missing: one of {', '.join(KEYS)}"))
        key = KEYS.get(table.property or "E", "groups")
        found += _out_of_place(f"parameters.{i}", table, key)
        if not getattr(table, key):
            found.append(Mistake(f"parameters.{i}.{key}", f"must name a {_SINGULAR[key]}"))
        for name in things(table, groups):
            where = f"parameters.{i}.{key}"
            if name not in known[key]:
                found.append(Mistake(where, got(f"must be among {names_shown(known[key])}", name)))
                continue
            directions: Sequence[str] = table.directions
            if key == "springs":
                has = list(springs[name].stiffness)
                wrong = [d for d in directions if d not in has]
                rule = f"must be among those of {name}: {', '.join(has) or 'none'}"
                found += [Mistake(f"parameters.{i}.directions", got(rule, d)) for d in wrong]
                directions = directions or has
            elif table.property == "inertia":
                directions = directions or ["rx", "ry", "rz"]
            for direction in directions or [""]:
                quantity = str(table.property), name, direction
                if quantity in owner:
                    along = f" along {direction}" if direction else ""
                    rule = f"{table.property} of {name}{along} is already updated by {owner[quantity]}"
                    found.append(Mistake(where, rule))
                owner[quantity] = names[i]
    return found


_SINGULAR = {"groups": "group", "masses": "mass", "springs": "spring"}


def _out_of_place(where: str, table: Target, key: str) -> list[Mistake]:
    """Return the keys that a parameter of such a property must not have."""
    wrong = [other for other in _SINGULAR if other != key and getattr(table, other)]
    if table.directions and table.property not in ("inertia", "stiffness"):
        wrong.append("directions")
    return [Mistake(f"{where}.{other}", f"must be left out: {table.property} belongs to {key}") for other in wrong]
