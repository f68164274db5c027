"""Linear maps of mode shapes, as objects that travel to other processes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fmu.types import FloatArray


@dataclass(frozen=True, eq=False)
class Picked:
    """Takes shapes (n, size, m) to some of their degrees of freedom, (n, q, m).

    Attributes
    ----------
    dofs : ndarray of int, shape (q,)
    """

    dofs: NDArray[np.int64]

    def __call__(self, phi: FloatArray) -> FloatArray:
        """Return the shapes there."""
        return phi[:, self.dofs]


@dataclass(frozen=True, eq=False)
class Mapped:
    """Takes shapes (n, size, m) to the coordinates of a matrix's rows, (n, q, m).

    Attributes
    ----------
    matrix : ndarray, shape (q, size)
    """

    matrix: FloatArray

    def __call__(self, phi: FloatArray) -> FloatArray:
        """Return the shapes there."""
        return self.matrix @ phi
