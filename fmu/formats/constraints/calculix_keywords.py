"""Keywords that define sets and constraints in CalculiX and Abaqus decks, and the nodes that they list."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from fmu.formats.matrices.limits import MOST_ENTRIES, RefusedError
from fmu.formats.shown import quote

KEYWORDS = (
    "EQUATION",
    "RIGIDBODY",
    "BOUNDARY",
    "TRANSFORM",
    "NSET",
    "ELSET",
    "SURFACE",
    "COUPLING",
    "KINEMATIC",
    "DISTRIBUTING",
    "MPC",
    "CONNECTORSECTION",
    "STEP",
)
UNREAD = (
    "MPC",
    "KINEMATICCOUPLING",
    "DISTRIBUTINGCOUPLING",
    "EMBEDDEDELEMENT",
    "SHELLTOSOLIDCOUPLING",
    "TIE",
    "RELEASE",
    "PRE-TENSIONSECTION",
    "FASTENER",
    "CONNECTORMOTION",
)
"""Constraint keywords that are skipped, written without blanks."""
_UNCONSTRAINED = (
    "ACCELEROMETER",
    "AXIAL",
    "BUSHING",
    "CARDAN",
    "CARTESIAN",
    "EULER",
    "FLEXION-TORSION",
    "PROJECTIONCARTESIAN",
    "PROJECTIONFLEXION-TORSION",
    "RADIAL-THRUST",
    "ROTATION",
    "ROTATION-ACCELEROMETER",
)
"""Types of Abaqus' connectors without kinematic constraints, without blanks (*Elements guide*, 31.1.5)."""
MOST_CHARACTERS = 2**28
"""Largest total number of characters in sets and constraints."""


@dataclass(eq=False)
class Keyword:
    """A keyword in a deck, with its options and data lines.

    Attributes
    ----------
    name : str
    options : mapping of str to str
    line : int
        Line number of the keyword, for messages.
    lines : list of str
    """

    name: str
    options: Mapping[str, str]
    line: int
    lines: list[str] = field(default_factory=list)

    def rows(self) -> Iterator[list[str]]:
        """Yield the words on each data line, in upper case."""
        for line in self.lines:
            yield [word.strip().upper() for word in line.rstrip(",").split(",")]

    @property
    def source(self) -> str:
        """Text that identifies the keyword in messages."""
        name = self.name.replace("RIGIDBODY", "RIGID BODY")
        return f"*{name} in line {self.line}"

    @property
    def is_unread(self) -> bool:
        """Whether it is a constraint that is skipped: one of `UNREAD`, or a section of constrained connectors."""
        if self.name != "CONNECTORSECTION":
            return self.name in UNREAD
        types = next(self.rows(), [])
        return any(one and one.replace(" ", "") not in _UNCONSTRAINED for one in types)


@dataclass(eq=False)
class Constraints:
    """Constraints and sets collected from a deck, in deck order.

    Attributes
    ----------
    nodes_of : dict of str to list of int
        Node sets, keyed by name.
    elements_of : dict of str to list of int
        Element sets, keyed by name.
    keywords : list of Keyword
    n_characters, n_members : int
        Total numbers of characters in data lines, and of members in sets and surfaces. Both are limited.
    """

    nodes_of: dict[str, list[int]] = field(default_factory=dict)
    elements_of: dict[str, list[int]] = field(default_factory=dict)
    keywords: list[Keyword] = field(default_factory=list)
    n_characters: int = 0
    n_members: int = 0

    def begin(self, name: str, options: Mapping[str, str], line: int) -> None:
        """Start a new keyword if it is in `KEYWORDS` or `UNREAD`; otherwise do nothing.

        The name and options must be in upper case and without blanks.
        """
        if name in KEYWORDS or name in UNREAD:
            self.keywords.append(Keyword(name, options, line))

    def add(self, name: str, line: str) -> None:
        """Add a data line to the latest keyword if its name is `name`; otherwise ignore the line.

        Raise RefusedError if the data lines have more than `MOST_CHARACTERS` characters in all.
        """
        if not self.keywords or self.keywords[-1].name != name:
            return
        self.n_characters += len(line)
        if self.n_characters > MOST_CHARACTERS:
            raise RefusedError(f"must have sets and constraints of at most {MOST_CHARACTERS} characters")
        self.keywords[-1].lines.append(line)

    def count(self, n_members: int, source: str) -> None:
        """Add `n_members` to the total size of all sets and surfaces.

        Raise RefusedError if the total then exceeds `MOST_ENTRIES`.
        """
        self.n_members += n_members
        if self.n_members > MOST_ENTRIES:
            raise RefusedError(f"must have sets of at most {MOST_ENTRIES} members in all ({source} has more)")


def add_set(found: Constraints, one: Keyword, elements: Mapping[int, tuple[int, ...]]) -> None:
    """Add the members of an NSET or ELSET keyword to that set in `found`, without duplicates.

    The data lines list ids and names of earlier sets. An NSET with the option ELSET also contains the nodes of
    that element set; `elements` gives the node ids of each element. Unknown sets are ignored. Raise ValueError if
    the numbers under GENERATE are missing or not whole, and RefusedError if there are too many members.
    """
    kind = found.nodes_of if one.name == "NSET" else found.elements_of
    into = dict.fromkeys(kind.get(one.options.get(one.name, ""), []))
    if one.name == "NSET" and "ELSET" in one.options:
        for element in found.elements_of.get(one.options["ELSET"], []):
            into |= dict.fromkeys(elements.get(element, ()))
        found.count(len(into), one.source)
    for words in one.rows():
        if "GENERATE" in one.options:
            numbers = [whole(word, one.source) for word in words[:3] if word]
            if len(numbers) < 2:
                raise ValueError(f"{one.source}: GENERATE needs a first and a last number (got {words[0]})")
            first, last, step = (*numbers, 1)[:3]
            found.count(max(last - first, 0) // max(step, 1), one.source)
            into |= dict.fromkeys(range(first, last + 1, max(step, 1)))
            continue
        for word in filter(None, words):
            members = [int(word)] if word.isdecimal() and len(word) <= 10 else kind.get(word, [])
            found.count(len(members), one.source)
            into |= dict.fromkeys(members)
    kind[one.options.get(one.name, "")] = list(into)


def nodes_of(found: Constraints, word: str, source: str) -> list[int]:
    """Return the node ids given by `word`, which is a single id or the name of a node set.

    Raise RefusedError if there is no such set.
    """
    if word.isdecimal() and len(word) <= 10:
        return [int(word)]
    if word not in found.nodes_of:
        raise RefusedError(f"{source} must name a node or a node set (got {quote(word)})")
    return found.nodes_of[word]


def require_node(node: int, places: Mapping[int, tuple[float, float, float]], source: str) -> None:
    """Raise RefusedError if the deck has no node with this id."""
    if node not in places:
        raise RefusedError(f"must have the nodes of all constraints (there is no node {node}, of {source})")


def one_node(found: Constraints, word: str, source: str, places: Mapping[int, tuple[float, float, float]]) -> int:
    """Return the single node of `word`, an id or a set. Raise RefusedError unless it is one node of the deck."""
    nodes = nodes_of(found, word, source)
    if len(nodes) != 1:
        raise RefusedError(f"{source} must name one node (the set {quote(word)} has {len(nodes)})")
    require_node(nodes[0], places, source)
    return nodes[0]


def whole(word: str, what: str) -> int:
    """Convert a word to int. Raise ValueError unless it consists of one to ten digits.

    `what` describes the word in the error message.
    """
    if not (word.isdecimal() and len(word) <= 10):
        raise ValueError(f"{what} must be a whole number (got {quote(word)})")
    return int(word)
