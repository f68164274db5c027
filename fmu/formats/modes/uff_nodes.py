"""Reader for nodes and coordinate systems in universal files.

Dataset 15 or 2411 gives the position of each node in its definition system, and the number of its displacement
system. Dataset 18 or 2420 defines the systems. Coordinates in cylindrical and spherical systems are as in Nastran,
with angles in degrees (`fmu.formats.models.coordinate_systems`); SDynPy and IMAT read them so. Number 0 is the
global system, and so is number 1 if the file does not define it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from fmu.formats.matrices.limits import RefusedError
from fmu.formats.models.coordinate_systems import Definition, Kind, Systems
from fmu.formats.modes.measured_modes import ModesError, checked_file
from fmu.formats.modes.uff import NODES, Dataset, read_datasets
from fmu.types import FloatArray

SYSTEMS = 18, 2420
_KINDS: tuple[Kind, ...] = ("R", "C", "S")
_GLOBAL = 1, Definition("R", np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]))


def read_uff_points(path: Path) -> dict[str, FloatArray]:
    """Read node coordinates (3,) along global axes, in the file's unit, keyed by node number as text.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ImportError, ModesError
        See `fmu.formats.modes.uff.datasets`; also if there are no nodes, a node has two different positions, or
        the file lacks the coordinate system of a node.
    """
    sets = read_datasets(checked_file(path), (*NODES, *SYSTEMS), "nodes", wrong_nodes)
    systems, _ = nodes_and_systems(sets)
    if not systems.given:
        raise ModesError(path.name, ["must have nodes, dataset 15 or 2411 (it has none)"])
    for node, system, _, place in _nodes(sets):
        first = systems.given[node]
        if first[0] != system or np.any(first[1] != place):
            raise ModesError(path.name, [f"must have each node once (got node {node} at two places)"])
    points = {}
    for node in systems.given:
        try:
            points[str(node)] = systems.place(node)
        except RefusedError as error:
            advice = "export the coordinate systems too (dataset 18 or 2420), or global coordinates (system 0)"
            raise ModesError(path.name, [f"node {node}: {error}; {advice}"]) from None
    return points


def nodes_and_systems(sets: Sequence[Dataset]) -> tuple[Systems, dict[int, int]]:
    """Return the coordinate systems with all nodes, and the number of each node's displacement system."""
    nodes = list(_nodes(sets))
    definitions = dict([_GLOBAL, *(definition for one in sets for definition in _definitions(one))])
    given = {node: (system, place) for node, system, _, place in nodes}
    return Systems(definitions, given), {node: system for node, _, system, _ in nodes}


def wrong_nodes(one: Dataset) -> list[str]:
    """Return error messages for malformed nodes or coordinate systems, which pyuff does not check."""
    if one["type"] in SYSTEMS:
        kinds = one["cs_type"] if one["type"] == SYSTEMS[0] else one["CS_types"]
        is_known = all(int(kind) in range(len(_KINDS)) for kind in kinds)
        return [] if is_known else ["must have systems of type 0 to 2"]
    columns = [np.asarray(one[key], dtype=float) for key in ("node_nums", "def_cs", "disp_cs", "x", "y", "z")]
    if len({len(column) for column in columns}) > 1 or not np.all(np.isfinite(columns)):
        return ["must have a number, two coordinate systems and a place of each node"]
    return ["must have whole node numbers"] if np.any(columns[0] % 1) else []


def _nodes(sets: Sequence[Dataset]) -> Iterator[tuple[int, int, int, FloatArray]]:
    """Yield each node's number, its definition and displacement systems, and its coordinates (3,) in the first."""
    for one in (one for one in sets if one["type"] in NODES):
        for node, system, of_motion, *place in zip(
            *(one[key] for key in ("node_nums", "def_cs", "disp_cs", "x", "y", "z")), strict=True
        ):
            yield int(node), int(system), int(of_motion), np.array(place, dtype=float)


def _definitions(one: Dataset) -> list[tuple[int, Definition]]:
    """Return the number and definition of each coordinate system in a dataset of type 18 or 2420.

    The list is empty for other types.
    """
    found = []
    if one["type"] == SYSTEMS[0]:
        columns = (one[key] for key in ("cs_num", "cs_type", "ref_cs_num", "ref_o", "x_point", "xz_point"))
        for number, kind, reference, *points in zip(*columns, strict=True):
            own = Definition(_KINDS[int(kind)], np.array(points), int(reference), is_along_x=True)
            found.append((int(number), own))
    elif one["type"] == SYSTEMS[1]:
        for number, kind, matrix in zip(
            *(one[f"CS_{key}"] for key in ("sys_labels", "types", "matrices")), strict=True
        ):
            x, _, z, origin = matrix  # rows: the axes, then the origin
            found.append((int(number), Definition(_KINDS[int(kind)], np.array([origin, origin + z, origin + x]))))
    return found
