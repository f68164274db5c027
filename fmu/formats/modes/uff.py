"""Reader and writer for mode shapes in universal files, based on pyuff.

Shapes are in dataset 55, "Data at Nodes"; node coordinates are in dataset 15 or 2411, elements in dataset 2412.
`fmu.formats.modes.uff_nodes` reads the nodes.
The format was defined by the Structural Dynamics Research Corporation (University of Cincinnati, *Universal File
Formats for Modal Analysis Testing*). Written frequencies and shapes have its six significant digits.

pyuff accepts any number of values, whatever a header announces, and does not say why it cannot read a dataset.
`datasets` therefore checks the data that pyuff returns.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike

from fmu.arguments import ArgumentError
from fmu.formats.modes.measured_modes import (
    LEAST_MPC,
    Collinearity,
    Computed,
    MeasuredModes,
    ModeNumber,
    ModesError,
    ModesFormat,
    Place,
    Sensors,
    check_sensors,
    checked_file,
    is_node,
    real_shapes,
)
from fmu.formats.modes.vtu import CellType
from fmu.formats.shown import in_words, quote
from fmu.types import DIRECTIONS, AnyArray, Dof, FloatArray

SHAPES = 55
NODES, ELEMENTS, TRACE_LINES = (15, 2411), 2412, 82
REAL, COMPLEX = (2,), (3, 7)
"""Analysis types: normal modes; complex eigenvalues of first and second order."""
MOST_DATASETS = 10_000
LARGEST_DATASET = 2**23
"""Largest dataset size, bytes: about 150 000 nodes."""
_MOTION = (0, 1, 8, 11, 12)
"""Specific data types: unknown, general, displacement, velocity, acceleration."""
_TAG = b"    -1"
Dataset = Mapping[str, AnyArray]
"""A dataset as pyuff returns it: numbers and arrays by name."""
_Written = dict[str | int, object]
"""A dataset as pyuff writes it; the keys of element groups are type numbers."""


def read_uff(
    file: Path,
    nodes: Mapping[int, Place] | None = None,
    modes: Sequence[ModeNumber] | None = None,
    sensors: Sensors | None = None,
    least_mpc: Collinearity = LEAST_MPC,
) -> MeasuredModes:
    """Read the modes in a universal file.

    Parameters
    ----------
    file : Path
    nodes : mapping of node number to place, optional
        Model location of each node in the file; other nodes are skipped. By default a node's place is its number.
    modes : sequence of int, optional
        Numbers of the modes to use, in this order; by default all, in file order.
    sensors : sequence of (place, direction), optional
        Places and measured directions, which may have a minus sign. The default is every place and direction with
        a nonzero component in at least one mode: the format fills unmeasured directions with zeros.
    least_mpc : float
        Smallest phase collinearity of complex shapes, which are converted to real shapes; see
        `fmu.formats.modes.measured_modes.real_shapes`.

    Returns
    -------
    MeasuredModes
        The labels are the mode numbers in the file. The frequency of a complex mode with eigenvalue s is |s|/2π.
        Shapes are along global axes, as the format specifies.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ImportError
        If pyuff is not installed.
    ModesError
        If the file cannot be read, has no modes, has a mode twice, or lacks a given mode, a given node, or a
        sensor in one of the modes; if a frequency is not above 0 Hz; or if a shape is zero, or its collinearity is
        below `least_mpc`.
    """
    mode_sets = datasets(checked_file(file))
    by_number = {int(mode["mode_n"]): mode for mode in mode_sets}
    if not mode_sets:
        raise ModesError(file.name, ["must have mode shapes, dataset 55 of analysis type 2, 3 or 7 (got none)"])
    if len(by_number) < len(mode_sets):
        twice = [int(mode["mode_n"]) for mode in mode_sets]
        raise ModesError(file.name, [f"must have each mode once (got the numbers {twice})"])
    chosen = list(by_number) if modes is None else [int(number) for number in modes]
    missing = [number for number in chosen if number not in by_number]
    if missing or not chosen:
        raise ModesError(file.name, [f"modes: must be some of {sorted(by_number)} (got {chosen})"])
    place_of = _places(file, nodes, mode_sets)
    values = {number: _values(mode, place_of) for number, mode in by_number.items()}
    ours = {sensor for number in chosen for sensor in values[number]}
    moving = [sensor for sensor in _find_moving(values) if sensor in ours]
    seen = moving if sensors is None else [(place, str(direction)) for place, direction in sensors]
    check_sensors(file.name, seen, [sensor for mode in values.values() for sensor in mode])
    table = np.array([[_at(values[number], sensor, file, number) for number in chosen] for sensor in seen])
    frequencies = np.array([_frequency(by_number[number]) for number in chosen])
    wrong = [f"{n} at {f} Hz" for n, f in zip(chosen, frequencies, strict=True) if not f > 0]
    if wrong:
        raise ModesError(file.name, [f"modes: must have frequencies above 0 Hz (got {', '.join(wrong)})"])
    if not seen:
        raise ModesError(file.name, ["shapes: must move at one of the nodes (got zeros)"])
    try:
        shapes, mpc = real_shapes(table, least_mpc)
    except ValueError as error:
        raise ModesError(file.name, [str(error)]) from None
    is_complex = any(np.iscomplexobj(by_number[number]["r1"]) for number in chosen)
    found = MeasuredModes(frequencies, tuple(map(str, chosen)), None, tuple(seen), shapes, mpc=mpc)
    return found if is_complex else replace(found, shapes=table.real, mpc=None)


def write_uff(
    path: Path,
    frequencies_hz: ArrayLike,
    shapes: ArrayLike,
    sensors: Sensors,
    numbers: Sequence[int],
    nodes: Mapping[int, Place] | None = None,
    places: Mapping[Place, ArrayLike] | None = None,
    elements: Sequence[tuple[CellType, tuple[int, ...]]] = (),
) -> None:
    """Write real mode shapes to a universal file, one dataset 55 per mode, with nodes and elements if given.

    Parameters
    ----------
    path : Path
        An existing file is replaced.
    frequencies_hz : array_like, shape (n_modes,)
    shapes : array_like, shape (n_sensors, n_modes)
    sensors : sequence of (place, direction)
    numbers : sequence of int
        Mode numbers.
    nodes : mapping of node number to place, optional
        As in `read_uff`; needed if a place is not a number.
    places : mapping of place to array_like, shape (3,), optional
        Coordinates in m, written as dataset 2411.
    elements : sequence of (CellType, corner node numbers), optional
        Written as dataset 2412, but pyramids are skipped; see `fmu.formats.modes.vtu.cells`.

    Raises
    ------
    ImportError
        If pyuff is not installed.
    ValueError
        If a place has no node number, or two sensors have the same node and direction.
    """
    number_of: dict[Hashable, int] = {place: int(node) for node, place in (nodes or {}).items()}
    node_numbers: list[int] = []
    for place, _ in sensors:
        if place not in number_of and not is_node(place):
            raise ArgumentError("nodes", f"must say which node number {place!r} is")
        node_numbers.append(number_of[place] if place in number_of else int(str(place)))
    directions = [direction.removeprefix("-") for _, direction in sensors]
    if len(set(zip(node_numbers, directions, strict=True))) < len(directions):
        raise ArgumentError("sensors", "must be distinct nodes or directions")
    written = sorted(set(node_numbers))
    row = {node: i for i, node in enumerate(written)}
    columns = DIRECTIONS if any(direction.startswith("r") for direction in directions) else DIRECTIONS[:3]
    sign = np.array([-1.0 if direction.startswith("-") else 1.0 for _, direction in sensors])
    sets = _mesh(places or {}, elements, number_of)
    for number, frequency, shape in zip(numbers, np.asarray(frequencies_hz), np.asarray(shapes).T, strict=True):
        table = np.zeros((len(written), len(columns)))
        for node, direction, value in zip(node_numbers, directions, sign * shape, strict=True):
            table[row[node], columns.index(direction)] = value
        data_ch = 2 if len(columns) == 3 else 3
        one: _Written = {"type": SHAPES, "analysis_type": 2, "data_ch": data_ch, "spec_data_type": 8}
        one |= {"load_case": 0, "mode_n": int(number), "freq": float(frequency), "node_nums": written}
        sets.append(one | {f"r{i + 1}": table[:, i] for i in range(len(columns))})
    with imported_pyuff() as pyuff:
        pyuff.UFF(str(path)).write_sets(sets, mode="overwrite")


def _mesh(
    places: Mapping[Place, ArrayLike],
    elements: Sequence[tuple[CellType, tuple[int, ...]]],
    number_of: Mapping[Hashable, int],
) -> list[_Written]:
    sets: list[_Written] = []
    if places:
        x, y, z = np.array([np.asarray(place, dtype=float) for place in places.values()]).T
        numbers = [int(number_of.get(place, place)) for place in places]
        sets.append({"type": NODES[1], "node_nums": numbers, "x": x, "y": y, "z": z})
        sets[0] |= {key: [1] * len(places) for key in ("def_cs", "disp_cs", "color")}
    groups: dict[str | int, list[dict[str, object]]] = {}
    for k, (cell, nodes) in enumerate(elements, 1):
        if cell.uff:
            one: dict[str, object] = {"element_nums": k, "fe_descriptor": cell.uff}
            one |= {"num_nodes": len(nodes), "nodes_nums": list(nodes)}
            one |= dict.fromkeys(("phys_table", "mat_table", "color"), 1)
            one |= dict.fromkeys(("beam_orientation", "beam_foreend_cross", "beam_aftend_cross"), 0)
            groups.setdefault(cell.uff, []).append(one)
    return [*sets, {"type": ELEMENTS, **groups}] if groups else sets


def _places(path: Path, nodes: Mapping[int, Place] | None, modes: list[Dataset]) -> dict[int, Place]:
    """Return the place of each used node, keyed by node number. Raise ModesError if a node is in no mode."""
    there = sorted({int(node) for mode in modes for node in mode["node_nums"]})
    if nodes is None:
        return {node: node for node in there}
    place_of = {int(node): place for node, place in nodes.items()}
    missing = sorted(set(place_of) - set(there))
    if missing:
        raise ModesError(path.name, [f"nodes: must be some of {quote(there)} (got {quote(missing)})"])
    return place_of


def _values(mode: Dataset, place_of: dict[int, Place]) -> dict[Dof, complex]:
    """Return a mode's complex components, keyed by (place, direction)."""
    return {
        (place_of[int(node)], direction): complex(mode[f"r{i + 1}"][k])
        for i, direction in enumerate(DIRECTIONS)
        if f"r{i + 1}" in mode
        for k, node in enumerate(mode["node_nums"])
        if int(node) in place_of
    }


def _find_moving(values: dict[int, dict[Dof, complex]]) -> list[Dof]:
    """Return the sensors with a nonzero component in at least one mode, in file order."""
    everything = dict.fromkeys(sensor for mode in values.values() for sensor in mode)
    return [sensor for sensor in everything if any(mode.get(sensor, 0.0) != 0.0 for mode in values.values())]


def _at(mode: dict[Dof, complex], sensor: Dof, file: Path, number: int) -> complex:
    place, direction = sensor
    value = mode.get((place, direction.removeprefix("-")))
    if value is None:
        rule = "must have all nodes in all modes, or leave some out"
        raise ModesError(file.name, [f"{rule} (mode {number} has no {direction} of {quote(place)})"])
    return -value if direction.startswith("-") else value


def _frequency(mode: Dataset) -> float:
    return float(mode["freq"]) if mode["analysis_type"] in REAL else float(abs(mode["eig"]) / (2.0 * np.pi))


@contextmanager
def imported_pyuff() -> Iterator[ModuleType]:
    """Within a ``with`` block, provide pyuff with its deprecation warnings silenced.

    Raise ImportError if pyuff is not installed.
    """
    try:
        import pyuff
    except ImportError:
        raise ImportError("universal files need pyuff: install fmu[uff]") from None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        yield pyuff


def datasets(path: Path) -> list[Dataset]:
    """Return the datasets of type 55 that contain normal or complex modes; skip datasets of other analyses.

    Raises
    ------
    FileNotFoundError, ImportError
        If there is no such file, or pyuff is not installed.
    ModesError
        If the file is not a universal file, has too many or too large datasets, or has malformed modes.
    """
    sets = read_datasets(path, (SHAPES,), "modes", _wrong)
    return [one for one in sets if one["analysis_type"] in REAL + COMPLEX]


def read_datasets(
    path: Path, kinds: tuple[int, ...], what: str, wrong: Callable[[Dataset], list[str]]
) -> list[Dataset]:
    """Read the datasets of the given types.

    `what` names their content in error messages.

    Raises
    ------
    ImportError, ModesError
        See `datasets`; also if `wrong` returns errors for a dataset.
    """
    content = path.read_bytes()
    if content.count(_TAG) > 2 * MOST_DATASETS:
        raise ModesError(path.name, [f"must have at most {MOST_DATASETS} datasets"])
    names = [[f"{kind}{binary}".encode()] for kind in kinds for binary in ("", "b")]
    if any(len(part) > LARGEST_DATASET and part[:99].split()[:1] in names for part in content.split(_TAG)):
        raise ModesError(path.name, [f"must have {what} in datasets of at most {LARGEST_DATASET} bytes"])
    with imported_pyuff() as pyuff:
        try:
            file = pyuff.UFF(str(path))
            types = [int(kind) for kind in file.get_set_types()]
        except Exception as error:  # pyuff raises no other kind
            raise ModesError(path.name, [f"must be a universal file ({in_words(error)})"]) from error
        if not types:
            raise ModesError(path.name, ["must be a universal file (it has no dataset)"])
        sets, found = [], []
        for i in (i for i, kind in enumerate(types) if kind in kinds):
            try:
                one = file.read_sets(i)
                found += [f"dataset {i + 1}: {rule}" for rule in wrong(one)]
                sets.append(one)
            except Exception:
                where = f"its dataset {i + 1}, of type {types[i]}"
                found.append(f"must be a universal file ({where}, has lines of another format)")
    if found:
        raise ModesError(path.name, found)
    return sets


def _wrong(one: Dataset) -> list[str]:
    """Return error messages if a dataset contains malformed modes, which pyuff does not check; otherwise []."""
    if one["analysis_type"] not in REAL + COMPLEX:
        return []
    frequency = "freq" if one["analysis_type"] in REAL else "eig"
    found = []
    if not float(one.get("mode_n", np.nan)).is_integer():
        found.append(f"must have a whole mode number (got {one.get('mode_n')})")
    if not np.isfinite(one.get(frequency, np.nan)):
        found.append(f"must have a finite frequency or eigenvalue (got {one.get(frequency)})")
    if one["spec_data_type"] not in _MOTION:
        found.append(
            f"shapes must be of displacement, velocity or acceleration (got type {one['spec_data_type']})"
        )
    most = 6 if one["data_type"] == 2 else 3
    if one["data_type"] not in (2, 5) or one["n_data_per_node"] not in (3, most):
        found.append(
            "must have real data (type 2) of 3 or 6 values a node, or complex data (type 5) of 3 "
            f"(got type {one['data_type']} of {one['n_data_per_node']})"
        )
    elif {len(one.get(f"r{i + 1}", ())) for i in range(one["n_data_per_node"])} != {len(one["node_nums"])}:
        found.append(f"must have {one['n_data_per_node']} values at each of its {len(one['node_nums'])} nodes")
    return found


def computed_uff(path: Path, sensors: Sensors, _deck: Path | None = None) -> Computed:
    """Read all modes in a file; see `fmu.formats.modes.measured_modes.ModesFormat`."""
    modes = read_uff(path, sensors=tuple(sensors) or None)
    return modes.frequencies_hz, modes.shapes if len(sensors) else None


def write_test_geometry(points: FloatArray) -> str:
    """Return measurement points as universal file text: dataset 15 with nodes, and 82 with a line through them.

    The points are numbered from 1. The text is written without pyuff, so that pyuff need not be installed.

    Parameters
    ----------
    points : ndarray, shape (n, 3), m
    """
    lines = ["    -1", f"{NODES[0]:6d}"]
    lines += [f"{k:10d}{0:10d}{0:10d}{11:10d}{x:13.5E}{y:13.5E}{z:13.5E}" for k, (x, y, z) in enumerate(points, 1)]
    lines += ["    -1", "    -1", f"{TRACE_LINES:6d}", f"{1:10d}{len(points):10d}{11:10d}", "sensors"]
    numbers = [f"{k:10d}" for k in range(1, len(points) + 1)]
    lines += ["".join(numbers[i : i + 8]) for i in range(0, len(numbers), 8)]
    return "\n".join([*lines, "    -1", ""])


FORMAT = ModesFormat(read_uff, "{job}.uff", computed_uff)
