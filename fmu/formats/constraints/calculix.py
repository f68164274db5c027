"""Constraints in CalculiX and Abaqus input decks: *EQUATION, *BOUNDARY and *TRANSFORM.

CalculiX eliminates dependent degrees of freedom before it writes its matrices. The rows of these matrices belong
to directions along global axes. If *TRANSFORM rotates the axes of the first node in an equation, CalculiX makes a
displacement of this node along a global axis dependent. It tries the global axis with the same number as the local
direction in the first term, then the following axes, and takes the first along which the local axis has a
component (CalculiX, *User's manual*). `fmu.formats.constraints.calculix_bodies` reads the rigid bodies.

Supports remain in effect in later steps, unless the first *BOUNDARY of a step has OP=NEW, which removes all
earlier supports. On other *BOUNDARY keywords, OP=NEW has no effect (*User's manual*, ``*BOUNDARY``).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

import numpy as np

from fmu.formats.constraints.calculix_bodies import bodies_of
from fmu.formats.constraints.calculix_keywords import (
    Constraints,
    Keyword,
    add_set,
    nodes_of,
    one_node,
    require_node,
    whole,
)
from fmu.formats.constraints.equations import Equation, explicit_equation, solve_for_dependents, turning_name
from fmu.formats.matrices.limits import MOST_DOFS, DofName, RefusedError
from fmu.formats.shown import quote
from fmu.types import DIRECTIONS, FloatArray

_SUPPORTS = {
    "ENCASTRE": (1, 2, 3, 4, 5, 6),
    "PINNED": (1, 2, 3),
    "XSYMM": (1, 5, 6),
    "YSYMM": (2, 4, 6),
    "ZSYMM": (3, 4, 5),
    "XASYMM": (2, 3, 4),
    "YASYMM": (1, 3, 5),
    "ZASYMM": (1, 2, 6),
}
"""Directions fixed by each of Abaqus' named supports; *Keywords reference guide*, ``*BOUNDARY``."""
_LEAST = 1e-5
"""Smallest coefficient with which a displacement along a global axis can be made dependent."""


def constraints_of(
    found: Constraints,
    places: Mapping[int, tuple[float, float, float]],
    elements: Mapping[int, tuple[int, ...]],
    face: Callable[[int, str], Sequence[int]],
    is_numbered: bool,
) -> tuple[list[Equation], set[DofName], set[int], list[str], tuple[str, ...]]:
    """Return equations, fixed degrees of freedom, rotation nodes, notes on skipped input, and what was skipped.

    The degrees of freedom are along global axes, and those of rotation nodes are rotations, rx, ry and rz. If
    *TRANSFORM rotates the axes of a node, a support that fixes one of its displacements is returned as an
    equation. Sets in the deck are added to `found`.

    Parameters
    ----------
    found : Constraints
    places : mapping of int to (float, float, float)
        Coordinates of each node, keyed by node id.
    elements : mapping of int to tuple of int
        Node ids of each element, keyed by element id.
    face, is_numbered
        See `bodies_of`.

    Raises
    ------
    RefusedError, ValueError
        If a keyword is malformed, names an unknown node, set or surface, does not determine its dependent degrees
        of freedom, or has no nodes or too many entries.
    """
    axes: dict[int, FloatArray] = {}
    held: set[DofName] = set()
    equations: list[Equation] = []
    turned: dict[int, list[tuple[dict[DofName, float], int, str]]] = {}
    notes: dict[str, None] = {}
    unread: dict[str, None] = {}
    for one in sorted(found.keywords, key=lambda one: one.name != "ELSET"):  # node sets may be of element sets
        if one.name in ("NSET", "ELSET"):
            add_set(found, one, elements)
        elif one.name == "TRANSFORM":
            axes |= _transform(found, one, places)
    dependent: set[DofName] = set()
    for one in _without_removed(found.keywords):
        if one.name == "EQUATION":
            for row, first, source in _equations(found, one, axes, places):
                node, k = first[0], DIRECTIONS.index(first[1])
                if node in axes and k < 3:
                    turned.setdefault(node, []).append((row, k, source))
                    continue
                equations.append(explicit_equation(row.items(), source))
                dependent.add(first)
        elif one.name == "BOUNDARY":
            for name in _sets_without_nodes(found, one):
                unread[one.source] = None
                notes[f"{one.source} is at the set {quote(name)}, of which no nodes are known."] = None
            for node, k in _find_held(found, one):
                if node in axes and k < 3:
                    row = {(node, DIRECTIONS[j]): float(axes[node][k, j]) for j in range(3) if axes[node][k, j]}
                    turned.setdefault(node, []).append((row, k, one.source))
                else:
                    held.add((node, DIRECTIONS[k]))
        elif one.is_unread:
            unread[one.source] = None
            if one.name != "TIE":  # CalculiX applies it; see `fmu.formats.models.ties`
                notes[f"{one.source} is not read."] = None
    for node, rows in turned.items():
        equations += _along_local_axes(node, rows)
    bodies, turning, of_bodies = bodies_of(found, places, elements, face, is_numbered, held)
    held = {turning_name(name, turning) for name in held}
    equations = [_name_rotations(one, turning) for one in equations + bodies]
    return equations, held, turning, [*notes, *of_bodies.values()], (*unread, *of_bodies)


def _name_rotations(one: Equation, turning: Collection[int]) -> Equation:
    """Return an equation in which the degrees of freedom of rotation nodes are named as rotations."""
    weights = {turning_name(name, turning): weight for name, weight in one.weights.items()}
    return Equation(turning_name(one.dependent, turning), weights, one.source)


def _without_removed(keywords: Sequence[Keyword]) -> list[Keyword]:
    """Return the keywords except the *BOUNDARY keywords that a later step removes by OP=NEW."""
    kept: list[Keyword] = []
    is_first = False
    for one in keywords:
        if one.name == "BOUNDARY" and is_first and one.options.get("OP") == "NEW":
            kept = [earlier for earlier in kept if earlier.name != "BOUNDARY"]
        is_first = one.name == "STEP" or (is_first and one.name != "BOUNDARY")
        kept.append(one)
    return kept


def _along_local_axes(node: int, rows: Sequence[tuple[dict[DofName, float], int, str]]) -> list[Equation]:
    """Return the equations of a node with rotated axes, solved for dependents along global axes.

    Each row is (coefficients, local direction, source); duplicates are dropped. The rows contain the same global
    displacements, so they are solved together. Raise RefusedError if they do not determine their dependents.
    """
    chosen: list[DofName] = []
    unique = {(k, tuple(sorted(row.items()))): (row, k, source) for row, k, source in rows}
    for row, k, source in unique.values():
        ways = [(node, DIRECTIONS[(k + j) % 3]) for j in range(3)]
        free = [name for name in ways if abs(row.get(name, 0.0)) > _LEAST and name not in chosen]
        if not free:
            raise RefusedError(f"must have constraints that determine their dependents ({source}: node {node})")
        chosen.append(free[0])
    return solve_for_dependents([row for row, _, _ in unique.values()], chosen, rows[0][2])


def _equations(
    found: Constraints,
    one: Keyword,
    axes: Mapping[int, FloatArray],
    places: Mapping[int, tuple[float, float, float]],
) -> Iterator[tuple[dict[DofName, float], DofName, str]]:
    """Yield each equation's coefficients along global axes, its first degree of freedom and its source.

    The first degree of freedom is along the node's own axes. Raise RefusedError or ValueError if an equation is
    malformed, or if a term does not name exactly one node of the deck.
    """
    rows = one.rows()
    for count, start in enumerate(rows, 1):
        source = f"equation {count} of {one.source}"
        if count > MOST_DOFS:
            raise RefusedError(f"must have at most {MOST_DOFS} equations ({one.source} has more)")
        n = whole(start[0], f"{source}: the number of terms")
        words: list[str] = []
        while len(words) < 3 * n:
            further = next(rows, None)
            if further is None:
                break
            words += filter(None, further)
        if n < 1 or len(words) != 3 * n:
            raise ValueError(
                f"{source} must have {n} terms of node, direction and factor (got {len(words)} words)"
            )
        coefficients: dict[DofName, float] = {}
        first: DofName | None = None
        for which, direction, factor in zip(words[::3], words[1::3], words[2::3], strict=True):
            node = one_node(found, which, source, places)
            k = _direction(direction, source)
            value = _number(factor, source)
            first = first or (node, DIRECTIONS[k])
            own = axes[node][k % 3] if node in axes else np.eye(3)[k % 3]
            for j in np.flatnonzero(own).tolist():
                name = node, DIRECTIONS[j + 3 * (k // 3)]
                coefficients[name] = coefficients.get(name, 0.0) + value * float(own[j])
        assert first is not None
        yield coefficients, first, source


def _find_held(found: Constraints, one: Keyword) -> Iterator[tuple[int, int]]:
    """Yield the node and direction (from 0) of each degree of freedom that a *BOUNDARY keyword fixes.

    Directions other than 1 to 6 and unknown named supports are skipped. Raise RefusedError if there is no such
    node set.
    """
    for word, directions in _supports(one):
        yield from ((node, k - 1) for node in nodes_of(found, word, one.source) for k in directions)


def _sets_without_nodes(found: Constraints, one: Keyword) -> list[str]:
    """Return the names of empty sets in a *BOUNDARY keyword, such as sets of elements of unknown types.

    Raise RefusedError if there is no such node set.
    """
    return [word for word, _ in _supports(one) if not nodes_of(found, word, one.source)]


def _supports(one: Keyword) -> Iterator[tuple[str, Sequence[int]]]:
    """Yield the node or node set and the directions, from 1, of each line of a *BOUNDARY keyword with supports."""
    for words in one.rows():
        directions: Sequence[int] = ()
        if len(words) > 1 and words[1].isdecimal():
            first = int(words[1][:4])
            last = int(words[2][:4]) if len(words) > 2 and words[2].isdecimal() else first
            directions = range(max(first, 1), min(last, 6) + 1)
        elif len(words) == 2:
            directions = _SUPPORTS.get(words[1], ())
        if directions:
            yield words[0], directions


def _transform(
    found: Constraints, one: Keyword, places: Mapping[int, tuple[float, float, float]]
) -> dict[int, FloatArray]:
    """Return the local axes of the nodes of a *TRANSFORM, keyed by node id, as rows of arrays of shape (3, 3).

    The axes are rectangular, or cylindrical if TYPE=C. Raise ValueError unless there are six finite coordinates,
    and RefusedError if they do not define three directions, if there is no such node set, or if a node with
    cylindrical axes does not exist.
    """
    words = [word for row in one.rows() for word in row if word]
    if len(words) != 6:
        raise ValueError(f"{one.source} must have six coordinates (got {len(words)})")
    a, b = np.array([_number(word, one.source) for word in words]).reshape(2, 3)
    found_axes: dict[int, FloatArray] = {}
    for node in nodes_of(found, one.options.get("NSET", ""), one.source):
        if one.options.get("TYPE", "R") != "C":
            first, third = a, np.cross(a, b)
        else:
            require_node(node, places, one.source)
            third = b - a
            radius = np.array(places[node]) - a
            first = radius - third * float(radius @ third) / max(float(third @ third), 1e-300)
        size = np.linalg.norm(first) * np.linalg.norm(third)
        if not size > 0.0:
            raise RefusedError(f"must have axes of three directions ({one.source}, at node {node}, has not)")
        x, z = first / np.linalg.norm(first), third / np.linalg.norm(third)
        found_axes[node] = np.array([x, np.cross(z, x), z])
    return found_axes


def _direction(word: str, source: str) -> int:
    if word not in ("1", "2", "3", "4", "5", "6"):
        raise ValueError(f"{source}: a direction must be 1 to 6 (got {quote(word)})")
    return int(word) - 1


def _number(word: str, source: str) -> float:
    try:
        value = float(word.replace("D", "E"))
    except ValueError:
        raise ValueError(f"{source}: a factor must be a number (got {quote(word)})") from None
    if not np.isfinite(value):
        raise ValueError(f"{source}: a factor must be finite (got {quote(word)})")
    return value
