"""Standard deviations of errors: known, inferred together with the parameters, or a combination of both."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from annotated_types import Gt
from numpy.typing import ArrayLike

from fmu.arguments import ArgumentError, Numbers, require
from fmu.numbers import typed
from fmu.posterior.parameters import Parameter, parameter_in
from fmu.types import FloatArray, IntArray, Plain

NoiseIndex = Callable[[Parameter], int]
"""A function that returns the index of an inferred error parameter among all inferred error parameters."""

OLD_NAMES = {"discrepancy": "model_sd"}
"""Current names of renamed error model arguments, keyed by old name."""


def numbering(noise: list[Parameter]) -> NoiseIndex:
    """Return a function that returns a parameter's index in `noise`, after appending it if it is missing.

    The function raises ValueError if a different parameter in `noise` has the same name.
    """

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
        Known standard deviations; 0 if all are inferred.
    sizes : mapping of int to ndarray of the same shape
        The factors size_k, one per error, by which the inferred standard deviation noise_k is multiplied, keyed by
        k.
    """

    fixed: FloatArray
    sizes: Mapping[int, FloatArray]

    def variance(self, noise: FloatArray) -> FloatArray:
        """Return the variances V, shape (n, *shape), for inferred standard deviations `noise` (n, n_noise)."""
        value = self._known
        if not self.sizes:  # at a single theta, broadcasting would take longer than all the rest
            return value if len(noise) == 1 else np.broadcast_to(value, (len(noise), *self.fixed.shape))
        for k, size in self.sizes.items():
            value = value + (_column(noise, k, size.ndim) * size) ** 2
        return value

    def inverse_sd(self, noise: FloatArray) -> FloatArray:
        """Return 1/√V, shape (n, *shape), or (1, *shape) if no standard deviation is inferred."""
        return 1.0 / np.sqrt(self.variance(noise)) if self.sizes else self._known_inverse

    @cached_property
    def _known_inverse(self) -> FloatArray:
        return np.asarray(1.0 / np.sqrt(self._known))

    @cached_property
    def _known(self) -> FloatArray:
        """The known part of the variances, shape (1, *shape)."""
        found = np.asarray(self.fixed**2)[None]
        found.setflags(write=False)
        return found

    def slopes(self, noise: FloatArray) -> dict[int, FloatArray]:
        """Return ∂V/∂noise_k, shape (n, *shape), keyed by the index k of each inferred standard deviation."""
        return {k: 2.0 * _column(noise, k, size.ndim) * size**2 for k, size in self.sizes.items()}

    def information(self, noise: FloatArray, used: IntArray | None = None) -> FloatArray:
        """Return the Fisher information on the inferred standard deviations, shape (n, n_noise, n_noise).

        For Gaussian errors it is Σ ½ ∂V/∂noise_k ∂V/∂noise_l / V². The sum is over all errors or, if `used` is
        given, over the errors of these modes. `used` are indices into the last axis.
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
        """Return the known standard deviations and the factors as a dict of plain Python types."""
        return {
            "fixed": self.fixed.tolist(),
            "inferred": {str(k): size.tolist() for k, size in self.sizes.items()},
        }


def spread(
    name: str,
    sd: ArrayLike | Parameter | None,
    model_sd: Parameter | None,
    size: FloatArray,
    index: NoiseIndex,
) -> Spread:
    """Return one error model's variances as a `Spread`.

    Parameters
    ----------
    name : str
        Name of the errors, for messages.
    sd : float, array_like or Parameter or None
        Standard deviations in units of `size`: known, inferred (one value for all errors), or None if
        `model_sd` is the only error.
    model_sd : Parameter, optional
        A further standard deviation to be inferred, in units of `size`.
    size : ndarray
        Factor for each error, by which the standard deviations are multiplied.
    index : NoiseIndex

    Raises
    ------
    ValueError
        If a known standard deviation is not positive and finite or cannot be broadcast to the shape of `size`, an
        inferred standard deviation has a negative lower bound or the name of another parameter, or neither `sd`
        nor `model_sd` is given.
    """
    inferred = [p for p in map(parameter_in, (sd, model_sd)) if p is not None]
    for parameter in inferred:
        if parameter.lower < 0:
            raise ArgumentError(
                name,
                f"{parameter.name} must have a lower bound of at least 0, as a standard deviation",
                typed(parameter.lower),
            )
    fixed = np.zeros(size.shape)
    if sd is not None and parameter_in(sd) is None:
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
        sizes[index(parameter)] = np.hypot(sizes.get(index(parameter), 0.0), size)  # both may be the same
    return Spread(fixed, sizes)


def require_sizes(sd: ArrayLike | Parameter | None, weights: ArrayLike | None) -> None:
    """Raise ValueError unless all known numbers in `sd` and `weights`, if any, are positive and finite."""
    for name, value in (("sd", sd), ("weights", weights)):
        if value is not None and parameter_in(value) is None:
            require(name, value, Annotated[Numbers, Gt(0.0)])


def _column(noise: FloatArray, k: int, ndim: int) -> FloatArray:
    return noise[:, k].reshape(-1, *(1,) * ndim)


def checked_beta(beta: ArrayLike, n_modes: int) -> FloatArray:
    """Return the trust β in each mode's data, shape (n_modes,).

    Raise ValueError if `beta` is not positive and finite, or is neither one number nor one per mode.
    """
    array = np.array(beta, dtype=float)
    if array.ndim > 1 or (array.ndim == 1 and len(array) != n_modes):
        raise ArgumentError("beta", f"must be a number or {n_modes} numbers", f"shape {array.shape}")
    if not np.all(np.isfinite(array) & (array > 0)):
        raise ArgumentError("beta", "must be positive and finite", array.tolist())
    return np.broadcast_to(array, n_modes).copy()
