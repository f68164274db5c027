"""The mass matrix of Hamiltonian Monte Carlo."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from fmu.samplers.loop.settings import cholesky_factor, fits
from fmu.types import FloatArray, IntArray


class Metric:
    """Kinetic energy W(p) = pᵀ M⁻¹ p / 2, with momenta p ~ N(0, M).

    The best inverse mass is the covariance of the target: the sampler is then blind to its correlations.

    Parameters
    ----------
    inverse_mass : None, vector (ndim,) or matrix (ndim, ndim)
        M⁻¹; the identity if None, a diagonal matrix if a vector.
    ndim : int

    Attributes
    ----------
    inverse : ndarray, shape (ndim, ndim)
        M⁻¹.

    Raises
    ------
    ValueError
        If `inverse_mass` has the wrong length or is not symmetric positive definite.
    """

    def __init__(self, inverse_mass: Any, ndim: int) -> None:
        array = np.ones(ndim) if inverse_mass is None else fits("inverse_mass", inverse_mass, ndim)
        self.inverse: FloatArray = array if array.ndim == 2 else np.diag(np.broadcast_to(array, ndim))
        # M = L⁻ᵀ L⁻¹ with M⁻¹ = L Lᵀ, so that p = L⁻ᵀ z has covariance M.
        self._inverse_factor = np.linalg.inv(cholesky_factor("inverse_mass", self.inverse))

    def sample_momentum(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw `n` momenta from N(0, M), shape (n, ndim)."""
        z = rng.standard_normal((n, len(self.inverse)))
        return z @ self._inverse_factor

    def of_chains(self, chain: IntArray) -> Metric:
        """Return the metric of some chains: one serves all."""
        return self

    def velocity(self, momentum: FloatArray) -> FloatArray:
        """Return v = M⁻¹ p, shape (n, ndim)."""
        return momentum @ self.inverse

    def column(self, chain: IntArray, i: IntArray) -> FloatArray:
        """Return column i of M⁻¹, shape (n, ndim), for each of the chains."""
        return self.inverse[i]

    def kinetic(self, momentum: FloatArray) -> FloatArray:
        """Return pᵀ M⁻¹ p / 2, shape (n,)."""
        return 0.5 * np.sum(momentum * self.velocity(momentum), axis=-1)


class MetricOfChains(Metric):
    """A mass matrix of every chain's own.

    Parameters
    ----------
    metrics : sequence of Metric
    each : int
        How many chains in a row share a metric.
    """

    def __init__(self, metrics: Sequence[Metric], each: int = 1) -> None:
        self.inverse = np.repeat([metric.inverse for metric in metrics], each, axis=0)
        self._inverse_factor = np.repeat([metric._inverse_factor for metric in metrics], each, axis=0)

    def sample_momentum(self, rng: np.random.Generator, n: int) -> FloatArray:
        """Draw one momentum a chain, shape (n, ndim)."""
        z = rng.standard_normal((n, self.inverse.shape[1]))
        return np.einsum("ni,nij->nj", z, self._inverse_factor)

    def of_chains(self, chain: IntArray) -> MetricOfChains:
        """Return the metrics of some chains."""
        some = object.__new__(MetricOfChains)
        some.inverse, some._inverse_factor = self.inverse[chain], self._inverse_factor[chain]
        return some

    def velocity(self, momentum: FloatArray) -> FloatArray:
        """Return v = M⁻¹ p, shape (n, ndim)."""
        return np.einsum("ni,nij->nj", momentum, self.inverse)

    def column(self, chain: IntArray, i: IntArray) -> FloatArray:
        """Return column i of M⁻¹, shape (n, ndim), of each chain's own."""
        return self.inverse[chain, i]
