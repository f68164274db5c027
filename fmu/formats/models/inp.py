"""Reader for nodes and elements in Abaqus and CalculiX input decks, ``.inp``.

meshio's reader is not used: it follows ``*INCLUDE`` to any path, has no size limits, and knows fewer element
types.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from fmu.formats.constraints.calculix import constraints_of
from fmu.formats.constraints.calculix_keywords import Constraints
from fmu.formats.matrices.limits import RefusedError, text_lines
from fmu.formats.models.edges import SOLID_EDGES
from fmu.formats.models.exported import MOST_ELEMENTS, MOST_NODES, Mesh, MeshFormat, mesh_of
from fmu.formats.shown import quote

_SOLIDS = {
    4: "tetra", 6: "wedge", 8: "hexahedron", 10: "tetra10", 15: "wedge15", 20: "hexahedron20", 27: "hexahedron27"
}  # fmt: skip
_FACES = {3: "triangle", 4: "quad", 6: "triangle6", 8: "quad8", 9: "quad9"}
_LINES = {2: "line", 3: "line3"}
_POINTS = {1: "vertex"}
_TYPES = (
    (r"C3D(\d+)|SC([68])", _SOLIDS),
    (r"STRI(3)|STRI(6)5", _FACES),
    (r"(?:S|DS|M3D|CPS|CPE|CPEG|CAX|R3D|SFM3D|RAX)([34689])", _FACES),
    (r"[TR][23]D([23])|FRAME[23]D|B[23]()[123]|PIPE[23]()[123]|ELBOW[3](2)", _LINES),
    (r"SPRINGA|SPRING2|DASHPOT[A2]|CONN3D2|GAPUNI|ITSCYL", _LINES),
    (r"SPRING1|DASHPOT1|MASS|ROTARYI|HEATCAP", _POINTS),
)
_UNEXPANDED = r"C3D|SC[68]|SPRING|DASHPOT|GAPUNI|MASS|ROTARYI|CONN"
"""Types of elements that CalculiX does not expand into solids."""
_FACES_OF = {
    "tetra": ((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)),
    "wedge": ((0, 1, 2), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "hexahedron": ((0, 1, 2, 3), (4, 7, 6, 5), (0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0)),
}
"""Corner indices of faces S1, S2 … in CalculiX and Abaqus."""
_REFUSED = {
    "INCLUDE": "the files that *INCLUDE names are not followed: put their lines in its place",
    "PART": "it has parts and instances, whose nodes have other numbers in the matrices: write a deck without "
    "them (in Abaqus/CAE, Model > Edit Attributes > Do not use parts and assemblies in input files)",
    "SYSTEM": "coordinates in the system of *SYSTEM are not read: give them in global axes",
    "NGEN": "nodes that *NGEN generates are not read: give each in *NODE",
    "NFILL": "nodes that *NFILL generates are not read: give each in *NODE",
    "NCOPY": "nodes that *NCOPY generates are not read: give each in *NODE",
    "ELGEN": "elements that *ELGEN generates are not read: give each in *ELEMENT",
    "ELCOPY": "elements that *ELCOPY generates are not read: give each in *ELEMENT",
}
_REFUSED["INSTANCE"] = _REFUSED["PART"]
LONGEST_KEYWORD = 10_000


def parse(lines: Iterator[str]) -> Mesh:
    """Parse a deck's lines into a mesh.

    Elements of unknown types are left out, with a note. Lines after the step in which CalculiX stores its matrices
    are ignored.

    Raises
    ------
    RefusedError
        If the deck generates nodes or elements, includes files, has parts, coordinates in the system of
        ``*SYSTEM``, no nodes, an element with an unknown node, or too many nodes or elements; or if a constraint
        cannot be read.
    ValueError
        If a line of a node, an element, a set or a constraint is malformed, or an element lacks nodes.
    """
    nodes: dict[int, tuple[float, float, float]] = {}
    constraints = Constraints()
    numbered: dict[int, tuple[int, ...]] = {}
    kind_of_element: dict[int, str] = {}
    node_set: list[int] = []
    element_set: list[int] = []
    elements: list[tuple[int, ...]] = []
    kinds: list[str] = []
    unknown: dict[str, None] = {}
    at_nodes = expanded = set[int]()
    whole_nodes = set[int]()
    is_transformed = is_stored = is_connector = False
    reading, kind, needed = "", "", 0
    ahead: list[int] = []
    begun = ""
    for number, line in enumerate(lines, 1):
        line = begun + line.strip()
        if not line or line.startswith("**"):
            continue
        if line.startswith("*"):
            begun = line if line.endswith(",") and len(line) < LONGEST_KEYWORD else ""
            if begun:  # options continue on the next line
                continue
            reading, options = _keyword(line)
            if ahead:
                raise ValueError(f"line {number}: an element has {len(ahead) - 1} of its {needed} nodes")
            if reading == "STEP" and is_stored:
                break  # CalculiX ends after the step that stores its matrices
            if reading in _REFUSED:
                raise RefusedError(f"line {number}: {_REFUSED[reading]}")
            is_transformed |= reading == "TRANSFORM"
            is_stored |= options.get("SOLVER") == "MATRIXSTORAGE"
            constraints.begin(reading, options, number)
            if reading in ("NODE", "ELEMENT") and "INPUT" in options:
                raise RefusedError(f"line {number}: {_REFUSED['INCLUDE'].replace('INCLUDE', 'INPUT')}")
            if reading == "NODE" and options.get("SYSTEM", "R") not in ("R", ""):
                raise RefusedError(f"line {number}: {_REFUSED['SYSTEM']}")
            if reading == "NODE":
                node_set = constraints.nodes_of.setdefault(options.get("NSET", ""), [])
            if reading == "ELEMENT":
                element_set = constraints.elements_of.setdefault(options.get("ELSET", ""), [])
                kind, needed = kind_of(options.get("TYPE", ""))
                is_connector = options.get("TYPE", "").startswith("CONN")
                at_nodes = whole_nodes if re.match(_UNEXPANDED, options.get("TYPE", "")) else expanded
                if not kind:
                    unknown[options.get("TYPE", "")] = None
                    reading = ""
        elif reading == "NODE":
            words = [word.strip() for word in line.rstrip(",").split(",")]
            x, y, z = (*(_number(word, number) for word in words[1:4]), 0.0, 0.0, 0.0)[:3]
            node = _id(words[0], number)
            nodes[node] = (x, y, z)
            node_set.append(node)
            if len(nodes) > MOST_NODES:
                raise RefusedError(f"must have at most {MOST_NODES} nodes")
        elif reading == "ELEMENT":
            ahead += [_id(word.strip(), number) for word in line.split(",") if word.strip()]
            if is_connector:  # a blank node is the ground
                if len(ahead) not in (2, 3):
                    raise ValueError(f"line {number}: a connector has one or two nodes (got {len(ahead) - 1})")
                kind, needed = ("vertex", 1) if len(ahead) == 2 else ("line", 2)
            if len(ahead) > needed:
                if len(ahead) > needed + 1 and kind not in ("line", "line3"):  # these may name a further node
                    raise ValueError(f"line {number}: a {kind} has {needed} nodes (got {len(ahead) - 1})")
                ends = ahead[1 : needed + 1]
                elements.append((ends[0], ends[2], ends[1]) if kind == "line3" else tuple(ends))
                kinds.append(kind)
                at_nodes.update(elements[-1])
                numbered[ahead[0]], kind_of_element[ahead[0]] = elements[-1], kind
                element_set.append(ahead[0])
                ahead = []
                if len(elements) > MOST_ELEMENTS:
                    raise RefusedError(f"must have at most {MOST_ELEMENTS} elements")
        else:
            constraints.add(reading, line)
    if ahead:
        raise ValueError(f"its last element has {len(ahead) - 1} of its {needed} nodes")
    notes = [f"Elements of the unknown type {quote(one)} are left out of the mesh." for one in unknown]
    if is_transformed:
        notes.append(TRANSFORMED)
    is_numbered = is_stored and not unknown and set(kinds) <= {"vertex", *_SOLIDS.values()}

    def face(element: int, name: str) -> list[int]:
        return nodes_of_face(kind_of_element.get(element, ""), numbered.get(element, ()), name)

    equations, held, turning, of_constraints, unread = constraints_of(
        constraints, nodes, numbered, face, is_numbered
    )
    mesh = mesh_of(nodes, elements, kinds, [*notes, *of_constraints])
    return mesh._replace(
        equations=tuple(equations), held=frozenset(held), unread=unread, turning=frozenset(turning),
        loaded=frozenset(expanded & whole_nodes),
    )  # fmt: skip


TRANSFORMED = "The deck has *TRANSFORM: degrees of freedom are along global axes, as CalculiX writes them."


def nodes_of_face(kind: str, nodes: Sequence[int], name: str) -> list[int]:
    """Return the node ids on face S1, S2 … of a solid, including midside nodes, or [] if it has no such face."""
    shape = kind.rstrip("0123456789")
    at = int(name[1:]) - 1 if re.fullmatch("S[1-6]", name) else 6
    if at >= len(_FACES_OF.get(shape, ())):
        return []
    corners, edges = _FACES_OF[shape][at], SOLID_EDGES[shape]
    n_corners = 1 + max(max(edge) for edge in edges)
    middles = [node for edge, node in zip(edges, nodes[n_corners:], strict=False) if set(edge) <= set(corners)]
    return [*(nodes[k] for k in corners), *middles]


def kind_of(name: str) -> tuple[str, int]:
    """Return meshio's name and the node count for an element type. The name is empty if the type is unknown."""
    for pattern, kinds in _TYPES:
        found = re.match(pattern, name)
        if found is None:
            continue
        count = next((part for part in found.groups() if part is not None), "")
        if kinds is _POINTS:
            return "vertex", 1
        if kinds is _LINES and not count:
            return ("line3", 3) if re.match(r"(B|PIPE)[23]2", name) else ("line", 2)
        return kinds.get(int(count), ""), int(count)
    return "", 0


def _keyword(line: str) -> tuple[str, dict[str, str]]:
    """Return the keyword on a line and its options, in upper case and without blanks."""
    word, *options = line[1:].upper().replace(" ", "").replace("\t", "").split(",")
    pairs = (option.partition("=") for option in options if option)
    return word, {key: value for key, _, value in pairs}


def _id(word: str, number: int) -> int:
    if not (word.isdecimal() and len(word) <= 10 and int(word) > 0):
        raise ValueError(
            f"line {number}: numbers of nodes and elements must be whole and positive (got {quote(word)})"
        )
    return int(word)


def _number(word: str, number: int) -> float:
    try:
        return float(word.upper().replace("D", "E")) if word else 0.0
    except ValueError:
        raise ValueError(f"line {number}: a coordinate must be a number (got {quote(word)})") from None


def _read(path: Path) -> Mesh:
    with open(path, "rb") as file:
        return parse(text_lines(file))


FORMAT = MeshFormat((".inp",), _read)
