"""``[model] type = "matrices"``: stiffness and mass terms from files, as finite-element programs export them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import scipy.sparse as sp
from pydantic import Field

from fmu.config.fields import Name, SensorTable, Table
from fmu.config.mistakes import BrokenError, Mistake, got
from fmu.config.model import Built
from fmu.fem.separable import SeparableModel, Term

if TYPE_CHECKING:
    from fmu.config.parameters import ParameterTable

LARGEST_FILE = 2**30
"""Bytes; a file beyond it is refused before it is read."""
READABLE = (".mtx", ".npz")


class TermTable(Table):
    """One matrix, in SI units, times the product of parameters to their powers."""

    file: Name
    factor: float = 1.0
    powers: dict[Name, float] = {}


class MatricesTable(Table):
    """K(theta) and M(theta) as sums of matrices."""

    type: Literal["matrices"]
    stiffness: Annotated[list[TermTable], Field(min_length=1)]
    mass: Annotated[list[TermTable], Field(min_length=1)]
    dofs: list[SensorTable] | None = None

    def mistakes(self, parameters: Sequence[ParameterTable]) -> list[Mistake]:
        """Return the powers of parameters that do not exist, and the parameters that no term has."""
        names = [parameter.name for parameter in parameters]
        found, used = [], set()
        for key in ("stiffness", "mass"):
            for i, term in enumerate(getattr(self, key)):
                used |= set(term.powers)
                found += [
                    Mistake(f"model.{key}.{i}.powers", got(f"must name one of {', '.join(names)}", name))
                    for name in term.powers
                    if name not in names
                ]
        found += [
            Mistake(f"parameters.{i}.name", got("must be in the powers of a term", name))
            for i, name in enumerate(names)
            if name not in used
        ]
        return found

    def build(self, folder: Path, parameters: Sequence[ParameterTable]) -> Built:
        """Read the matrices beside the file and return the model; BrokenError with what is wrong with them."""
        terms: dict[str, list[Term]] = {}
        found: list[Mistake] = []
        for key in ("stiffness", "mass"):
            terms[key] = []
            for i, table in enumerate(getattr(self, key)):
                try:
                    matrix = read_matrix(folder / table.file) * table.factor
                except ValueError as error:
                    found.append(Mistake(f"model.{key}.{i}.file", str(error)))
                    continue
                terms[key].append(Term(matrix, tuple(table.powers.get(p.name, 0.0) for p in parameters)))
        if found:
            raise BrokenError(found)
        dofs = None if self.dofs is None else [(node, str(direction)) for node, direction in self.dofs]
        try:
            return Built(SeparableModel(terms["stiffness"], terms["mass"], dofs), {})
        except ValueError as error:
            words = str(error).replace("K_terms", "stiffness").replace("M_terms", "mass")
            raise BrokenError([Mistake("model", words)]) from error


def read_matrix(path: Path) -> Any:
    """Read a real matrix: Matrix Market (``.mtx``) or scipy.sparse (``.npz``).

    Raises
    ------
    ValueError
        If the file does not exist, is too large, of another kind, or holds no real square matrix.
    """
    if path.suffix not in READABLE:
        raise ValueError(got(f"must end in {' or '.join(READABLE)}", path.name))
    if not path.is_file():
        raise ValueError(got("must be a file", str(path)))
    if path.stat().st_size > LARGEST_FILE:
        raise ValueError(f"must have at most {LARGEST_FILE} bytes (got {path.stat().st_size})")
    try:
        matrix = _read(path)
    except Exception as error:  # whatever a broken file makes the readers raise
        raise ValueError(f"must hold a matrix ({path.name}: {error})") from error
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or np.iscomplexobj(matrix):
        raise ValueError(f"must hold a real square matrix (got {matrix.dtype} of shape {matrix.shape})")
    return sp.csr_array(matrix.astype(float))


def _read(path: Path) -> Any:
    if path.suffix == ".mtx":
        from scipy.io import mmread

        return mmread(path, spmatrix=False)
    return sp.load_npz(path)
