"""Constraints in input decks of CalculiX and Abaqus: *EQUATION, *RIGID BODY, *BOUNDARY and *TRANSFORM.

CalculiX eliminates dependent degrees of freedom before it writes its matrices, which are along global axes.
Where *TRANSFORM turns the axes of a node, the dependent degree of freedom of an equation is the direction that
CalculiX chooses: the one of the same number, or the next along which the local axis has a component.

The rotation of a rigid body is the displacement of its ROT NODE: u = u_ref + u_rot × r. CalculiX, *User's manual*.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from fmu.formats.constraints.equations import Equation, equations_of, explicit_equation, solve_for_dependents
from fmu.formats.constraints.rigid import Point, rigid_motion
from fmu.formats.matrices.limits import MOST_DOFS, MOST_ENTRIES, DofName, RefusedError
from fmu.formats.shown import quote
from fmu.types import DIRECTIONS, FloatArray

KEYWORDS = ("EQUATION", "RIGIDBODY", "BOUNDARY", "TRANSFORM", "NSET", "ELSET", "MPC", "COUPLING")
_UNREAD = (
    "MPC",
    "COUPLING",
    "KINEMATIC",
    "KINEMATICCOUPLING",
    "DISTRIBUTING",
    "DISTRIBUTINGCOUPLING",
    "EMBEDDEDELEMENT",
)
"""Keywords of constraints that are not read, without blanks."""
MOST_CHARACTERS = 2**28
"""Largest number of characters of sets and constraints."""
_LEAST = 1e-5
"""Smallest component of a local axis along the direction that CalculiX makes dependent."""


@dataclass(eq=False)
class Keyword:
    """A keyword with its options and its lines.

    Attributes
    ----------
    name : str
    options : mapping of str to str
    line : int
        Number of its line, for messages.
    lines : list of str
    """

    name: str
    options: Mapping[str, str]
    line: int
    lines: list[str] = field(default_factory=list)

    def rows(self) -> Iterator[list[str]]:
        """Yield the words of each line, in upper case."""
        for line in self.lines:
            yield [word.strip().upper() for word in line.rstrip(",").split(",")]

    @property
    def source(self) -> str:
        """The words that name the keyword in messages."""
        name = {"RIGIDBODY": "RIGID BODY"}.get(self.name, self.name)
        return f"*{name} in line {self.line}"


@dataclass(eq=False)
class Constraints:
    """The constraints and sets of a deck, in its order.

    Attributes
    ----------
    nodes_of : dict of str to list of int
        Node sets, by name.
    elements_of : dict of str to list of int
        Element sets, by name.
    """

    nodes_of: dict[str, list[int]] = field(default_factory=dict)
    elements_of: dict[str, list[int]] = field(default_factory=dict)
    keywords: list[Keyword] = field(default_factory=list)
    n_characters: int = 0
    n_members: int = 0

    def begin(self, name: str, options: Mapping[str, str], line: int) -> None:
        """Begin a keyword; its name and options are in upper case and without blanks."""
        if name in KEYWORDS or name in _UNREAD:
            self.keywords.append(Keyword(name, options, line))

    def add(self, name: str, line: str) -> None:
        """Add a line to the last keyword, if its name is `name`."""
        if not self.keywords or self.keywords[-1].name != name:
            return
        self.n_characters += len(line)
        if self.n_characters > MOST_CHARACTERS:
            raise RefusedError(f"must have sets and constraints of at most {MOST_CHARACTERS} characters")
        self.keywords[-1].lines.append(line)

    def count(self, n_members: int, source: str) -> None:
        """Raise RefusedError if sets have too many members in all."""
        self.n_members += n_members
        if self.n_members > MOST_ENTRIES:
            raise RefusedError(f"must have sets of at most {MOST_ENTRIES} members in all ({source} has more)")


def constraints_of(
    found: Constraints, places: Mapping[int, tuple[float, float, float]], elements: Mapping[int, tuple[int, ...]]
) -> tuple[list[Equation], set[DofName], list[str]]:
    """Return the equations along global axes, the degrees of freedom that supports hold, and notes.

    Parameters
    ----------
    found : Constraints
    places : mapping of int to (float, float, float)
        Coordinates of the nodes.
    elements : mapping of int to tuple of int
        Nodes of the elements.

    Raises
    ------
    RefusedError, ValueError
        If a keyword is malformed, names an unknown node or set, or does not determine its dependents.
    """
    axes: dict[int, FloatArray] = {}
    held: set[DofName] = set()
    equations: list[Equation] = []
    turned: dict[int, list[tuple[dict[DofName, float], int, str]]] = {}
    notes: dict[str, None] = {}
    for one in found.keywords:
        if one.name in ("NSET", "ELSET"):
            _add_set(found, one)
        elif one.name == "TRANSFORM":
            axes |= _transform(found, one, places)
    dependent: set[DofName] = set()
    for one in found.keywords:
        if one.name == "EQUATION":
            for row, first, source in _equations(found, one, axes, places):
                node, k = first[0], DIRECTIONS.index(first[1])
                if node in axes and k < 3:
                    turned.setdefault(node, []).append((row, k, source))
                    continue
                equations.append(explicit_equation(row.items(), source))
                dependent.add(first)
        elif one.name == "BOUNDARY":
            for node, k in _find_held(found, one):
                if node in axes and k < 3:
                    row = {(node, DIRECTIONS[j]): float(axes[node][k, j]) for j in range(3) if axes[node][k, j]}
                    turned.setdefault(node, []).append((row, k, one.source))
                else:
                    held.add((node, DIRECTIONS[k]))
        elif one.name == "RIGIDBODY":
            equations += _rigid_body(found, one, places, elements, notes)
            if len(equations) > 3 * MOST_DOFS:
                raise RefusedError(f"must have rigid bodies with at most {MOST_DOFS} nodes in all")
        elif one.name in _UNREAD:
            notes[f"*{one.name} in line {one.line} is not read."] = None
    for node, rows in turned.items():
        equations += _along_local_axes(node, rows)
    return equations, held, list(notes)


def _along_local_axes(node: int, rows: Sequence[tuple[dict[DofName, float], int, str]]) -> list[Equation]:
    """Return the equations of a node with axes of its own, all at once, since they share directions."""
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
    """Yield the coefficients along global axes, the first degree of freedom and the source of each equation."""
    rows = one.rows()
    for count, start in enumerate(rows, 1):
        source = f"equation {count} of {one.source}"
        if count > MOST_DOFS:
            raise RefusedError(f"must have at most {MOST_DOFS} equations ({one.source} has more)")
        n = _whole(start[0], f"{source}: the number of terms")
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
            node = _one_node(found, which, source, places)
            k = _direction(direction, source)
            value = _number(factor, source)
            first = first or (node, DIRECTIONS[k])
            own = axes[node][k % 3] if node in axes else np.eye(3)[k % 3]
            for j in np.flatnonzero(own).tolist():
                name = node, DIRECTIONS[j + 3 * (k // 3)]
                coefficients[name] = coefficients.get(name, 0.0) + value * float(own[j])
        assert first is not None
        yield coefficients, first, source


def _one_node(found: Constraints, word: str, source: str, places: Mapping[int, tuple[float, float, float]]) -> int:
    nodes = _nodes(found, word, source)
    if len(nodes) != 1:
        raise RefusedError(f"{source} must name one node per term (the set {quote(word)} has {len(nodes)})")
    _require_node(nodes[0], places, source)
    return nodes[0]


def _rigid_body(
    found: Constraints,
    one: Keyword,
    places: Mapping[int, tuple[float, float, float]],
    elements: Mapping[int, tuple[int, ...]],
    notes: dict[str, None],
) -> list[Equation]:
    reference = _whole(one.options.get("REFNODE", "?"), f"{one.source}: REF NODE")
    if "ROTNODE" not in one.options:
        notes[f"{one.source} has no ROT NODE: no sensors can be at the nodes of its body."] = None
        return []
    rotation = _whole(one.options["ROTNODE"], f"{one.source}: ROT NODE")
    if "NSET" in one.options:
        nodes = _nodes(found, one.options["NSET"], one.source)
    else:
        which = found.elements_of.get(one.options.get("ELSET", ""), [])
        nodes = [node for element in which for node in elements.get(element, ())]
    for node in (reference, rotation, *nodes):
        _require_node(node, places, one.source)
    if not nodes:
        raise RefusedError(f"must have the nodes of all constraints (its body has none, of {one.source})")
    names = [*((reference, d) for d in DIRECTIONS[:3]), *((rotation, d) for d in DIRECTIONS[:3])]
    centre = Point(reference, np.array(places[reference]), np.eye(3))
    equations: list[Equation] = []
    for node in dict.fromkeys(nodes):
        if node not in (reference, rotation):
            S = rigid_motion(Point(node, np.array(places[node]), np.eye(3)), centre)[:3]
            equations += equations_of([(node, d) for d in DIRECTIONS[:3]], names, S, one.source)
    return equations


def _find_held(found: Constraints, one: Keyword) -> Iterator[tuple[int, int]]:
    """Yield the node and the direction, from 0, that *BOUNDARY holds."""
    for words in one.rows():
        if len(words) < 2 or not words[1].isdecimal():
            continue  # Abaqus' names of supports, such as ENCASTRE, and temperatures
        first = int(words[1][:4])
        last = int(words[2][:4]) if len(words) > 2 and words[2].isdecimal() else first
        for node in _nodes(found, words[0], one.source):
            for k in range(first, min(last, 6) + 1):
                if 1 <= k <= 6:
                    yield node, k - 1


def _transform(
    found: Constraints, one: Keyword, places: Mapping[int, tuple[float, float, float]]
) -> dict[int, FloatArray]:
    """Return the axes (rows) of the nodes of *TRANSFORM: rectangular, or cylindrical with TYPE=C."""
    words = [word for row in one.rows() for word in row if word]
    if len(words) != 6:
        raise ValueError(f"{one.source} must have six coordinates (got {len(words)})")
    a, b = np.array([_number(word, one.source) for word in words]).reshape(2, 3)
    found_axes: dict[int, FloatArray] = {}
    for node in _nodes(found, one.options.get("NSET", ""), one.source):
        if one.options.get("TYPE", "R") != "C":
            first, third = a, np.cross(a, b)
        else:
            _require_node(node, places, one.source)
            third = b - a
            radius = np.array(places[node]) - a
            first = radius - third * float(radius @ third) / max(float(third @ third), 1e-300)
        size = np.linalg.norm(first) * np.linalg.norm(third)
        if not size > 0.0:
            raise RefusedError(f"must have axes of three directions ({one.source}, at node {node}, has not)")
        x, z = first / np.linalg.norm(first), third / np.linalg.norm(third)
        found_axes[node] = np.array([x, np.cross(z, x), z])
    return found_axes


def _add_set(found: Constraints, one: Keyword) -> None:
    """Add the members of a set, each once; a set may name sets before it."""
    kind = found.nodes_of if one.name == "NSET" else found.elements_of
    into = dict.fromkeys(kind.get(one.options.get(one.name, ""), []))
    for words in one.rows():
        if "GENERATE" in one.options:
            first, last, step = (*(_whole(word, one.source) for word in words[:3] if word), 1)[:3]
            found.count(max(last - first, 0) // max(step, 1), one.source)
            into |= dict.fromkeys(range(first, last + 1, max(step, 1)))
            continue
        for word in filter(None, words):
            members = [int(word)] if word.isdecimal() and len(word) <= 10 else kind.get(word, [])
            found.count(len(members), one.source)
            into |= dict.fromkeys(members)
    kind[one.options.get(one.name, "")] = list(into)


def _nodes(found: Constraints, word: str, source: str) -> list[int]:
    if word.isdecimal() and len(word) <= 10:
        return [int(word)]
    if word not in found.nodes_of:
        raise RefusedError(f"{source} must name a node or a node set (got {quote(word)})")
    return found.nodes_of[word]


def _require_node(node: int, places: Mapping[int, tuple[float, float, float]], source: str) -> None:
    if node not in places:
        raise RefusedError(f"must have the nodes of all constraints (there is no node {node}, of {source})")


def _whole(word: str, what: str) -> int:
    if not (word.isdecimal() and len(word) <= 10):
        raise ValueError(f"{what} must be a whole number (got {quote(word)})")
    return int(word)


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
