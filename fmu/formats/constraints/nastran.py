"""Constraints in Nastran bulk data (RBE2, RBE3, RBAR, RBAR1, MPC, MPCADD), and the active SPC and MPC sets.

The entries are described in MSC Nastran, *Quick reference guide*. Rigid elements are always active. MPC and SPC
entries are active if the case control selects their set; in a file that contains only bulk data, all of them are
active.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field

import numpy as np

from fmu.formats.constraints.equations import Equation, explicit_equation, solve_for_dependents
from fmu.formats.constraints.rigid import ALL, Point, mean_motion, rigid_body, rigid_link
from fmu.formats.matrices.limits import MOST_DOFS, DofName, RefusedError
from fmu.formats.matrices.nastran.cards import components, expand_list, identity, number
from fmu.formats.shown import names_shown, quote
from fmu.types import DIRECTIONS

_RIGID = ("RBE2", "RBE3", "RBAR", "RBAR1")
ENTRIES = (*_RIGID, "MPC", "MPCADD", "SPCADD")
_REFERENCES = ("SUPORT", "SUPORT1")
UNREAD = ("RBE1", "RROD", "RTRPLT", "RTRPLT1", "RSSCON", "RSPLINE", "RJOINT", "MPCAX", *_REFERENCES)
"""Constraint entries that are skipped."""
MOST_FIELDS = 2**22
"""Largest total number of fields in all constraints."""
_SELECTION = re.compile(r"(MPC|SPC)=(\d{1,9})$")

Followed = list[tuple[list[int], float, list[int]]]
"""Components, weight and nodes of each group in an RBE3."""


@dataclass(eq=False)
class Constraints:
    """Constraint entries collected from a deck.

    Attributes
    ----------
    rigid : list of (name, fields)
        Rigid elements.
    mpc : dict of int to list of fields
        MPC entries, keyed by set id.
    added : dict of (kind, set id) to list of int
        Sets that an MPCADD or SPCADD combines.
    selected : dict of str to set of int
        Sets that the case control selects, keyed by kind: ``"MPC"`` or ``"SPC"``.
    is_deck : bool
        Whether the file has ``BEGIN BULK``, and so may have case control before it.
    unread : dict of str to int
        Number of skipped entries, keyed by entry name.
    n_fields : int
        Total number of fields in all entries.
    notes : list of str
    has_dmap : bool
        Whether the executive control has DMAP. Nastran allows OUTPUT4 only in DMAP.
    is_of_mystran : bool
        Whether the executive control has OUTPUT4 without DMAP, as in MYSTRAN. MYSTRAN does not rescale the weights
        of rotations in an RBE3; see `fmu.formats.constraints.rigid`. MYSTRAN 18.0 and Nastran give different
        equations if an RBE3 follows components other than 123, if its reference point has components other than
        123456, or if its points have their own axes. A note then says so.
    """

    rigid: list[tuple[str, list[str]]] = field(default_factory=list)
    mpc: dict[int, list[list[str]]] = field(default_factory=dict)
    added: dict[tuple[str, int], list[int]] = field(default_factory=dict)
    selected: dict[str, set[int]] = field(default_factory=lambda: {"MPC": set(), "SPC": set()})
    is_deck: bool = False
    unread: dict[str, int] = field(default_factory=dict)
    n_fields: int = 0
    notes: list[str] = field(default_factory=list)
    has_dmap: bool = False
    is_of_mystran: bool = False

    def add(self, name: str, fields: list[str]) -> None:
        """Store an entry of the bulk data, case control or executive control that concerns constraints.

        Other entries are ignored. Raise RefusedError if the constraints have more than `MOST_FIELDS` fields in
        all. Raise RefusedError or ValueError if the set ids in an MPC, MPCADD or SPCADD are malformed.
        """
        if name in ENTRIES:
            self.n_fields += len(fields)
            if self.n_fields > MOST_FIELDS:
                raise RefusedError(f"must have constraints of at most {MOST_FIELDS} fields")
        if name in _RIGID:
            self.rigid.append((name, fields))
        elif name == "MPC":
            self.mpc.setdefault(identity(fields[0], "MPC: its set"), []).append(fields)
        elif name in ("MPCADD", "SPCADD"):
            own = identity(fields[0], f"{name}: its set")
            self.added[name[:3], own] = expand_list(fields[1:], name)
        elif name in UNREAD:
            self.unread[name] = self.unread.get(name, 0) + 1
        elif name.startswith("BEGIN"):
            self.is_deck = True
        elif name.startswith(("COMPILE", "ALTER")) and not self.is_deck:
            self.has_dmap = True
        elif name.startswith("OUTPUT4 ") and not self.is_deck:
            self.is_of_mystran = not self.has_dmap
        elif name[:3] in ("MPC", "SPC") and not self.is_deck:
            found = _SELECTION.match("".join([name, *fields]).replace(" ", ""))
            if found:
                self.selected[found[1]].add(int(found[2]))

    def missing(self) -> tuple[str, ...]:
        """Return a text on each kind of skipped constraint, except SUPORT, which does not constrain the modes."""
        return tuple(f"{count} {name}" for name, count in self.unread.items() if name not in _REFERENCES)

    def sets(self, kind: str, known: Sequence[int]) -> list[int]:
        """Return the ids of the active sets of a kind, ``"MPC"`` or ``"SPC"``, in ascending order.

        `known` lists the ids of the sets in the bulk data. All of them are active if the file has no ``BEGIN
        BULK``, otherwise only those that the case control selects, if any. A selected MPCADD or SPCADD is replaced
        by the sets that it combines.

        Raises
        ------
        RefusedError
            If subcases select different sets, or a selected set, or a part of it, is not in the deck.
        """
        if not self.is_deck:
            return sorted(known)
        chosen = self.selected[kind]
        if len(chosen) > 1:
            raise RefusedError(f"must select one {kind} set for all subcases (got {names_shown(sorted(chosen))})")
        found: dict[int, None] = {}
        for one in chosen:
            for part in self.added.get((kind, one), [one]):
                found[part] = None
        missing = [one for one in found if one not in known]
        if missing:
            raise RefusedError(
                f"must have the {kind} set {missing[0]} that its case control selects (it has "
                f"{names_shown(known) or 'none'}); add the entries of this set, or select one that is there"
            )
        return sorted(found)


def equations_of(
    constraints: Constraints, point: Callable[[int], Point], scalars: Collection[int]
) -> list[Equation]:
    """Return the equations of all active constraints, with directions along each node's own axes.

    If the deck is for MYSTRAN, a note on each RBE3 whose equations differ from Nastran's is added to
    `constraints.notes`.

    Parameters
    ----------
    constraints : Constraints
    point : callable
        ``point(node)`` returns the position and axes of a node, or raises RefusedError if there is no such node.
    scalars : collection of int
        Ids of scalar points, which have only the direction x.

    Raises
    ------
    RefusedError, ValueError
        If an entry is malformed, names an unknown node or does not determine its dependents, if there are too many
        rigid elements, or if the case control selects several MPC sets or an unknown one.
    """
    found: list[Equation] = []
    for name, fields in constraints.rigid:
        source = f"{name} {identity(fields[0], f'{name}: its number')}"
        if name == "RBE2":
            found += _rbe2(fields, point, source)
        elif name == "RBE3":
            found += _rbe3(fields, point, source, constraints)
        elif name == "RBAR1":
            found += _rbar1(fields, point, source)
        else:
            found += _rbar(fields, point, source)
        if len(found) > MOST_DOFS:
            raise RefusedError(f"must have rigid elements with at most {MOST_DOFS} dependent components")
    for one in constraints.sets("MPC", sorted(constraints.mpc)):
        for k, fields in enumerate(constraints.mpc.get(one, []), 1):
            found.append(_mpc(fields, point, scalars, f"MPC {one}, equation {k}"))
    return found


def _rbe2(fields: list[str], point: Callable[[int], Point], source: str) -> list[Equation]:
    reference = point(identity(fields[1], f"{source}: GN"))
    which = components(_require_text(fields[2], f"{source}: CM"), f"{source}: CM")
    nodes = fields[3:]
    while nodes and not nodes[-1]:
        nodes = nodes[:-1]
    if nodes and "." in nodes[-1]:  # ALPHA, of thermal expansion
        nodes = nodes[:-1]
    dependents = expand_list(nodes, f"{source}: GM")
    if not 1 <= len(dependents) * len(which) <= MOST_DOFS:
        raise ValueError(
            f"{source} must have 1 to {MOST_DOFS} dependent components (got {len(dependents) * len(which)})"
        )
    return rigid_link(reference, [point(node) for node in dependents], which, source)


def _rbe3(
    fields: list[str], point: Callable[[int], Point], source: str, constraints: Constraints
) -> list[Equation]:
    reference = point(identity(fields[2], f"{source}: REFGRID"))
    which = components(_require_text(fields[3], f"{source}: REFC"), f"{source}: REFC")
    groups, dependents = _groups([word for word in fields[4:] if word], source)
    followed = [(point(node), tuple(group), weight) for group, weight, nodes in groups for node in nodes]
    points = [reference, *(one for one, _, _ in followed)]
    is_plain = all(tuple(group) == ALL[:3] for _, group, _ in followed) and tuple(which) == ALL
    if constraints.is_of_mystran and not (is_plain and all(np.array_equal(one.axes, np.eye(3)) for one in points)):
        constraints.notes.append(
            f"MYSTRAN 18.0 has other equations than Nastran for {source}: matrices of all degrees of freedom are "
            "reduced as in Nastran, and the motion of its reference point is Nastran's."
        )
    found = mean_motion(reference, which, followed, source, by_length=not constraints.is_of_mystran)
    if not dependents:
        return found
    rows = [{one.dependent: 1.0} | {name: -w for name, w in one.weights.items()} for one in found]
    chosen = [name for node, group in dependents for name in point(node).names(group)]
    return solve_for_dependents(rows, chosen, source)


def _groups(words: list[str], source: str) -> tuple[Followed, list[tuple[int, list[int]]]]:
    """Return an RBE3's groups of followed points, and its dependent nodes and components.

    The dependent nodes are listed after the word UM; without this word, the second list is empty. Groups without
    nodes are left out. Raise ValueError if no group has nodes, or the entry is malformed.
    """
    groups: Followed = []
    dependents: list[tuple[int, list[int]]] = []
    at = 0
    while at < len(words) and words[at] not in ("UM", "ALPHA"):
        if "." in words[at]:
            weight = number(words[at], f"{source}: a weight")
            group = components(words[at + 1] if at + 1 < len(words) else "?", f"{source}: components")
            groups.append((group, weight, []))
            at += 2
            continue
        if not groups:
            raise ValueError(f"{source} must begin with a weight, a real number (got {quote(words[at])})")
        until = at
        while until < len(words) and words[until] not in ("UM", "ALPHA") and "." not in words[until]:
            until += 1
        groups[-1][2].extend(expand_list(words[at:until], f"{source}: nodes"))
        at = until
    if at < len(words) and words[at] == "UM":
        rest = words[at + 1 :]
        rest = rest[: rest.index("ALPHA")] if "ALPHA" in rest else rest
        if len(rest) % 2:
            raise ValueError(f"{source} must have components for each node of UM")
        for node, which in zip(rest[::2], rest[1::2], strict=True):
            dependents.append((identity(node, f"{source}: UM"), components(which, f"{source}: UM")))
    if not any(nodes for _, _, nodes in groups):
        raise ValueError(f"{source} must have nodes to follow (it has none)")
    return [one for one in groups if one[2]], dependents


def _rbar(fields: list[str], point: Callable[[int], Point], source: str) -> list[Equation]:
    ends = [point(identity(fields[1 + k], f"{source}: node {k + 1}")) for k in range(2)]
    independent = [_some(fields[3 + k], f"{source}: CN") for k in range(2)]
    dependent = [_some(fields[5 + k], f"{source}: CM") for k in range(2)]
    if not any(dependent):
        dependent = [[k for k in ALL if k not in which] for which in independent]
    return rigid_body(
        [(end, which) for end, which in zip(ends, independent, strict=True) if which] or [(ends[0], [])],
        [(end, which) for end, which in zip(ends, dependent, strict=True) if which],
        source,
    )


def _rbar1(fields: list[str], point: Callable[[int], Point], source: str) -> list[Equation]:
    GA, GB = (point(identity(fields[1 + k], f"{source}: G{'AB'[k]}")) for k in range(2))
    return rigid_link(GA, [GB], components(fields[3] or "123456", f"{source}: CB"), source)


def _some(text: str, what: str) -> list[int]:
    return components(text, what) if text and text != "0" else []


def _require_text(text: str, what: str) -> str:
    if text in ("", "0"):
        raise ValueError(f"{what} must be components 1 to 6 (it is empty)")
    return text


def _mpc(fields: list[str], point: Callable[[int], Point], scalars: Collection[int], source: str) -> Equation:
    terms: list[tuple[DofName, float]] = []
    for line in range(0, len(fields), 8):
        words = fields[line : line + 8]
        for node, which, factor in (words[1:4], words[4:7]):
            if not node:
                continue
            own = identity(node, f"{source}: a node")
            if own not in scalars:
                point(own)
            direction = components(which, f"{source}: a component")
            if len(direction) != 1:
                raise ValueError(f"{source} must have one component at each node (got {quote(which)})")
            terms.append(((own, DIRECTIONS[direction[0] - 1]), number(factor, f"{source}: a factor", 0.0)))
    return explicit_equation(terms, source)
