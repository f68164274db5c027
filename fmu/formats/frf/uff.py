"""Reader for frequency response functions in universal files: dataset 58, "Function at Nodal DOF".

pyuff reads the datasets, which may be text or binary, in single or double precision, with even or uneven spacing
(University of Cincinnati, *Universal File Formats for Modal Analysis Testing*). A function of type 4 is an FRF,
and one of type 6 is a coherence. The data types of the ordinate and its denominator determine the kind of FRF, and
dataset 164 gives the units. Directions are along the axes of a node's displacement coordinate system. Dataset 15
or 2411 gives the number of this system, and dataset 18 or 2420 defines it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from fmu.formats.frf.measured_frfs import (
    FRFFormat,
    MeasuredFRFs,
    Points,
    Wanted,
    check_size,
    points_in_order,
    rows_of,
    rows_of_all,
)
from fmu.formats.matrices.limits import LARGEST_FILE, RefusedError
from fmu.formats.modes.measured_modes import ModesError, Place, checked_file
from fmu.formats.modes.uff import NODES, Dataset, read_datasets
from fmu.formats.modes.uff_nodes import SYSTEMS, nodes_and_systems, wrong_nodes
from fmu.numbers import given
from fmu.types import DIRECTIONS, Dof, FloatArray

FUNCTIONS, UNITS = 58, 164
FRF, COHERENCE = 4, 6
_FORCE = (9, 13)
"""Force data types: reaction, excitation."""
_KINDS = {8: "receptance", 11: "mobility", 12: "accelerance"}
"""FRF kinds, by the data type of the response that is divided by a force."""
_UNKNOWN = (0, 1)
_ALONG = 1e-4
"""Largest component perpendicular to a global axis for which an axis counts as parallel to it."""
_IN_G = re.compile(r"[\[(\s]*(g|gn|g_n|g's)\b", re.IGNORECASE)
"""Labels of accelerations in g."""
_SAME_LINES = 1e-5
"""Largest relative difference between the frequency lines of two FRFs, which have six digits in a file."""


def read_uff_frfs(path: Path, wanted: Wanted) -> MeasuredFRFs:
    """Read the FRFs in a universal file, in SI units and along global axes.

    Raises
    ------
    FileNotFoundError, ImportError
        If the file does not exist, or pyuff is not installed.
    ModesError
        If the file cannot be read; if it has no FRFs, or FRFs with different lines, kinds or units; if an FRF is
        neither a motion per force nor a force per displacement; if the requested FRFs are missing; if an FRF has
        no direction along a global axis and its points are not given; or if the number of given points is wrong.
    """
    kinds = (FUNCTIONS, UNITS, *SYSTEMS, *NODES)
    sets = read_datasets(checked_file(path, LARGEST_FILE), kinds, "FRFs", _wrong)
    functions = [one for one in sets if one["type"] == FUNCTIONS]
    frfs = [one for one in functions if one["func_type"] == FRF]
    if not frfs:
        types = sorted({int(one["func_type"]) for one in functions})
        advice = "; make FRFs of time records with fmu.FRFData.from_records" if 1 in types else ""
        raise ModesError(
            path.name, [f"must have FRFs, datasets 58 of function type 4 (got types {types}){advice}"]
        )
    n = len(frfs)
    rows = list(range(n)) if wanted.frfs is None else rows_of(path.name, wanted.frfs, n)
    if wanted.nodes is not None:
        rows = [i for i in rows if frfs[i]["rsp_node"] in wanted.nodes and frfs[i]["ref_node"] in wanted.nodes]
        if not rows:
            raise ModesError(path.name, ["nodes: must have the nodes of the response and the drive of an FRF"])
    frfs = [frfs[i] for i in rows]
    lines = _lines(path, frfs)
    kind = _kind(path, frfs)
    factor, notes = _units(path, sets, frfs)
    axes = _Axes(sets, wanted.nodes or {})
    values = np.array([_si(one, factor) for one in frfs])
    check_size(path.name, values)
    mistakes: list[str] = []

    def points(key: str, end: str, given: Points | None) -> tuple[Dof, ...]:
        if given is None:
            return tuple(axes.points(frfs, end, mistakes))
        of_file = points_in_order(path.name, key, None, given, n)
        return tuple(of_file[i] for i in rows)

    drives, responses = points("drives", "ref", wanted.drives), points("responses", "rsp", wanted.responses)
    if mistakes:
        raise ModesError(path.name, list(dict.fromkeys(mistakes)))
    return MeasuredFRFs(
        lines,
        values,
        drives,
        responses,
        kind,
        coherence=_coherence(functions, frfs, lines, notes),
        notes=(*notes, *axes.notes, *_labels(frfs)),
    )


class _Axes:
    """Displacement axes of each node, expressed in global directions."""

    def __init__(self, sets: Sequence[Dataset], nodes: Mapping[int, Place]) -> None:
        self.nodes, self.notes = nodes, list[str]()
        self._systems, self._system = nodes_and_systems(sets)
        undefined = sorted(set(self._system.values()) - set(self._systems.definitions) - {0})
        if undefined:
            self.notes.append(
                f"The file does not define the coordinate systems {undefined}: global axes are assumed."
            )

    def points(self, frfs: Sequence[Dataset], end: str, mistakes: list[str]) -> list[Dof]:
        """Return the place and global direction of each FRF's response (`end` "rsp") or reference (`end` "ref").

        Errors are appended to `mistakes`.
        """
        found: list[Dof] = []
        for one in frfs:
            node, number = int(one[f"{end}_node"]), int(one[f"{end}_dir"])
            where = f"node {node} ({'response' if end == 'rsp' else 'reference'})"
            direction = ""
            if not 1 <= abs(number) <= len(DIRECTIONS):
                what = "0, a scalar" if number == 0 else str(number)
                key = "responses" if end == "rsp" else "drives"
                mistakes.append(f"{where}: must have a direction from ±1 to ±6 (got {what}); give {key}")
            else:
                direction = self._direction(node, number, where, mistakes)
            found.append((self.nodes.get(node, node), direction))
        return found

    def _direction(self, node: int, number: int, where: str, mistakes: list[str]) -> str:
        """Convert a node's local direction, numbered from ±1 to ±6, to a global direction.

        An error is appended to `mistakes` if the local axis is not along a global axis, or if the coordinate
        system is invalid. In the second case, return "".
        """
        system = self._system.get(node, 0)
        about, k = divmod(abs(number) - 1, 3)
        try:
            axis = self._systems.axes(system, node)[k] if system in self._systems.definitions else np.eye(3)[k]
        except RefusedError as error:
            mistakes.append(f"{where}: {error}")
            return ""
        along = int(np.argmax(np.abs(axis)))
        if np.linalg.norm(np.delete(axis, along)) > _ALONG:
            is_along = ", ".join(map(given, np.round(axis, 4)))
            mistakes.append(f"{where}: must have its axes along global axes (direction {number} is ({is_along}))")
        minus = (axis[along] < 0) != (number < 0)
        return "-" * int(minus) + DIRECTIONS[3 * about + along]


def _wrong(one: Dataset) -> list[str]:
    """Return error messages for malformed content in a dataset, which pyuff does not check.

    The list is empty for functions that are neither FRFs nor coherences.
    """
    if one["type"] in (*SYSTEMS, *NODES):
        return wrong_nodes(one)
    if one["type"] == UNITS:
        factors = (one["length"], one["force"])
        return [] if all(np.isfinite(factors)) and min(factors) > 0 else ["must have positive unit factors"]
    if one["type"] != FUNCTIONS or one["func_type"] not in (FRF, COHERENCE):
        return []
    found = []
    if len(one["data"]) != one["num_pts"] or len(one["x"]) < one["num_pts"]:
        found.append(f"must have {one['num_pts']} values, as its header says (got {len(one['data'])})")
    if one["func_type"] == FRF and not np.iscomplexobj(one["data"]):
        found.append("must have complex values (got amplitudes without a phase)")
    ends = ("rsp_node", "rsp_dir", "ref_node", "ref_dir")
    if not all(isinstance(one[key], int) for key in ends):
        found.append("must have the nodes and the directions of the response and the reference")
    return found


def _lines(path: Path, frfs: Sequence[Dataset]) -> FloatArray:
    """Return the frequency lines in Hz, shape (n_lines,), from the first FRF.

    Raise ModesError unless all FRFs have the same lines, within `_SAME_LINES`.
    """
    lines = np.asarray(frfs[0]["x"], dtype=float)[: frfs[0]["num_pts"]]
    for k, one in enumerate(frfs, 1):
        x = np.asarray(one["x"], dtype=float)[: one["num_pts"]]
        if len(x) != len(lines) or not np.allclose(x, lines, rtol=_SAME_LINES, atol=_SAME_LINES * abs(lines[-1])):
            rule = (
                f"must have the lines of the first FRF in all of them (number {k} has others); choose some by frfs"
            )
            raise ModesError(path.name, [rule])
    return lines


def _kind(path: Path, frfs: Sequence[Dataset]) -> str | None:
    """Return the kind that all FRFs share, or None if the file does not specify it.

    A denominator of unknown type is taken for a force. Raise ModesError if the kinds differ, or if one is neither
    a displacement, velocity or acceleration per force nor a force per displacement.
    """
    found = set()
    for one in frfs:
        top, bottom = int(one["ordinate_spec_data_type"]), int(one["orddenom_spec_data_type"])
        if top in _FORCE and bottom == 8:
            found.add("dynamic-stiffness")
        elif top in _KINDS and bottom in (*_FORCE, *_UNKNOWN):
            found.add(_KINDS[top])
        elif top in _UNKNOWN:
            found.add("")
        else:
            rule = "must have displacements, velocities or accelerations per force"
            raise ModesError(path.name, [f"{rule} (got data types {top} and {bottom})"])
    if len(found) > 1:
        names = ", ".join(sorted(name or "unknown" for name in found))
        raise ModesError(path.name, [f"must have FRFs of one kind (got {names}); choose some by frfs"])
    return found.pop() or None


def _units(path: Path, sets: Sequence[Dataset], frfs: Sequence[Dataset]) -> tuple[tuple[float, float], list[str]]:
    """Return 1 m and 1 N expressed in the file's units, and notes on the units that were assumed.

    SI units are assumed if the file gives none; the note quotes the labels of the FRFs' axes. Raise ModesError if
    it gives several.
    """
    factors = {(float(one["length"]), float(one["force"])) for one in sets if one["type"] == UNITS}
    if len(factors) > 1:
        raise ModesError(path.name, ["must have the same units (dataset 164) throughout"])
    if not factors:
        pairs = [[_label(one, axis) for axis in ("ordinate", "orddenom")] for one in frfs]
        labels = sorted({" per ".join(map(repr, filter(None, pair))) for pair in pairs if any(pair)})
        quoted = f" The labels are {' and '.join(labels)}: if these are not SI, give a scale." if labels else ""
        return (1.0, 1.0), [f"The file does not say its units (dataset 164): SI units are assumed.{quoted}"]
    return factors.pop(), []


def _si(one: Dataset, factor: tuple[float, float]) -> FloatArray:
    """Return an FRF's values (n_lines,) in SI units, with rotations in rad and moments in N·m."""
    length, force = factor
    is_moment, is_rotation = (abs(int(one[f"{end}_dir"])) > 3 for end in ("ref", "rsp"))
    scale = force * length ** (int(is_moment) - int(not is_rotation))
    is_stiffness = int(one["ordinate_spec_data_type"]) in _FORCE
    return np.asarray(one["data"]) * (1.0 / scale if is_stiffness else scale)


def _coherence(
    functions: Sequence[Dataset], frfs: Sequence[Dataset], lines: FloatArray, notes: list[str]
) -> FloatArray | None:
    """Return the coherence of each FRF, shape (n_frfs, n_lines).

    The coherence of an FRF has the same nodes and directions; the signs of the directions may differ. Return None
    if an FRF has no coherence, or its coherence has a different number of lines. If other FRFs have one, a note is
    then appended to `notes`.
    """

    def ends(one: Dataset, sign: Callable[[int], int] = int) -> tuple[int, ...]:
        return tuple(sign(int(one[key])) for key in ("rsp_node", "rsp_dir", "ref_node", "ref_dir"))

    given = [one for one in functions if one["func_type"] == COHERENCE]
    of = {ends(one, sign): one for sign in (abs, int) for one in given}
    found = [of.get(ends(one)) or of.get(ends(one, abs)) for one in frfs]
    rows = [None if one is None or one["num_pts"] != len(lines) else np.abs(one["data"]) for one in found]
    return rows_of_all(rows, "coherence", notes)


def _label(one: Dataset, axis: str) -> str:
    """Return the unit label of the ordinate or of its denominator ("orddenom"); "" if there is none."""
    label = str(one[f"{axis}_axis_units_lab"]).strip()
    return "" if label.upper() == "NONE" else label


def _labels(frfs: Sequence[Dataset]) -> list[str]:
    """Return a list with a note if an axis label says that accelerations are in g, otherwise an empty list."""
    of_g = sorted(label for label in {_label(one, "ordinate") for one in frfs} if _IN_G.match(label))
    if not of_g:
        return []
    return [f"The label of the ordinate is {of_g[0]!r}: if the values are in g, read them with scale=9.80665."]


FORMAT = FRFFormat((".uff", ".unv", ".bunv", ".uf"), read_uff_frfs, ("nodes",))
