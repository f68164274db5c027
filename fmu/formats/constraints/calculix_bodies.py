"""Rigid bodies in CalculiX decks: *RIGID BODY, and *COUPLING with *KINEMATIC.

The nodes of a body move as u = u_ref + u_rot × r. The rotation u_rot is the displacement of the ROT NODE, or of a
node that CalculiX adds, with a number above all others. Added nodes are numbered for couplings first, then for
bodies, each in deck order. A body also uses up one number per node, and a coupling one per node for each line of
*KINEMATIC. This numbering is undocumented. It was inferred from CalculiX 2.20 output for two bodies, and may
differ in other decks, such as decks with shells and beams, which CalculiX expands.

*COUPLING with *DISTRIBUTING distributes the loads on a reference node, but this node does not move: masses and
springs at it have no effect in CalculiX. Such a coupling is skipped, with a note.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from fmu.formats.constraints.calculix_keywords import Constraints, Keyword, nodes_of, one_node, require_node, whole
from fmu.formats.constraints.equations import Equation, equations_of
from fmu.formats.constraints.rigid import Point, rigid_motion
from fmu.formats.matrices.limits import MOST_DOFS, DofName, RefusedError
from fmu.formats.shown import quote
from fmu.types import DIRECTIONS

_SHIFTS, _TURNS = DIRECTIONS[:3], DIRECTIONS[3:]


class _Body(NamedTuple):
    """A rigid body. `rotation` is its rotation node, or None if CalculiX adds one.

    `components` are the directions (0 to 2) in which the dependent `nodes` follow. `n_added` is how many node
    numbers the body uses up, not counting an added rotation node.
    """

    reference: int
    rotation: int | None
    nodes: Sequence[int]
    components: Sequence[int]
    n_added: int
    source: str


def bodies_of(
    found: Constraints,
    places: Mapping[int, tuple[float, float, float]],
    elements: Mapping[int, tuple[int, ...]],
    face: Callable[[int, str], Sequence[int]],
    is_numbered: bool,
    held: set[DofName],
) -> tuple[list[Equation], set[int], dict[str, str]]:
    """Return the constraint equations of the rigid bodies in a deck, their rotation nodes, and notes.

    In the equations, x, y and z of a rotation node are its rotations. There is a note for each skipped constraint.

    Parameters
    ----------
    found : Constraints
    places : mapping of int to (float, float, float)
        Coordinates of each node, keyed by node id.
    elements : mapping of int to tuple of int
        Node ids of each element, keyed by element id.
    face : callable
        ``face(element, "S3")`` returns the nodes on a face of a solid element.
    is_numbered : bool
        Whether the numbers of the nodes that CalculiX adds are known. This requires that the deck requests matrix
        storage and contains only solids and point elements. After a skipped constraint, they are taken as unknown.
        If they are unknown, every coupling and every body without a ROT NODE is skipped, with a note. If
        `is_numbered` is False, the sets and surfaces of such a body are not checked.
    held : set of (node, direction)
        Degrees of freedom that supports fix. The set is changed in place: if CalculiX adds a rotation node to a
        body, a fixed rotation of the reference node is replaced by the added node's displacement.

    Raises
    ------
    RefusedError, ValueError
        If a keyword is malformed, names an unknown node, set or surface, or has no nodes or too many.
    """
    surfaces = {one.options.get("NAME", ""): one for one in found.keywords if one.name == "SURFACE"}
    notes: dict[str, str] = {}
    bodies = [
        *_couplings(found, places, surfaces, face, is_numbered, notes),
        *_rigid_bodies(found, places, elements, is_numbered, notes),
    ]
    equations: list[Equation] = []
    turning: set[int] = set()
    last = max(places, default=0)
    for body in bodies:
        rotation = body.rotation
        if rotation is None and notes:
            notes[body.source] = _without_number(body.source)
            continue
        if rotation is None:
            rotation = last + 1
            for turn, shift in zip(_TURNS, _SHIFTS, strict=True):
                if (body.reference, turn) in held:
                    held.remove((body.reference, turn))
                    held.add((rotation, shift))
                else:
                    equations.append(Equation((body.reference, turn), {(rotation, shift): 1.0}, body.source))
        turning.add(rotation)
        last += body.n_added + (body.rotation is None)
        names = [*((body.reference, d) for d in _SHIFTS), *((rotation, d) for d in _SHIFTS)]
        centre = Point(body.reference, np.array(places[body.reference]), np.eye(3))
        for node in body.nodes:
            S = rigid_motion(Point(node, np.array(places[node]), np.eye(3)), centre)[list(body.components)]
            dependents = [(node, DIRECTIONS[k]) for k in body.components]
            equations += equations_of(dependents, names, S, body.source)
        if len(equations) > 3 * MOST_DOFS:
            raise RefusedError(f"must have rigid bodies with at most {MOST_DOFS} nodes in all")
    return equations, turning, notes


def _without_number(source: str) -> str:
    """Return the note on a body that is skipped, as the number of its rotation node is not known."""
    why = "has no ROT NODE" if source.startswith("*RIGID BODY") else "is not read"
    return (
        f"{source} {why}: no sensors can be at its nodes, except in decks of solids for CalculiX with "
        "SOLVER=MATRIXSTORAGE."
    )


def _rigid_bodies(
    found: Constraints,
    places: Mapping[int, tuple[float, float, float]],
    elements: Mapping[int, tuple[int, ...]],
    is_numbered: bool,
    notes: dict[str, str],
) -> Iterator[_Body]:
    """Yield each *RIGID BODY, unless it needs a number that is not known: then add a note to `notes`."""
    for one in found.keywords:
        if one.name != "RIGIDBODY":
            continue
        rotation = None
        if "ROTNODE" in one.options:
            rotation = one_node(found, one.options["ROTNODE"], f"{one.source}: ROT NODE", places)
        elif not is_numbered:
            notes[one.source] = _without_number(one.source)
            continue
        reference = one_node(found, one.options.get("REFNODE", "?"), f"{one.source}: REF NODE", places)
        sets = [one.options[name] for name in ("NSET", "TIENSET", "PINNSET") if name in one.options]
        nodes = [node for name in sets for node in nodes_of(found, name, one.source)]
        for element in found.elements_of.get(one.options.get("ELSET", ""), []):
            nodes += elements.get(element, ())
        yield _body(reference, rotation, nodes, (0, 1, 2), 1, places, one)


def _couplings(
    found: Constraints,
    places: Mapping[int, tuple[float, float, float]],
    surfaces: Mapping[str, Keyword],
    face: Callable[[int, str], Sequence[int]],
    is_numbered: bool,
    notes: dict[str, str],
) -> Iterator[_Body]:
    """Yield each kinematic coupling as a rigid body; add a note to `notes` for each skipped coupling.

    A coupling is skipped if it has ORIENTATION, is not kinematic, or the number of its rotation node is not known.
    Raise RefusedError or ValueError if another coupling is malformed, has no nodes, or names an unknown node,
    element, set or surface.
    """
    for one, kind in pairwise([*found.keywords, Keyword("", {}, 0)]):
        if one.name != "COUPLING":
            continue
        if kind.name != "KINEMATIC" or "ORIENTATION" in one.options:
            after = f"with *{kind.name}" if kind.name else "without *KINEMATIC"
            why = "with ORIENTATION" if "ORIENTATION" in one.options else after
            notes[one.source] = f"{one.source} {why} is not read."
            continue
        if not is_numbered:
            notes[one.source] = _without_number(one.source)
            continue
        reference = one_node(found, one.options.get("REFNODE", "?"), f"{one.source}: REF NODE", places)
        name = one.options.get("SURFACE", "")
        if name not in surfaces:
            raise RefusedError(f"{one.source} must name a surface (got {quote(name)})")
        nodes = list(dict.fromkeys(_nodes_of_surface(found, surfaces[name], face)))
        components: dict[int, None] = {}
        lines = 0
        for words in kind.rows():
            first = whole(words[0], f"{kind.source}: a direction")
            last = whole(words[1], f"{kind.source}: a direction") if len(words) > 1 and words[1] else first
            if not 1 <= first <= last <= 6:
                raise ValueError(f"{kind.source}: directions must be 1 to 6 (got {quote(words)})")
            components |= dict.fromkeys(range(first - 1, min(last, 3)))
            lines += 1
        if not components:
            raise ValueError(f"{kind.source} must have directions 1 to 3 (it has none)")
        yield _body(reference, None, nodes, tuple(components), lines, places, one)


def _body(
    reference: int,
    rotation: int | None,
    nodes: Sequence[int],
    components: Sequence[int],
    n_lines: int,
    places: Mapping[int, tuple[float, float, float]],
    one: Keyword,
) -> _Body:
    for node in nodes:
        require_node(node, places, one.source)
    if not nodes:
        raise RefusedError(f"must have the nodes of all constraints (its body has none, of {one.source})")
    own = [node for node in dict.fromkeys(nodes) if node not in (reference, rotation)]
    return _Body(reference, rotation, own, components, n_lines * len(own), one.source)


def _nodes_of_surface(
    found: Constraints, one: Keyword, face: Callable[[int, str], Sequence[int]]
) -> Iterator[int]:
    for words in one.rows():
        if one.options.get("TYPE", "ELEMENT") == "NODE":
            nodes = nodes_of(found, words[0], one.source)
            found.count(len(nodes), one.source)
            yield from nodes
            continue
        if len(words) < 2:
            raise ValueError(f"{one.source} must have an element or a set and a face in each line")
        which = (
            [int(words[0])] if words[0].isdecimal() and len(words[0]) <= 10 else found.elements_of.get(words[0])
        )
        if which is None:
            raise RefusedError(f"{one.source} must name an element or an element set (got {quote(words[0])})")
        found.count(20 * len(which), one.source)
        for element in which:
            of_face = face(element, words[1])
            if not of_face:
                where = f"element {element} has no {quote(words[1])}"
                raise RefusedError(f"{one.source} must have faces of solids ({where})")
            yield from of_face
