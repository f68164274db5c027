"""What a slow function gave, so that it is not called again where it was called before."""

from __future__ import annotations

from typing import Any

from fmu.types import FloatArray

MOST_BYTES = 2**28
_OVERHEAD = 300  # bytes of an entry beside its numbers


class Memory:
    """Rows of numbers by theta, the latest; a copy in another process starts empty.

    Parameters
    ----------
    most_bytes : int
        Beyond which the oldest are forgotten.
    """

    def __init__(self, most_bytes: int = MOST_BYTES) -> None:
        self.most_bytes = most_bytes
        self._rows: dict[bytes, FloatArray] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return Memory, (self.most_bytes,)

    def __len__(self) -> int:
        return len(self._rows)

    def row(self, theta: FloatArray) -> FloatArray | None:
        """Return what is known at a theta (n_parameters,), None if nothing is."""
        return self._rows.get(theta.tobytes())

    def keep(self, theta: FloatArray, row: FloatArray) -> None:
        """Remember a row."""
        key = theta.tobytes()
        if len(self._rows) * (row.nbytes + len(key) + _OVERHEAD) >= self.most_bytes:
            del self._rows[next(iter(self._rows))]
        self._rows[key] = row
