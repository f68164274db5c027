"""One kernel for many replicas out of one kernel a rung, so that they advance as one array."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fmu.samplers.hmc.gradient import ExactGradient
from fmu.samplers.hmc.hmc import HamiltonianKernel
from fmu.samplers.hmc.metric import MetricOfChains
from fmu.samplers.kernel import Kernel
from fmu.samplers.metropolis import MetropolisKernel, Search
from fmu.samplers.proposals import RandomWalk
from fmu.samplers.slice import SliceKernel
from fmu.types import FloatArray, LogDensity


@dataclass(frozen=True)
class RandomWalks:
    """Gaussian random walks, the covariance of each chain its own: L Lᵀ with L (chains, ndim, ndim)."""

    factor: FloatArray

    def sample(self, rng: np.random.Generator, position: FloatArray) -> FloatArray:
        """Draw position + L z with z standard normal."""
        z = rng.standard_normal(position.shape)
        return position + np.einsum("nij,nj->ni", self.factor, z)

    def log_ratio(self, candidate: FloatArray, position: FloatArray) -> FloatArray:
        """Return 0: the walks are symmetric."""
        return np.zeros(len(position))


def side_by_side(kernels: Sequence[Any], chains: int) -> Any:
    """Return the kernel that moves the replicas of all rungs, rung by rung and `chains` in each.

    Parameters
    ----------
    kernels : sequence of Kernel
        One a rung, all of one kind.
    chains : int
    """
    first = kernels[0]
    if all(kernel is first for kernel in kernels):
        return first
    if isinstance(first, Search):
        return replace(first, kernel=side_by_side([kernel.kernel for kernel in kernels], chains))
    if isinstance(first, SliceKernel):
        width, axes = ([getattr(kernel, name) for kernel in kernels] for name in ("width", "axes"))
        return replace(first, width=np.repeat(width, chains, axis=0), axes=np.repeat(axes, chains, axis=0))
    if isinstance(first, MetropolisKernel):
        factors = [_factor(kernel.proposal, kernel.density.ndim) for kernel in kernels]
        return replace(first, proposal=RandomWalks(np.repeat(factors, chains, axis=0)))
    return replace(
        first,
        metric=MetricOfChains([kernel.metric for kernel in kernels], chains),
        step_size=np.concatenate([np.broadcast_to(kernel.step_size, chains) for kernel in kernels]),
        n_steps=int(np.median([kernel.n_steps for kernel in kernels])),
    )


def on_density(kernel: Any, density: LogDensity) -> Kernel:
    """Return the kernel bound to another density."""
    if isinstance(kernel, Search):
        return Search(replace(kernel.kernel, density=density))
    if isinstance(kernel, HamiltonianKernel):
        return replace(kernel, density=density, gradient=ExactGradient(density))
    rebound: Kernel = replace(kernel, density=density)
    return rebound


def _factor(proposal: RandomWalk, ndim: int) -> FloatArray:
    """Return L of a random walk as a matrix."""
    factor = proposal._factor
    return factor if factor.ndim == 2 else np.diag(np.broadcast_to(factor, ndim))
