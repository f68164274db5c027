"""Reader for matrices in HDF5 files, including MATLAB 7.3 files.

A matrix is a two-dimensional dataset, or a group with the arrays of a sparse matrix: ``data``, ``indices``,
``indptr`` and ``shape`` (CSR, or CSC if an attribute such as ``format`` says so); ``data``, ``row``, ``col`` and
``shape`` (COO); or MATLAB's ``data``, ``ir`` and ``jc``. ``shape`` may be a dataset or an attribute. If it is
missing, the indices determine the size.

A deliberately corrupted file can crash the HDF5 library and the process: read only files that you trust.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from fmu.formats.matrices.limits import (
    MOST_DOFS,
    MOST_NAMES,
    Labelled,
    MatrixFormat,
    RefusedError,
    choose_variable,
    entries_within,
    fitting,
)
from fmu.formats.shown import quote
from fmu.types import AnyArray

if TYPE_CHECKING:
    import h5py
    from numpy.typing import ArrayLike

    type _Member = h5py.Group | h5py.Dataset | h5py.Datatype

DEEPEST = 20
"""Largest depth of nested groups."""
_COMPRESSED, _COORDINATE = {"data", "indices", "indptr"}, {"data", "row", "col"}
_FORMAT = ("format", "encoding-type", "h5sparse_format")


def read(path: Path, variable: str | None) -> Labelled:
    """Read a matrix from an HDF5 file.

    Parameters
    ----------
    path : Path
    variable : str, optional
        Path to the matrix inside the file; not needed if the file has only one matrix.

    Raises
    ------
    RefusedError
        If the file has no such matrix, has several and `variable` is None, or the matrix is not numeric or too
        large.
    Exception
        Any error that h5py and SciPy raise on a broken file.
    """
    import h5py

    with h5py.File(path, "r") as file:
        found = {name: member for name, member in _members(file) if _is_matrix(member)}
        if "/" in found:
            found = {"/": file}
        member = found[choose_variable(list(found), variable)]
        if _is_group(member):
            return Labelled(_sparse(member))
        matrix = _numbers(member)
        return Labelled(matrix.T if "MATLAB_class" in member.attrs else matrix)


def _members(file: h5py.File) -> Iterator[tuple[str, _Member]]:
    """Yield the path and object of each group and dataset.

    Links, MATLAB's internal objects (``#…``) and components of sparse matrices are skipped. Raise RefusedError if
    there are too many members, or groups are nested too deeply.
    """
    ahead, seen = [("/", file)], {file["/"]}
    for _ in range(MOST_NAMES):
        if not ahead:
            return
        name, member = ahead.pop()
        yield name, member
        if not _is_group(member) or _is_sparse(member):
            continue
        if name.count("/") > DEEPEST:
            raise RefusedError(f"must not have groups more than {DEEPEST} deep")
        for key in islice(sorted(member, reverse=True), MOST_NAMES):
            path = f"{name.strip('/')}/{key}".strip("/")
            if path.startswith("#") or not _is_inside(member, key):
                continue
            if member[key] not in seen:
                seen.add(member[key])
                ahead.append((path, member[key]))
    if ahead:
        raise RefusedError(f"must hold at most {MOST_NAMES} groups and datasets")


def _is_group(member: _Member) -> bool:
    import h5py

    return isinstance(member, h5py.Group)


def _is_inside(group: h5py.Group, name: str) -> bool:
    """Return True if a member is stored in the file itself rather than behind a soft or external link."""
    import h5py

    return isinstance(group.get(name, getlink=True), h5py.HardLink)


def _is_dataset(member: _Member) -> bool:
    import h5py

    return isinstance(member, h5py.Dataset)


def _is_matrix(member: _Member) -> bool:
    return _is_sparse(member) if _is_group(member) else _is_dataset(member) and _is_dense(member)


def _is_sparse(group: h5py.Group) -> bool:
    names = set(group)
    return "MATLAB_sparse" in group.attrs or names >= _COMPRESSED or names >= _COORDINATE


def _is_dense(dataset: h5py.Dataset) -> bool:
    return dataset.ndim == 2 and dataset.dtype.kind in "fiubc" and max(dataset.shape) > 1


def _part(group: h5py.Group, name: str) -> AnyArray:
    """Return one component array of a sparse matrix.

    Raise RefusedError if it is a group, or a soft or external link, or if `_numbers` refuses it.
    """
    if not _is_inside(group, name) or not _is_dataset(group[name]):
        raise RefusedError(f"must have numbers in {group.name}/{name} (it is a group, or a link elsewhere)")
    return _numbers(group[name])


def _numbers(dataset: h5py.Dataset) -> AnyArray:
    """Read a dataset. Raise RefusedError unless it is numeric, stored in this file and not too large.

    Chunks are checked too, because each is read as a whole and may be larger than the dataset.
    """
    if dataset.dtype.kind not in "fiubc":
        raise RefusedError(f"must have numbers in {dataset.name} (got {dataset.dtype})")
    if dataset.external or dataset.is_virtual:
        raise RefusedError(f"must hold its numbers itself ({dataset.name} is kept in other files)")
    entries_within(dataset.size)
    fitting(dataset.nbytes)
    fitting(math.prod(dataset.chunks or ()) * dataset.dtype.itemsize)
    return np.asarray(dataset)


def _sparse(group: h5py.Group) -> sp.sparray:
    wanted = ("data", "shape", "ir", "jc", "row", "col", "indices", "indptr")
    arrays = {name: _part(group, name) for name in wanted if group.get(name, getlink=True) is not None}
    if "MATLAB_sparse" in group.attrs:
        if "jc" not in arrays:
            raise RefusedError(f"must have the pointers of a sparse matrix in {group.name}/jc")
        n_rows = _sizes(group.attrs["MATLAB_sparse"], 1)[0]
        data = arrays.get("data", np.zeros(0))
        return sp.csc_array((data, arrays.get("ir", np.zeros(0, int)), arrays["jc"]),
                            shape=(n_rows, len(arrays["jc"]) - 1))  # fmt: skip
    shape = arrays.get("shape", group.attrs.get("shape"))
    size = None if shape is None else _sizes(shape, 2)
    if "row" in arrays:
        return sp.coo_array((arrays["data"], (arrays["row"], arrays["col"])), shape=size)
    said = next((str(group.attrs[name]) for name in _FORMAT if name in group.attrs), "csr")
    kind = sp.csc_array if "csc" in said.lower() else sp.csr_array
    return kind((arrays["data"], arrays["indices"], arrays["indptr"]), shape=size)


def _sizes(given: ArrayLike, n: int) -> tuple[int, ...]:
    """Return `n` sizes, such as the row and column counts, as ints.

    Raise RefusedError if there are more or fewer than `n`, or one is not a number from 1 to `MOST_DOFS`.
    """
    sizes = np.ravel(given)
    if len(sizes) != n or sizes.dtype.kind not in "iuf" or not np.all((sizes >= 1) & (sizes <= MOST_DOFS)):
        raise RefusedError(f"must have a shape of {n} numbers from 1 to {MOST_DOFS} (got {quote(sizes.tolist())})")
    return tuple(int(size) for size in sizes)


FORMAT = MatrixFormat((".h5", ".hdf5"), read, has_names=True)
