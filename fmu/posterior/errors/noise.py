"""Standard deviations of errors: known, inferred with the parameters, or both."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Gt
from numpy.typing import ArrayLike

from fmu.arguments import ArgumentError, Numbers, require
from fmu.numbers import typed
from fmu.posterior.parameters import Parameter
from fmu.types import FloatArray, IntArray, Plain

NoiseIndex = Callable[[Parameter], int]
"""Returns the number of an inferred standard deviation among those of the problem."""


def numbering(noise: list[Parameter]) -> NoiseIndex:
    """Return a function that numbers parameters in the order in which they are met, and keeps them in `noise`."""

    def index(parameter: Parameter) -> int:
        if parameter not in noise:
            if parameter.name in (p.name for p in noise):
                raise ValueError(f"error: different parameters must not share a name (got {parameter.name!r})")
            noise.append(parameter)
        return noise.index(parameter)

    return index


@dataclass(frozen=True, eq=False)
class Spread:
    """Variances V = fixed² + Σ_k (noise_k · size_k)² of sums of independent errors.

    Attributes
    ----------
    fixed : ndarray, any shape
        Known standard deviations.
    sizes : mapping of int to ndarray of the same shape
        Factor of the inferred standard deviation number k.
    """

    fixed: FloatArray
    sizes: Mapping[int, FloatArray]

    def variance(self, noise: FloatArray) -> FloatArray:
        """Return V, shape (n, *shape), for inferred standard deviations (n, n_noise)."""
        value = np.broadcast_to(self.fixed**2, (len(noise), *self.fixed.shape))
        for k, size in self.sizes.items():
            value = value + (_column(noise, k, size.ndim) * size) ** 2
        return np.asarray(value)

    def slopes(self, noise: FloatArray) -> dict[int, FloatArray]:
        """Return ∂V/∂noise_k, shape (n, *shape), for each inferred one."""
        return {k: 2.0 * _column(noise, k, size.ndim) * size**2 for k, size in self.sizes.items()}

    def information(self, noise: FloatArray, used: IntArray | None = None) -> FloatArray:
        """Return Σ ½ ∂V/∂noise_k ∂V/∂noise_l / V², Fisher's for Gaussian errors, shape (n, n_noise, n_noise).

        The sum is over all errors, or those of the `used` modes, the last axis.
        """
        n, n_noise = noise.shape
        V = self.variance(noise)
        counted = slice(None) if used is None else used
        relative = {k: (dV / V)[..., counted].reshape(n, -1) for k, dV in self.slopes(noise).items()}
        found = np.zeros((n, n_noise, n_noise))
        for k, one in relative.items():
            for m, other in relative.items():
                found[:, k, m] = 0.5 * np.sum(one * other, axis=1)
        return found

    def as_dict(self) -> dict[str, Plain]:
        """Return the numbers in plain Python types."""
        return {
            "fixed": self.fixed.tolist(),
            "inferred": {str(k): size.tolist() for k, size in self.sizes.items()},
        }


def spread(
    name: str,
    sd: ArrayLike | Parameter | None,
    discrepancy: Parameter | None,
    size: FloatArray,
    index: NoiseIndex,
) -> Spread:
    """Return the spread of the errors of one error model.

    Parameters
    ----------
    name : str
        Name of the errors, for messages.
    sd : float, array_like or Parameter or None
        Standard deviations in units of `size`: known, inferred (one for all), or None if only the discrepancy
        counts.
    discrepancy : Parameter, optional
        A further standard deviation to be inferred, in units of `size`.
    size : ndarray
        Size of one unit for each error.
    index : NoiseIndex

    Raises
    ------
    ValueError
        If a standard deviation is not positive and finite, has another shape than the errors, can be negative, or
        is missing.
    """
    inferred = [p for p in (sd, discrepancy) if isinstance(p, Parameter)]
    for parameter in inferred:
        if parameter.lower < 0:
            raise ArgumentError(
                name,
                f"{parameter.name} must have a lower bound of at least 0, as a standard deviation",
                typed(parameter.lower),
            )
    fixed = np.zeros(size.shape)
    if sd is not None and not isinstance(sd, Parameter):
        given = np.asarray(sd, dtype=float)
        if not np.all(np.isfinite(given) & (given > 0)):
            raise ArgumentError(name, "sd must be positive and finite", given.tolist())
        try:
            fixed = np.broadcast_to(given, size.shape) * size
        except ValueError:
            raise ArgumentError(name, f"sd must be a number or of shape {size.shape}", given.shape) from None
    elif not inferred:
        raise ArgumentError(name, "needs sd, a number or a Parameter, as the data have none", "None")
    sizes: dict[int, FloatArray] = {}
    for parameter in inferred:
        sizes[index(parameter)] = size
    return Spread(fixed, sizes)


def require_sizes(sd: ArrayLike | Parameter | None, weights: ArrayLike | None) -> None:
    """Raise ValueError unless deviations and weights that are given as numbers are positive and finite."""
    for name, value in (("sd", sd), ("weights", weights)):
        if value is not None and not isinstance(value, Parameter):
            require(name, value, Annotated[Numbers, Gt(0.0)])


def _column(noise: FloatArray, k: int, ndim: int) -> FloatArray:
    return noise[:, k].reshape(-1, *(1,) * ndim)
