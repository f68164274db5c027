"""Reader for nodes, elements, axes and matrix rows in Nastran bulk data, ``.bdf``, ``.dat`` or ``.nas``.

The directions of a node in Nastran's matrices are along the axes of its output coordinate system, CD. OP4 files do
not name their rows. The rows of the g-set are the nodes in ascending order (in MYSTRAN, in deck order unless
PARAM,GRIDSEQ,GRID is given) with six components each, and scalar points with one component. This module also forms
three smaller sets. The n-set is the g-set without components that constraints make dependent
(`fmu.formats.constraints.nastran`). The f-set is the n-set without components that GRID, GRDSET, SPC and SPC1 fix.
The a-set is defined by ASET and ASET1 entries.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from fmu.formats.constraints.nastran import Constraints, equations_of
from fmu.formats.constraints.rigid import Point
from fmu.formats.matrices.limits import MOST_DOFS, RefusedError
from fmu.formats.matrices.nastran.cards import cards, components, expand_list, identity, number, whole
from fmu.formats.matrices.nastran.includes import BULK_DATA, deck_lines
from fmu.formats.models.coordinate_systems import Definition, Kind, Systems
from fmu.formats.models.exported import MOST_ELEMENTS, MOST_NODES, DofName, Mesh, MeshFormat, mesh_of
from fmu.formats.shown import names_shown
from fmu.types import DIRECTIONS, FloatArray

_HEXAHEDRON = (*range(12), *range(16, 20), *range(12, 16))
_WEDGE = (*range(9), *range(12, 15), *range(9, 12))
_ELEMENTS: dict[str, tuple[int, tuple[tuple[str, int], ...]]] = {
    **dict.fromkeys(("CQUAD4", "CQUADR", "CSHEAR"), (2, (("quad", 4),))),
    **dict.fromkeys(("CTRIA3", "CTRIAR"), (2, (("triangle", 3),))),
    **dict.fromkeys(("CBAR", "CBEAM", "CROD", "CTUBE", "CBUSH", "CBEND"), (2, (("line", 2),))),
    "CONROD": (1, (("line", 2),)),
    "CQUAD8": (2, (("quad8", 8), ("quad", 4))),
    "CTRIA6": (2, (("triangle6", 6), ("triangle", 3))),
    "CTETRA": (2, (("tetra10", 10), ("tetra", 4))),
    "CPYRAM": (2, (("pyramid13", 13), ("pyramid", 5))),
    "CPENTA": (2, (("wedge15", 15), ("wedge", 6))),
    "CHEXA": (2, (("hexahedron20", 20), ("hexahedron", 8))),
}
"""For each element entry: the field of the first node, and the kinds and node counts with and without midside
nodes."""
_ORDER = {"hexahedron20": _HEXAHEDRON, "wedge15": _WEDGE}
_SET = ("ASET", "ASET1", "SPC", "SPC1")


@dataclass(eq=False)
class _Deck:
    grids: dict[int, tuple[int, FloatArray]] = field(default_factory=dict)
    outputs: dict[int, int] = field(default_factory=dict)
    permanent: dict[int, set[int]] = field(default_factory=dict)
    held: dict[int, dict[int, set[int]]] = field(default_factory=dict)
    kept: dict[int, set[int]] = field(default_factory=dict)
    scalars: set[int] = field(default_factory=set)
    order: list[int] = field(default_factory=list)
    is_ascending: bool = False
    systems: dict[int, Definition] = field(default_factory=dict)
    elements: list[tuple[int, ...]] = field(default_factory=list)
    kinds: list[str] = field(default_factory=list)
    constraints: Constraints = field(default_factory=Constraints)


def _read(path: Path) -> Mesh:
    deck, defaults, omitted = _Deck(), ("", "", ""), 0
    for name, fields in cards(deck_lines(path)):
        fields = fields + [""] * (8 - len(fields))
        if name == "GRDSET":
            defaults = fields[1], fields[5], fields[6]
        elif name == "GRID":
            _grid(deck, fields)
        elif name in _ELEMENTS:
            _element(deck, name, fields)
        elif name[:4] == "CORD" and name[4:5] in ("1", "2") and name[5:] in ("R", "C", "S"):
            _system(deck, name[4], name[5], fields)  # type: ignore[arg-type]
        elif name == "SPOINT":
            points = expand_list(fields, "SPOINT")
            deck.order += [node for node in points if node not in deck.scalars]
            deck.scalars |= set(points)
        elif name == "PARAM" and fields[0] == "GRIDSEQ":
            deck.is_ascending = _is_ascending(fields[1])
        elif name in _SET:
            _members(deck, name, fields)
        elif name in ("OMIT", "OMIT1"):
            omitted += 1
        else:
            deck.constraints.add(name, fields)
        if len(deck.grids) + len(deck.scalars) > MOST_NODES or len(deck.elements) > MOST_ELEMENTS:
            raise RefusedError(f"must have at most {MOST_NODES} nodes and {MOST_ELEMENTS} elements")
    return _mesh(deck, defaults, omitted)


def _grid(deck: _Deck, fields: list[str]) -> None:
    node = identity(fields[0], "GRID: its number")
    what = f"GRID {node}"
    place = np.array([number(word, f"{what}: a coordinate", 0.0) for word in fields[2:5]])
    if node in deck.grids:
        raise RefusedError(f"must have each node once (it has {what} twice)")
    deck.order.append(node)
    deck.grids[node] = whole(fields[1], f"{what}: CP", -2), place
    deck.outputs[node] = whole(fields[5], f"{what}: CD", -2)
    if fields[6]:
        deck.permanent[node] = _permanent(fields[6], f"{what}: PS")


def _permanent(text: str, what: str) -> set[int]:
    """Return the components that a node's field PS fixes; none if the field is empty or 0."""
    return set(components(text, what)) if text.strip("0") else set()


def _is_ascending(sequence: str) -> bool:
    """Return True if MYSTRAN sorts its rows by node id (PARAM,GRIDSEQ,GRID), otherwise False (INPUT).

    Raise RefusedError for BANDIT.
    """
    if sequence == "BANDIT":
        raise RefusedError(
            "must have PARAM,GRIDSEQ,INPUT or GRID (with BANDIT, MYSTRAN changes the order of rows)"
        )
    return sequence == "GRID"


def _element(deck: _Deck, name: str, fields: list[str]) -> None:
    first, kinds = _ELEMENTS[name]
    for kind, count in kinds:
        nodes = fields[first : first + count]
        if len(nodes) == count and all(nodes):
            found = [identity(node, f"{name} {fields[0]}: a node") for node in nodes]
            deck.elements.append(tuple(found[k] for k in _ORDER.get(kind, range(count))))
            deck.kinds.append(kind)
            return
    if name not in ("CBUSH",):  # a CBUSH may be grounded at one end
        raise ValueError(f"{name} {fields[0]} must have {kinds[-1][1]} nodes (it lacks some)")


def _system(deck: _Deck, way: Literal["1", "2"], kind: Kind, fields: list[str]) -> None:
    what = f"CORD{way}{kind}"
    if way == "1":
        for at in (0, 4):
            if fields[at]:
                nodes = tuple(identity(word, f"{what} {fields[at]}: a node") for word in fields[at + 1 : at + 4])
                deck.systems[identity(fields[at], what)] = Definition(kind, nodes=nodes)
        return
    own, reference = identity(fields[0], what), whole(fields[1], f"{what} {fields[0]}: RID", 0)
    words = (fields[2:] + [""] * 9)[:9]
    points = np.array([number(word, f"{what} {own}: a coordinate", 0.0) for word in words])
    deck.systems[own] = Definition(kind, points.reshape(3, 3), reference)


def _members(deck: _Deck, name: str, fields: list[str]) -> None:
    """Add an ASET entry's components to the a-set, or an SPC entry's components to the fixed DOFs of its set.

    Raise RefusedError or ValueError if the entry is malformed.
    """
    skipped = 0 if name.startswith("ASET") else 1
    into = deck.held.setdefault(identity(fields[0], f"{name}: its set"), {}) if skipped else deck.kept
    if name.endswith("1"):
        which = components(fields[skipped], name)
        for node in expand_list(fields[skipped + 1 :], name):
            into.setdefault(node, set()).update(which)
        return
    for at in range(skipped, len(fields) - 1, 2 if name == "ASET" else 3):
        if fields[at]:
            into.setdefault(identity(fields[at], name), set()).update(components(fields[at + 1], name))


def _mesh(deck: _Deck, defaults: tuple[str, str, str], omitted: int) -> Mesh:
    position, output, permanent = defaults
    default_in, default_out = whole(position, "GRDSET: CP", 0), whole(output, "GRDSET: CD", 0)
    fluid = [node for node, system in deck.outputs.items() if system == -1]
    if fluid:
        raise RefusedError(f"must have structural nodes only (of fluid: {names_shown(fluid)})")
    grids = {node: (default_in if cp == -2 else cp, place) for node, (cp, place) in deck.grids.items()}
    systems = Systems(deck.systems, grids)
    places = {node: systems.place(node) for node in grids}
    own = {node: default_out if cd == -2 else cd for node, cd in deck.outputs.items()}
    axes = {node: systems.axes(cd, node) for node, cd in own.items() if cd}
    both = deck.scalars & set(grids)
    if both:
        raise RefusedError(f"must have each point once (as GRID and SPOINT: {names_shown(sorted(both))})")
    order = sorted([*grids, *deck.scalars])
    if 6 * len(order) > 6 * MOST_DOFS:
        raise RefusedError(f"must have at most {MOST_DOFS} points")
    held = _find_held(deck, _permanent(permanent, "GRDSET: PS"))

    def point(node: int) -> Point:
        if node not in places:
            raise RefusedError(f"must have the nodes of all constraints (there is no node {node})")
        return Point(node, places[node], axes.get(node, np.eye(3)))

    equations = equations_of(deck.constraints, point, deck.scalars)
    dependent = {one.dependent for one in equations}
    every = [(node, k) for node in order for k in ([1] if node in deck.scalars else range(1, 7))]
    sets = {"g": [(node, DIRECTIONS[k - 1]) for node, k in every]}
    sets["n"] = [name for name in sets["g"] if name not in dependent]
    sets["f"] = [name for name in sets["n"] if name not in held]
    if deck.kept:
        kept = ((node, k) for node, k in every if k in deck.kept.get(node, ()))
        sets["a"] = [(node, DIRECTIONS[k - 1]) for node, k in kept]
    names = list(sets)
    chosen = {
        name: tuple(rows)
        for k, (name, rows) in enumerate(sets.items())
        if all(len(sets[larger]) > len(rows) for larger in names[:k])
    }
    notes = [f"Of {omitted} OMIT entries the mesh knows nothing."] if omitted else []
    notes += deck.constraints.notes
    notes += [f"{count} {name} entries are not read." for name, count in deck.constraints.unread.items()]
    for kind, known in (("MPC", deck.constraints.mpc), ("SPC", deck.held)):
        if known and not deck.constraints.sets(kind, sorted(known)):
            notes.append(f"No {kind} set acts, as the case control selects none.")
    mesh = mesh_of(places, deck.elements, deck.kinds, notes, axes, chosen)
    rows = tuple(order if deck.is_ascending else deck.order)
    return mesh._replace(
        order=rows, equations=tuple(equations), held=frozenset(held), unread=deck.constraints.missing()
    )


def _find_held(deck: _Deck, permanent: set[int]) -> set[DofName]:
    """Return the degrees of freedom fixed by GRID entries and by the active SPC sets.

    `permanent` contains the components that GRDSET fixes by default.
    """
    held = {node: deck.permanent.get(node, permanent) for node in deck.grids}
    for one in deck.constraints.sets("SPC", sorted(deck.held)):
        for node, which in deck.held.get(one, {}).items():
            held[node] = held.get(node, set()) | which
    return {(node, DIRECTIONS[k - 1]) for node, which in held.items() for k in which}


FORMAT = MeshFormat(BULK_DATA, _read)
