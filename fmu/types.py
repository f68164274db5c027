"""Types for annotations: arrays by entry type, numbers in a range, chain-rule functions, and a log-density."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Annotated, Any, Literal, Protocol, get_args, runtime_checkable

import numpy as np
from annotated_types import Ge, Gt
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
StrArray = NDArray[np.str_]
AnyArray = NDArray[Any]

Positive = Annotated[float, Gt(0.0)]
NotNegative = Annotated[float, Ge(0.0)]
Vector = tuple[float, float, float]
"""The components x, y, z in global axes."""
Direction = Literal["x", "y", "z", "rx", "ry", "rz"]
"""The direction of a degree of freedom: a displacement along or a rotation about an axis."""
DIRECTIONS: tuple[str, ...] = get_args(Direction)
Dof = tuple[Hashable, str]
"""A degree of freedom or a sensor: its location (a node, or a name that is not a node) and its direction."""
type Plain = bool | int | float | str | Sequence[Plain] | Mapping[str, Plain] | None
"""Data of plain Python types, as in a JSON file."""


type Chain = Callable[[FloatArray, IntArray], FloatArray]
"""A function that applies the chain rule to derivatives of m quantities, each of which belongs to one test.

It takes derivatives with respect to the structural parameters in that test, (n, m, n_structural), and the index of
each quantity's test, (m,). It returns derivatives with respect to the parameters of all tests, shape
(n, m, n_parameters).
"""


@runtime_checkable
class LogDensity(Protocol):
    """An unnormalised log-density within bounds, evaluated in batches.

    Attributes
    ----------
    ndim : int
        Number of coordinates.
    lower, upper : ndarray, shape (ndim,)
        Bounds; ``-inf`` and ``inf`` where a coordinate is unbounded.

    Notes
    -----
    ``log_prob_and_grad`` is needed only for exact gradients. More attributes are used if they exist: ``offset``
    and ``scale``, shape (ndim,), a typical point and a typical width; ``start``, shape (ndim,), a point of finite
    density; ``sample_prior(rng, n)``, which returns prior draws, shape (n, ndim); ``names`` and ``units``, one
    text per coordinate; and ``solves_per_gradient``, the number of solves that a gradient takes. Without
    ``offset`` and ``scale``, a coordinate with two finite bounds is scaled by their distance, and any other is
    taken to be of order 1. A density of other widths without finite bounds, such as 2e11 ± 2e10 beside
    3e-9 ± 3e-10, needs them.
    """

    ndim: int
    lower: FloatArray
    upper: FloatArray

    def log_prob(self, theta: FloatArray) -> FloatArray:
        """Return the log-density: a float for theta of shape ``(ndim,)``, an array ``(n,)`` for ``(n, ndim)``.

        It is ``-inf`` outside the bounds.
        """
        ...

    def log_prob_and_grad(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the log-density and its gradient, both with the leading axes of `theta`."""
        ...
