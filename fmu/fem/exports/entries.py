"""Entries of exported matrices: how they change between exports, and how many digits they have."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from fmu.types import BoolArray, FloatArray, IntArray

ROUNDING = 1e-14
"""Relative rounding error of assembly in double precision."""
SAFETY = 10.0
MOST_SAMPLED = 1000
_FEWEST_DIGITS = 6


@dataclass(frozen=True, eq=False)
class Entries:
    """Entries on and above the diagonal that are present in at least one export, each divided by √(a_ii a_jj).

    Here a_ii is the largest absolute value of the diagonal entry of row i in all exports. If a_ii or a_jj is zero,
    the entry is divided by its own largest absolute value instead.
    """

    entry: FloatArray  # (n_exports, n)
    scale: FloatArray  # (n,)
    row: IntArray
    column: IntArray
    dofs: Sequence[tuple[Hashable, str]]
    digits: int

    @classmethod
    def of(cls, matrices: Sequence[sp.csr_array], dofs: Sequence[tuple[Hashable, str]]) -> Entries:
        """Collect the entries of several matrices with the same degrees of freedom, one matrix per export."""
        n = len(dofs)
        upper = [sp.coo_array(sp.triu(matrix)) for matrix in matrices]
        keys = [half.row.astype(np.int64) * n + half.col for half in upper]
        pattern = np.unique(np.concatenate(keys))
        entry = np.zeros((len(matrices), len(pattern)))
        for k, (half, key) in enumerate(zip(upper, keys, strict=True)):
            entry[k, np.searchsorted(pattern, key)] = half.data
        row, column = pattern // n, pattern % n
        root = np.sqrt(np.max([np.abs(matrix.diagonal()) for matrix in matrices], axis=0))
        scale = root[row] * root[column]
        scale = np.where(scale > 0, scale, np.maximum(np.abs(entry).max(axis=0), np.finfo(float).tiny))
        return cls(entry / scale, scale, row, column, dofs, _digits(entry))

    @property
    def noise(self) -> float:
        """Relative rounding error of an entry."""
        return max(ROUNDING, 0.5 * 10.0 ** (1 - self.digits))

    def changed_between(self, first: int, others: Sequence[int]) -> BoolArray:
        """Return a mask (n,) of the entries that change by more than rounding between two exports.

        One of them is export `first`, and the other is any export whose index is in `others`.
        """
        away = np.abs(self.entry[others] - self.entry[first])
        large = np.maximum(np.abs(self.entry[others]), np.abs(self.entry[first]))
        return np.asarray(np.any(away > SAFETY * np.maximum(self.noise * large, ROUNDING), axis=0))

    def place(self, at: int) -> str:
        """Return a phrase that names the degrees of freedom to which the entry with index `at` belongs.

        A diagonal entry belongs to one degree of freedom, any other entry to two.
        """
        row, column = (f"{node} {direction}" for node, direction in (self.dofs[i] for i in self._pair(at)))
        return f"node {row}" if row == column else f"node {row}, node {column}"

    def _pair(self, at: int) -> tuple[int, int]:
        return int(self.row[at]), int(self.column[at])

    def matrix(self, entry: FloatArray) -> sp.csr_array:
        """Return the symmetric matrix with these entries (n,), after undoing their scaling."""
        keep = entry != 0
        row, column, data = self.row[keep], self.column[keep], (entry * self.scale)[keep]
        off = row != column
        return sp.csr_array(
            (
                np.concatenate([data, data[off]]),
                (np.concatenate([row, column[off]]), np.concatenate([column, row[off]])),
            ),
            shape=(len(self.dofs),) * 2,
        )


def _digits(entry: FloatArray) -> int:
    """Return the smallest number of significant decimal digits that reproduces the numbers.

    At most 2000 of the numbers are examined. Return 17 if 15 digits do not reproduce them. No program writes
    matrices with fewer than `_FEWEST_DIGITS` digits. Numbers that need fewer are therefore taken as exact, with 17
    digits.
    """
    numbers = entry[entry != 0]
    numbers = numbers[:: max(len(numbers) // MOST_SAMPLED, 1)]
    for digits in range(3, 16):
        if all(float(f"{x:.{digits - 1}e}") == x for x in numbers.tolist()):
            return digits if digits >= _FEWEST_DIGITS else 17
    return 17
