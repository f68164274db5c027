"""Readers for matrices exported by finite-element programs and numerical software.

=====================  ===============================================================================
``.mtx``, ``.mtx.gz``  Matrix Market; or the text that Abaqus calls ``.mtx`` (`fmu.formats.matrices.abaqus`)
``.npz``, ``.npy``     `scipy.sparse.save_npz`, `numpy.savez`, `numpy.save`
``.mat``, ``.m``       MATLAB, sparse or full, including version 7.3 (HDF5); code, which is not executed
``.h5``, ``.hdf5``     HDF5: a dataset, or a group with a sparse matrix's arrays (`fmu.formats.matrices.hdf5`)
``.hb``, ``.rsa`` …    Harwell–Boeing, which Ansys writes with ``HBMAT`` (`fmu.formats.matrices.harwell_boeing`)
``.csv``               numbers separated by commas
``.full``              Ansys, with row names (`fmu.formats.matrices.ansys`)
``.op4``, ``.ou1`` …   Nastran and MYSTRAN, binary or text (`fmu.formats.matrices.nastran.op4`)
``.pch``, ``.dmig``,   Nastran's DMIG entries, with row names; also in the bulk data, ``.bdf``,
``.bdf`` …             ``.dat`` or ``.nas`` (`fmu.formats.matrices.nastran.dmig`)
``.sti``, ``.mas``     CalculiX, with row names in the ``.dof`` file (`fmu.formats.matrices.calculix`)
=====================  ===============================================================================

A full n × 3 array with n > 3 is taken for a sparse matrix if its first two columns are whole numbers from 1: row,
column and entry, as for MATLAB's ``spconvert``. If such a matrix, or a sparse matrix in an ``.m`` file, has
entries in only one triangle, the other triangle is filled in, and a note says so.

Nothing is unpickled, and the size of a file's content is checked before it is read. fmu has its own readers where
SciPy's readers crash the process on broken files (``.mat``, ``.mtx``). The library that reads Ansys files also
crashes on broken files, so it runs in a separate process. pyNastran is not used, because it needs an older NumPy
than this package.

A stiffness that is linear in a property p, such as Young's modulus, needs two exports. With K at p = a and p = b,
K(p) = K₀ + p K₁, where K₁ = (K(b) − K(a))/(b − a) and K₀ = K(a) − a K₁.
"""

from __future__ import annotations

import warnings
import zipfile
import zlib
from pathlib import Path
from typing import Literal

import numpy as np
import scipy.sparse as sp

from fmu.arguments import ArgumentError
from fmu.formats.advice import how_to_export
from fmu.formats.files import too_large, why_no_file
from fmu.formats.matrices import FORMATS
from fmu.formats.matrices.limits import (
    LARGEST_FILE,
    MOST_DOFS,
    Labelled,
    Matrix,
    MatrixFormat,
    NoMatrixError,
    RefusedError,
    check_indices,
    from_triplets,
)
from fmu.numbers import significant

Triangle = bool | Literal["lower", "upper"]

SYMMETRIC = 1e-9
"""Largest asymmetry of a pair of entries, relative to |a_ij| + |a_ji| or √(a_ii a_jj), whichever is larger."""
_CANCELLED = 1e-13
"""Asymmetry that rounding alone causes if large numbers cancel, relative to the largest diagonal entry."""
_FORMAT_OF: dict[str, MatrixFormat] = {suffix: form for form in FORMATS for suffix in form.suffixes}
ENTRIES_AT_A_TIME = 2**20


def read_matrix(path: Path, variable: str | None = None, triangle: Triangle = False) -> sp.csr_array:
    """Read a symmetric real matrix; see `read_labelled`.

    Parameters
    ----------
    path, variable, triangle :
        See `read_labelled`.

    Returns
    -------
    scipy.sparse.csr_array of float, shape (n_dof, n_dof)

    Raises
    ------
    ValueError
        See `read_labelled`.
    """
    return read_labelled(path, variable, triangle).matrix


def read_labelled(
    path: Path, variable: str | None = None, triangle: Triangle = False, *, fill: bool = False
) -> Labelled:
    """Read a symmetric real matrix with the names of its degrees of freedom, if the file has them.

    Parameters
    ----------
    path : Path
    variable : str, optional
        Name of the matrix in a file that can contain several; not needed if the file contains one matrix.
    triangle : bool or {"lower", "upper"}
        Whether the file has only one entry of each symmetric pair, so that the other entry is filled in. "lower"
        and "upper" also require that all off-diagonal entries are in that triangle.
    fill : bool
        Whether a matrix with entries in only one triangle is treated as symmetric.

    Returns
    -------
    Labelled

    Raises
    ------
    ValueError
        If the file does not exist, is too large, has an unknown format, or contains no real, finite, square and
        symmetric matrix; if it contains several matrices and `variable` is None, or no matrix named `variable`; if
        its entries contradict `triangle`; or if the library that reads it is not installed. The message begins
        with ``variable:`` or ``triangle:`` if that argument is at fault.
    """
    suffix = _suffix(path)
    advice = how_to_export(suffix)
    if suffix not in _FORMAT_OF and advice:
        raise ValueError(f"must hold a matrix (got {path.name!r}){advice}")
    if suffix not in _FORMAT_OF:
        raise ValueError(f"must end in {', '.join(_FORMAT_OF)} (got {path.name!r})")
    why = why_no_file(path)
    if why:
        raise ValueError(f"must be a file ({why})")
    excess = too_large(path, _FORMAT_OF[suffix].largest or LARGEST_FILE)
    if excess:
        raise ValueError(excess)
    if variable is not None and not _FORMAT_OF[suffix].has_names:
        raise ArgumentError("variable", f"a {suffix} file has one matrix, without a name", repr(variable))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # readers warn of content that is refused below, and of later versions
            found = _FORMAT_OF[suffix].read(path, variable)
            if _is_triplets(found.matrix):
                found = from_triplets(np.asarray(found.matrix, dtype=float), variable or path.name)
    except NoMatrixError as refused:
        raise ValueError(f"{refused}{advice}") from refused
    except RefusedError as refused:
        raise refused.record from refused
    except MemoryError:
        raise
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"must hold a matrix ({path.name}: {error})") from error
    except Exception as error:  # whatever else a broken file makes the readers raise
        raise ValueError(f"must hold a matrix ({path.name}: it is not as such a file has to be)") from error
    matrix = _real_square(found.matrix)
    above, below = _off_diagonal(matrix)
    alone = (fill or found.fill) and not (above and below)
    if alone and not triangle and above + below:
        half, other = ("lower", "upper") if below else ("upper", "lower")
        what = f"{variable} of {path.name}" if variable else path.name
        found = found._replace(notes=(f"{what} has only the {half} triangle: the {other} one is filled in.",))
    return found._replace(matrix=_symmetric(matrix, triangle or alone))


def symmetric_matrix(matrix: Matrix, triangle: Triangle = False) -> sp.csr_array:
    """Check that a matrix is real and symmetric, and return it as a csr_array of float.

    Parameters
    ----------
    matrix : ndarray or sparse array
    triangle : bool or {"lower", "upper"}
        See `read_labelled`.

    Raises
    ------
    ValueError
        If the matrix is not real, finite, square and symmetric, is too large, or has entries that contradict
        `triangle`.
    """
    return _symmetric(_real_square(matrix), triangle)


def _suffix(path: Path) -> str:
    name = path.name.lower()
    return ".mtx.gz" if name.endswith(".mtx.gz") else Path(name).suffix


def _is_triplets(matrix: Matrix) -> bool:
    """Return True if an array is a table (n, 3), n > 3, with row, column and value of each sparse-matrix entry."""
    if sp.issparse(matrix) or matrix.ndim != 2 or matrix.shape[1] != 3 or len(matrix) < 4:
        return False
    places = matrix[:, :2]
    return bool(matrix.dtype.kind in "fiu" and np.all(places == np.floor(places)) and np.all(places >= 1))


def _real_square(matrix: Matrix) -> sp.csr_array:
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or matrix.dtype.kind not in "fiub":
        raise ValueError(f"must hold a real square matrix (got {matrix.dtype} of shape {matrix.shape})")
    if not 1 <= matrix.shape[0] <= MOST_DOFS:
        raise ValueError(f"must have 1 to {MOST_DOFS} degrees of freedom (got {matrix.shape[0]})")
    if sp.issparse(matrix):
        try:
            check_indices(matrix)
        except ValueError as error:
            raise ValueError(f"must hold a matrix ({error})") from error
    square = sp.csr_array(matrix, dtype=float)
    square.sum_duplicates()
    if not np.all(np.isfinite(square.data)):
        raise ValueError("must be finite (there are entries that are not)")
    return square


def _symmetric(matrix: sp.csr_array, triangle: Triangle) -> sp.csr_array:
    if triangle:
        return _mirror_triangle(matrix, triangle)
    n = matrix.shape[0]
    transposed = sp.csr_array(matrix.T)
    root = np.sqrt(np.abs(matrix.diagonal()))
    # size of the rounding errors if large numbers cancel, as in Tᵀ K T with constraints
    rounding = _CANCELLED * float(np.max(root, initial=0.0)) ** 2
    step = max(ENTRIES_AT_A_TIME * n // max(matrix.nnz, 1), 1)
    for first in range(0, n, step):  # a block of rows at a time, to use at most twice the memory of the matrix
        here, there = matrix[first : first + step], transposed[first : first + step]
        difference = (here - there).tocoo()
        if not difference.nnz:
            continue
        row, column = difference.row, difference.col
        larger = np.abs((abs(here) + abs(there)).tocsr()[row, column])
        allowed = SYMMETRIC * np.maximum(root[first + row] * root[column], larger)
        excess = np.abs(difference.data) - np.maximum(allowed, rounding)
        at = int(np.argmax(excess))
        if excess[at] > 0.0:
            by = significant(abs(difference.data[at]))
            where = f"row {first + row[at] + 1}, column {column[at] + 1} differs by {by}"
            raise ValueError(f"must be symmetric ({where}){_triangle_alone(matrix)}")
    return matrix


def _triangle_alone(matrix: sp.csr_array) -> str:
    """Return advice for the user if a matrix has entries in only one triangle, otherwise an empty string."""
    above, below = _off_diagonal(matrix)
    if above and below:
        return ""
    half = "lower" if below else "upper"
    return f'; it holds only its {half} triangle: triangle = "{half}" fills in the other'


def _off_diagonal(matrix: sp.csr_array) -> tuple[int, int]:
    """Return the numbers of entries above and below the diagonal."""
    row = np.repeat(np.arange(matrix.shape[0], dtype=np.int32), np.diff(matrix.indptr))
    return int(np.sum(matrix.indices > row)), int(np.sum(matrix.indices < row))


def _mirror_triangle(matrix: sp.csr_array, triangle: Triangle) -> sp.csr_array:
    above, below = _off_diagonal(matrix)
    if (triangle == "lower" and above) or (triangle == "upper" and below):
        there = f"{above} above the diagonal, {below} below it"
        raise ArgumentError(
            "triangle", f"the file must have only its {triangle} triangle (it has entries: {there})"
        )
    diagonal = sp.diags_array(matrix.diagonal(), format="csr")
    half = sp.csr_array(matrix - diagonal)
    half.eliminate_zeros()
    if half.multiply(half.T).nnz:
        raise ArgumentError("triangle", "the file must have each pair of entries once (it has both of some)")
    return sp.csr_array(half + half.T + diagonal)
