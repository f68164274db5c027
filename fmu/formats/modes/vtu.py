"""Writer for mode shapes on a mesh as VTU files, VTK's XML format for unstructured grids.

ParaView and PyVista read these files. The format is described in *The VTK User's Guide*, "VTK File Formats".
Arrays are binary, in base64.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike

from fmu.types import FloatArray


class CellType(NamedTuple):
    """Element kind: its corner count, and its type number in VTK and in universal files (0 if it has none)."""

    corners: int
    vtk: int
    uff: int


CELLS = {
    "line": CellType(2, 3, 11),
    "triangle": CellType(3, 5, 91),
    "quad": CellType(4, 9, 94),
    "tetra": CellType(4, 10, 111),
    "pyramid": CellType(5, 14, 0),
    "wedge": CellType(6, 13, 112),
    "hexahedron": CellType(8, 12, 115),
}
"""Element kinds by meshio's names; for kinds such as ``"hexahedron20"``, only the corners are written."""
_WEDGE = (0, 2, 1, 3, 5, 4)
"""VTK's corner order for a wedge, whose first triangle is seen from inside."""
_TYPES = {"d": ("Float64", "<f8"), "f": ("Float32", "<f4"), "i": ("Int64", "<i8"), "u": ("UInt8", "u1")}


def cells(elements: Iterable[Sequence[int]], kinds: Iterable[str]) -> list[tuple[CellType, tuple[int, ...]]]:
    """Return the cell type and corner nodes of every element whose kind is known."""
    found = []
    for element, kind in zip(elements, kinds, strict=True):
        known = CELLS.get(kind.rstrip("0123456789"))
        if known is not None:
            found.append((known, tuple(int(node) for node in element[: known.corners])))
    return found


def write_vtu(
    path: Path,
    coordinates: ArrayLike,
    elements: Iterable[Sequence[int]],
    kinds: Iterable[str],
    vectors: Mapping[str, FloatArray],
    scalars: Mapping[str, FloatArray],
) -> None:
    """Write a mesh with nodal vectors and nodal integers to a VTU file.

    Parameters
    ----------
    path : Path
        An existing file is replaced.
    coordinates : array_like, shape (n_nodes, 3), m
    elements : iterable of sequence of int
        Node indices of each element, counted from 0, corners first.
    kinds : iterable of str
        Kind of each element; elements whose kind is not in `CELLS` are skipped.
    vectors : mapping of str to ndarray, shape (n_nodes, 3)
        Nodal vectors by name, such as the displacements in a mode.
    scalars : mapping of str to ndarray of int, shape (n_nodes,)
        Nodal integers by name, such as node ids.
    """
    grid, places = cells(elements, kinds), np.asarray(coordinates, dtype=float)
    in_order = (_WEDGE if kind.vtk == CELLS["wedge"].vtk else range(kind.corners) for kind, _ in grid)
    corners = [nodes[k] for (_, nodes), order in zip(grid, in_order, strict=True) for k in order]
    data = [_array(name, values, "f") for name, values in vectors.items()]
    data += [_array(name, values, "i") for name, values in scalars.items()]
    parts = [
        '<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64">',
        f'<UnstructuredGrid><Piece NumberOfPoints="{len(places)}" NumberOfCells="{len(grid)}">',
        f"<Points>{_array('Points', places, 'd')}</Points>",
        f"<Cells>{_array('connectivity', corners, 'i')}",
        _array("offsets", np.cumsum([len(nodes) for _, nodes in grid]), "i"),
        f"{_array('types', [kind.vtk for kind, _ in grid], 'u')}</Cells>",
        f"<PointData>{''.join(data)}</PointData>",
        "</Piece></UnstructuredGrid></VTKFile>\n",
    ]
    path.write_text("\n".join(parts), encoding="utf-8")


def _array(name: str, values: ArrayLike, kind: str) -> str:
    of_vtk, dtype = _TYPES[kind]
    array = np.ascontiguousarray(values, dtype=dtype)
    components = ' NumberOfComponents="3"' if array.ndim == 2 else ""
    text = base64.b64encode(np.uint64(array.nbytes).astype("<u8").tobytes() + array.tobytes()).decode()
    return f'<DataArray type="{of_vtk}" Name={quoteattr(name)}{components} format="binary">{text}</DataArray>'
