"""What local samplers share: steps from where a chain is, which the mixture and tempering take too.

A local sampler is one file: settings derived from `LocalSampler`, and a kernel derived from `LocalKernel`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from fmu.samplers.kernel import Info, Sampler, State, Target
from fmu.types import BoolArray, FloatArray, LogDensity


class LocalSampler(Sampler):
    """Settings of a sampler whose steps are local ones of a single point.

    The mixture takes such steps between its candidates, tempering moves its replicas by them, and with jumps the
    chains cross between maxima.
    """

    is_local: ClassVar[bool] = True

    @abstractmethod
    def bind(self, density: LogDensity) -> LocalKernel:
        """Return the kernel that samples `density` with these settings; ValueError if they do not fit it."""

    def take_covariance(self, covariance: FloatArray) -> Self:
        """Return the settings with steps that fit a covariance, shape (ndim, ndim).

        Settings that give a shape of their own, or whose tuner begins without one, stay as they are.
        """
        return self


@dataclass(frozen=True)
class LocalKernel(ABC):
    """A local sampler bound to a density; derived kernels are frozen dataclasses too.

    Its state is position, log-density and, if the target has gradients, the gradient. Its `Info.extra` contains
    ``n_nonfinite``, the evaluations of each chain inside the box that are not finite.
    """

    target: Target

    def init(self, positions: FloatArray) -> tuple[State, Info]:
        """Evaluate the start; ValueError where a gradient that the steps need is not finite."""
        return self.target.start(positions)

    @abstractmethod
    def step(self, rng: np.random.Generator, state: State) -> tuple[State, Info]:
        """Advance every chain by one draw."""

    @abstractmethod
    def join(self, kernels: Sequence[Self], chains: int) -> Self:
        """Return one kernel that moves the chains of several, as one array.

        Parameters
        ----------
        kernels : sequence of kernels of this kind
            This one is the first of them. Their settings differ, their target does not matter.
        chains : int
            Chains of each kernel; they lie one kernel after the other.
        """


def accept(rng: np.random.Generator | np.random.RandomState, log_ratio: FloatArray) -> BoolArray:
    """Return a mask of the accepted candidates, each with probability min(1, exp(log_ratio)), any shape.

    Metropolis et al. (1953), J. Chem. Phys. 21, 1087-1092; log u of a uniform u is −E with E exponential.
    """
    return np.asarray(-rng.standard_exponential(log_ratio.shape) <= log_ratio)


def accept_or_reject(
    rng: np.random.Generator, state: State, candidate: State, log_ratio: FloatArray
) -> tuple[State, BoolArray]:
    """Move every chain to its candidate with probability min(1, exp(log_ratio)), or leave it where it is.

    Parameters
    ----------
    rng : Generator
    state, candidate : State
        Of `chains` chains. Gradients are taken over if the candidate has them; `extra` is left out.
    log_ratio : ndarray, shape (chains,)
        log P(E*) q(E | E*) − log P(E) q(E* | E) for a candidate E* that was drawn from q(E* | E).

    Returns
    -------
    state : State
    accepted : ndarray of bool, shape (chains,)
    """
    accepted = accept(rng, log_ratio)
    moved = accepted[:, None]
    gradient = None
    if state.gradient is not None and candidate.gradient is not None:
        gradient = np.where(moved, candidate.gradient, state.gradient)
    position = np.where(moved, candidate.position, state.position)
    log_prob = np.where(accepted, candidate.log_prob, state.log_prob)
    return State(position, log_prob, gradient), accepted
