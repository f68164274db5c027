"""Types that annotations share: arrays by the kind of their entries, and a log-density."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
StrArray = NDArray[np.str_]


@runtime_checkable
class LogDensity(Protocol):
    """An unnormalised log-density on a box, evaluated in batches.

    Attributes
    ----------
    ndim : int
        Number of coordinates.
    lower, upper : ndarray, shape (ndim,)
        The box; ``-inf`` and ``inf`` where a coordinate is unbounded.
    """

    ndim: int
    lower: FloatArray
    upper: FloatArray

    def log_prob(self, theta: Any) -> Any:
        """Map ``(ndim,)`` to a float and ``(n, ndim)`` to ``(n,)``; ``-inf`` outside the box."""
        ...

    def log_prob_and_grad(self, theta: Any) -> tuple[Any, Any]:
        """Return the log-density and its gradient, with the same leading shape as `theta`."""
        ...
