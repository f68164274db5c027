"""Reader for frequency response functions stored as arrays: NumPy ``.npz``, MATLAB ``.mat`` and HDF5 files.

Each array has the name of an attribute of `fmu.FRFData`, or another common name in `NAMES`. Other names are given
by ``variables``, such as ``{"values": "test.H"}`` for the field H of a MATLAB structure. A matrix of FRFs has the
shape (n_frfs, n_lines) or (n_lines, n_frfs), whichever fits the number of lines; a square one is taken as
(n_lines, n_frfs) in ``.mat`` files, and otherwise as (n_frfs, n_lines). An array (n_lines, n_responses, n_drives),
as returned by MATLAB's ``modalfrf``, contains an FRF for every pair of a response and a drive; an axis of length 1
may be missing. Points may be listed as n_responses responses and n_drives drives, instead of a response and a
drive for each FRF. Points are rows of text, such as ``"tip z"``, or two columns of text with places and
directions. Nothing is unpickled.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fmu.formats.frf.measured_frfs import (
    FRFFormat,
    MeasuredFRFs,
    Points,
    Wanted,
    check_size,
    point_of,
    points_in_order,
)
from fmu.formats.matrices.isolated import read_isolated
from fmu.formats.matrices.limits import LARGEST_CONTENT, LARGEST_FILE, MOST_NAMES, RefusedError
from fmu.formats.matrices.numpy_files import shapes_in_archive
from fmu.formats.modes.measured_modes import ModesError, checked_file
from fmu.formats.shown import in_words, names_shown, quote
from fmu.types import AnyArray, Dof, FloatArray

if TYPE_CHECKING:
    import h5py

NAMES = {
    "frequencies_hz": ("frequencies_hz", "frequency_hz", "frequencies", "frequency", "freq", "f"),
    "values": ("values", "FRF", "frf", "H"),
    "coherence": ("coherence", "coh", "gamma2"),
    "sd": ("sd",),
    "averages": ("averages", "n_averages"),
    "kind": ("kind",),
    "drives": ("drives",),
    "responses": ("responses",),
}
"""Names that an array may have in a file, by `fmu.FRFData` attribute."""
_HDF5 = (b"MATLAB 7.3", b"\x89HDF")


def read_npz(path: Path, wanted: Wanted) -> MeasuredFRFs:
    """Return the FRFs in an ``.npz`` file; see `of_arrays`.

    Raise FileNotFoundError if there is no such file, and ModesError if it is broken or too large.
    """
    checked_file(path, LARGEST_FILE)
    try:
        shapes_in_archive(path)
        with np.load(path, allow_pickle=False) as content:
            arrays = {name: content[name] for name in content.files}
    except MemoryError:
        raise
    except Exception as error:  # whatever else a broken file makes NumPy raise
        raise ModesError(path.name, [f"must be an .npz file of numbers and text ({in_words(error)})"]) from error
    return of_arrays(path.name, arrays, wanted, lines_first=False)


def read_mat(path: Path, wanted: Wanted) -> MeasuredFRFs:
    """Return the FRFs in a MATLAB or HDF5 file; see `of_arrays`.

    The file is read in a separate process, because the reader may crash. Raise FileNotFoundError if there is no
    such file, and ModesError if it is broken or too large, or the reader is not installed.
    """
    checked_file(path, LARGEST_FILE)
    with open(path, "rb") as file:
        is_hdf5 = file.read(10).startswith(_HDF5)
    reader, library = ("hdf5_arrays", "h5py") if is_hdf5 else ("mat_arrays", "scipy")
    try:
        arrays = read_isolated(f"{__name__}:{reader}", path, library, "")
    except RefusedError as error:
        raise ModesError(path.name, [str(error)]) from error
    return of_arrays(path.name, arrays, wanted, lines_first=path.suffix.lower() == ".mat")


def of_arrays(name: str, arrays: Mapping[str, AnyArray], wanted: Wanted, lines_first: bool) -> MeasuredFRFs:
    """Build `MeasuredFRFs` from arrays that were read from a file.

    Parameters
    ----------
    name : str
        Name of the file, for messages.
    arrays : mapping of str to ndarray
        The arrays, keyed by their names in the file.
    wanted : Wanted
    lines_first : bool
        Whether frequency lines run along the first axis if the FRF matrix is square.

    Raises
    ------
    ModesError
        If there are no frequencies or FRFs, if arrays are not numeric, are too large or do not have matching
        shapes, if `wanted` names an unknown array or FRF, or if the points are neither in the file nor given, or
        their number is wrong.
    """
    unknown = sorted(set(wanted.variables or ()) - set(NAMES))
    if unknown:
        raise ModesError(name, [f"variables: must be of {names_shown(NAMES)} (got {quote(unknown[0])})"])
    found = {attribute: _find(name, arrays, attribute, wanted.variables) for attribute in NAMES}
    for attribute in ("frequencies_hz", "values"):
        if found[attribute] is None:
            rule = f"must name the array of {attribute}, none of {names_shown(NAMES[attribute])} is there"
            raise ModesError(name, [f"variables: {rule} (the file has {names_shown(list(arrays))})"])
    lines = np.ravel(_numbers(name, "frequencies_hz", found["frequencies_hz"]).real)
    values = _numbers(name, "values", found["values"])
    check_size(name, values)
    table = _rows(name, "values", values, len(lines), lines_first)

    def real_rows(key: str) -> FloatArray | None:
        array = found[key]
        if array is None:
            return None
        rows = _rows(name, key, _numbers(name, key, array).real, len(lines), lines_first)
        if len(rows) != len(table):
            raise ModesError(name, [f"{key}: must have {len(table)} rows, one per FRF (got {len(rows)})"])
        return rows

    for key in ("kind", "averages"):
        array = found[key]
        if array is not None and array.size == 0:
            raise ModesError(name, [f"{key}: must have a value (the array is empty)"])
    averages = found["averages"]
    responses, drives = (
        _points(found[key]) if given is None else given
        for key, given in (("responses", wanted.responses), ("drives", wanted.drives))
    )
    if responses and drives and len(responses) * len(drives) == len(table):
        responses, drives = zip(*product(responses, drives), strict=True)
    return MeasuredFRFs(
        lines,
        table,
        points_in_order(name, "drives", drives, None, len(table)),
        points_in_order(name, "responses", responses, None, len(table)),
        None if found["kind"] is None else str(np.ravel(found["kind"])[0]),
        real_rows("sd"),
        real_rows("coherence"),
        None if averages is None else float(np.ravel(_numbers(name, "averages", averages))[0].real),
    ).only(name, wanted.frfs)


def mat_arrays(path: Path) -> dict[str, AnyArray]:
    """Read all numeric and text arrays in a MATLAB file of version 4 to 7, with SciPy.

    A structure's field is named ``structure.field``.
    """
    from scipy.io import loadmat

    content = loadmat(path, struct_as_record=False, squeeze_me=True)
    return dict(_flat("", {name: value for name, value in content.items() if not name.startswith("__")}))


def _flat(prefix: str, content: Mapping[str, Any]) -> Iterator[tuple[str, AnyArray]]:
    """Yield the name and value of each numeric or text array, including the arrays inside structures."""
    for name, value in content.items():
        array = np.asarray(value)
        fields = getattr(value, "_fieldnames", None)
        if fields is not None:
            yield from _flat(f"{prefix}{name}.", {field: getattr(value, field) for field in fields})
        elif array.dtype.kind in "iufcbU":
            yield f"{prefix}{name}", array
        elif array.dtype.kind == "O" and all(isinstance(one, str) for one in array.flat):  # a cell array of text
            yield f"{prefix}{name}", array.astype(str)


def hdf5_arrays(path: Path) -> dict[str, AnyArray]:
    """Read all numeric and text arrays in an HDF5 file, such as a MATLAB 7.3 file.

    A dataset in a group is named ``group.dataset``. MATLAB stores arrays with their axes reversed, and complex
    numbers as pairs; both are converted. Datasets whose numbers are in other files are left out. Raise
    ValueError if there are too many arrays, or one is too large.
    """
    import h5py

    found: dict[str, AnyArray] = {}

    def keep(name: str, member: h5py.Group | h5py.Dataset) -> None:
        if len(found) > MOST_NAMES:
            raise ValueError(f"must hold at most {MOST_NAMES} arrays")
        is_dataset = isinstance(member, h5py.Dataset) and not name.startswith("#")
        if is_dataset and not member.external and not member.is_virtual:
            array = _hdf5_array(member)
            if array is not None:
                found[name.replace("/", ".")] = array

    with h5py.File(path, "r") as file:
        file.visititems(keep)
    return found


def _hdf5_array(dataset: h5py.Dataset) -> AnyArray | None:
    """Return the numbers or text in a dataset, or None if it contains neither.

    The axes are reversed if MATLAB wrote the dataset. Raise ValueError if it is larger than `LARGEST_CONTENT`.
    """
    import h5py

    if dataset.nbytes > LARGEST_CONTENT:
        raise ValueError(f"must hold at most {LARGEST_CONTENT} bytes (got {dataset.nbytes})")
    if dataset.dtype.kind == "O":
        is_text = h5py.check_string_dtype(dataset.dtype) is not None
        return np.asarray(dataset.asstr()[()]).astype(str) if is_text else None
    array = np.asarray(dataset[()])
    if array.dtype.names == ("real", "imag"):
        array = array["real"] + 1j * array["imag"]
    kind = dataset.attrs.get("MATLAB_class", b"")
    if kind == b"char":
        if array.ndim > 2:
            return None
        lines = ["".join(map(chr, row)).rstrip() for row in np.atleast_2d(array.T).tolist()]
        return np.asarray(lines[0] if len(lines) == 1 else lines)
    if array.dtype.kind == "S":
        array = np.char.decode(array, "utf-8")
    return (array.T if kind else array) if array.dtype.kind in "iufcbU" else None


def _find(
    name: str, arrays: Mapping[str, AnyArray], attribute: str, variables: Mapping[str, str]
) -> AnyArray | None:
    """Return the array for an attribute of `fmu.FRFData`, or None if the file does not have it.

    Raise ModesError if the user gave the name of an array that is missing.
    """
    if attribute in variables:
        if variables[attribute] not in arrays:
            rule = f"must be one of {names_shown(list(arrays))} (got {variables[attribute]!r})"
            raise ModesError(name, [f"variables.{attribute}: {rule}"])
        return arrays[variables[attribute]]
    return next((arrays[one] for one in NAMES[attribute] if one in arrays), None)


def _numbers(name: str, attribute: str, array: AnyArray | None) -> AnyArray:
    if array is None or array.dtype.kind not in "iufc":
        raise ModesError(name, [f"{attribute}: must be numbers (got {getattr(array, 'dtype', None)})"])
    return array


def _rows(name: str, attribute: str, array: AnyArray, n_lines: int, lines_first: bool) -> AnyArray:
    """Return an array of FRFs rearranged to one row per FRF, shape (n_frfs, n_lines).

    An array with one axis is a single FRF. Raise ModesError if neither the first nor the last axis has `n_lines`
    entries, or there are more than three axes.
    """
    if array.ndim < 2:
        array = array.reshape(1, -1)
    axes = [axis for axis in (0, array.ndim - 1) if array.shape[axis] == n_lines]
    if array.ndim > 3 or not axes:
        rule = f"must have shape (n_frfs, {n_lines}) or ({n_lines}, n_frfs), or three axes with the lines first"
        raise ModesError(name, [f"{attribute}: {rule} (got {array.shape})"])
    axis = 0 if len(axes) > 1 and (lines_first or array.ndim == 3) else axes[-1]
    return np.ascontiguousarray(np.moveaxis(array, axis, -1).reshape(-1, n_lines))


def _points(array: AnyArray | None) -> Points | None:
    """Return points from text rows "place direction", or from two columns with places and directions.

    Return None if there is no array, or it is not text.
    """
    if array is None or array.dtype.kind != "U":
        return None
    rows = array.reshape(-1, array.shape[-1]) if array.ndim == 2 else np.ravel(array)[:, None]
    found: list[Dof] = [point_of(" ".join(row)) for row in rows.tolist()]
    return found


FORMATS = (
    FRFFormat((".npz",), read_npz, ("variables",)),
    FRFFormat((".mat", ".h5", ".hdf5"), read_mat, ("variables",)),
)
